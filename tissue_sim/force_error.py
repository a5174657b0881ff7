"""Error of the force of a simulated test, estimated from the same test on another mesh and in other time steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ForceErrorWarningSettings:
    """Settings of the warning of an inaccurate force.

    Attributes:
        warning_fraction: error over the largest force above which a warning is given, 1.
        range_fraction: the warning names the range of samples where the error exceeds this fraction of its maximum, 1.
    """

    warning_fraction: float = 0.025
    range_fraction: float = 0.5


#: Settings of all simulations.
FORCE_ERROR = ForceErrorWarningSettings()


@dataclass(frozen=True)
class RelativeForceErrorEstimate:
    """Estimated error of the force of a simulated test, relative to the largest force, and where the error is large.

    Attributes:
        fraction: largest error as a fraction of the largest force.
        first, last: numbers of the samples between which the error exceeds half of its maximum.
        compared: number of the last compared sample; after it the error is unknown.
        shorter: whether the comparison test has steps a quarter as long; otherwise its steps are twice as long.
    """

    fraction: float
    first: int
    last: int
    compared: int
    shorter: bool = False

    def warning_or_none(self, displacement: np.ndarray, remedy: str) -> str | None:
        """Return the warning of a large error or of an error that is unknown from a sample on; None: no warning.

        Args:
            displacement: of all samples, m, shape (n,).
            remedy: what the user can do about a large error.
        """
        if self.compared < displacement.size - 1:
            return (f"the error of the force is unknown after sample {self.compared + 1} of {displacement.size} "
                    f"({displacement[self.compared] * 1e3:.3g} mm), because the simulations on another mesh did not "
                    f"converge; the error of the earlier samples is about {100 * self.fraction:.2g} % of the largest "
                    "force; use more samples")
        if self.fraction <= FORCE_ERROR.warning_fraction:
            return None
        there = displacement[self.first: self.last + 1] * 1e3
        places = f"{there[-1]:.3g} mm" if self.first == self.last else f"{there.min():.3g} to {there.max():.3g} mm"
        seen = "in steps a quarter as long it differs by three quarters of that" if self.shorter else \
            "in other steps it differs by as much"
        return (f"the force may err by about {100 * self.fraction:.2g} % of its largest at {places}: on another mesh "
                f"and {seen}; {remedy}")


def select_fractional_samples_for_longer_steps(displacement: np.ndarray) -> np.ndarray:
    """Select the samples of a motion at which a comparison test with longer steps is computed.

    These are every second sample, so that the steps are twice as long; the first and the last; those at which the
    motion turns, stops or starts; and after each turn the middle and the end of the first step: an error in the slip
    that begins there is gone one sample later, and a longer step would miss it.

    Args:
        displacement: m, shape (n,).

    Returns:
        Sample numbers, ascending; a half is in the middle between two samples.
    """
    direction = np.sign(np.diff(displacement))
    kept, turned = [0.0], False
    for sample in range(1, displacement.size):
        last = sample == displacement.size - 1
        turns = not last and bool(direction[sample] != direction[sample - 1])
        if turned:
            kept.append(sample - 0.5)
        if turned or turns or last or sample - kept[-1] >= 2:
            kept.append(float(sample))
        turned = turns and bool(direction[sample] != 0)
    return np.array(kept)


def estimate_error_from_two_forces_or_none(force: np.ndarray, samples: np.ndarray, other: np.ndarray, fraction: float,
                                           *, shorter: bool = False) -> RelativeForceErrorEstimate | None:
    """Estimate the error of the force of a test from its difference to another simulation of the test.

    Args:
        force: of the test, N, shape (n,).
        samples: numbers of the samples that the other test has too.
        other: force of the other test at these samples, N; shorter than `samples` if that test ended early.
        fraction: error of this test as a fraction of the difference.
        shorter: whether the steps of the other test are shorter.

    Returns:
        The error; None if there are no common samples, or if the force is zero.
    """
    samples, largest = samples[: other.size], float(abs(force).max(initial=0.0))
    if not samples.size or largest == 0.0:
        return None
    error = fraction * abs(force[samples] - other) / largest
    worst = first = last = int(np.argmax(error))
    is_large = error > FORCE_ERROR.range_fraction * error[worst]
    while first > 0 and is_large[first - 1]:
        first -= 1
    while last + 1 < samples.size and is_large[last + 1]:
        last += 1
    return RelativeForceErrorEstimate(float(error[worst]), int(samples[first]), int(samples[last]), int(samples[-1]),
                                      shorter)
