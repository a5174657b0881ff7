"""By how much the force of a simulated test errs, from the same test on another mesh and in other steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

#: From this share of the largest force on, an error is worth a warning.
WORTH_A_WARNING = 0.025
#: It reaches as far as this share of its largest.
_REACHES = 0.5


@dataclass(frozen=True)
class ForceError:
    """Where and by how much a force may err.

    Attributes:
        share: the largest, over the largest force.
        first, last: samples between which it is more than half of that.
        shorter: whether steps half as long tell it, not longer ones.
    """

    share: float
    first: int
    last: int
    shorter: bool = False

    def in_words(self, displacement: np.ndarray, remedy: str) -> str:
        """A sentence; of displacements, m, of all samples, and what shows the error."""
        there = displacement[self.first: self.last + 1] * 1e3
        places = f"{there[-1]:.3g} mm" if self.first == self.last else f"{there.min():.3g} to {there.max():.3g} mm"
        seen = "in steps half as long it differs by half as much" if self.shorter else \
            "in other steps it differs by so much"
        return (f"the force may err by about {100 * self.share:.2g} % of its largest at {places}: on another mesh and "
                f"{seen}; {remedy}")


def other_steps(displacement: np.ndarray) -> np.ndarray:
    """Places along a motion to which a test goes that is compared with it.

    Every second sample, in steps twice as long; those at which it turns or begins or ends to rest, and the ends; and
    after each turn the middle of the first step and its end: what slips first there is right again a sample later, and
    a longer step goes past it.

    Args:
        displacement: m, shape (n,).

    Returns:
        Numbers of samples, ascending; halves are in the middle between two.
    """
    way = np.sign(np.diff(displacement))
    kept, turned = [0.0], False
    for sample in range(1, displacement.size):
        last = sample == displacement.size - 1
        turns = not last and bool(way[sample] != way[sample - 1])
        if turned:
            kept.append(sample - 0.5)
        if turned or turns or last or sample - kept[-1] >= 2:
            kept.append(float(sample))
        turned = turns and bool(way[sample] != 0)
    return np.array(kept)


def force_error(force: np.ndarray, samples: np.ndarray, other: np.ndarray, share: float, *,
                shorter: bool = False) -> ForceError | None:
    """The error that a comparison stands for.

    Args:
        force: of the test, N, shape (n,).
        samples: numbers of those that the other test has too.
        other: its force there, N; it may have come to an end before.
        share: of their difference that is the error of this test.
        shorter: whether its steps are.

    Returns:
        None where nothing can be compared.
    """
    samples, largest = samples[: other.size], float(abs(force).max(initial=0.0))
    if not samples.size or largest == 0.0:
        return None
    apart = share * abs(force[samples] - other) / largest
    worst = first = last = int(np.argmax(apart))
    far = apart > _REACHES * apart[worst]
    while first > 0 and far[first - 1]:
        first -= 1
    while last + 1 < samples.size and far[last + 1]:
        last += 1
    return ForceError(float(apart[worst]), int(samples[first]), int(samples[last]), shorter)
