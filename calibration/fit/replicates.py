"""Recordings of one test, and tests of one kind, that disagree: two materials, a wrong unit or a wrong sign."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.campaign.measured import MeasuredCurve


@dataclass(frozen=True)
class ReplicateSettings:
    """Limits of the comparison of recordings of one test.

    Attributes:
        ratio: two groups of recordings disagree where their stiffnesses differ by more than this factor ...
        scatter: ... and the gap between the groups is more than this many standard deviations of the stiffnesses within
            them (logarithms).
        compared: recordings are compared over this upper fraction of the displacement that all of them reach, where an
            offset of the contact matters least.
        unit: a ratio within this many decades of 1000 is named as a factor of units.
        points: number of points at which recordings are compared.
    """

    ratio: float = 1.5
    scatter: float = 3.0
    compared: float = 0.5
    unit: float = 0.1
    points: int = 32


SETTINGS = ReplicateSettings()


@dataclass(frozen=True)
class ReplicateDisagreement:
    """Two groups of recordings of one test with different stiffnesses.

    Attributes:
        test: name of the test.
        odd: names of the recordings in the smaller group.
        others: names of the recordings in the larger group.
        ratio: stiffness of the smaller group divided by that of the larger one; negative if the signs differ.
    """

    test: str
    odd: tuple[str, ...]
    others: tuple[str, ...]
    ratio: float

    def describe(self) -> str:
        """Describe the disagreement and its remedy."""
        ratio = self.ratio
        if ratio <= 0:
            what = "have a force of the other sign than"
        else:
            times = ratio if ratio >= 1 else 1.0 / ratio
            what = f"are {times:.3g} times {'stiffer' if ratio > 1 else 'softer'} than"
        odd = ", ".join(self.odd)
        suspects = odd if len(self.odd) < len(self.others) else f"{odd} and {_abbreviate_recording_names(self.others)}"
        unit = " (a factor of 1000 is that of N to mN or of m to mm)" if \
            ratio > 0 and abs(abs(np.log10(ratio)) - 3.0) < SETTINGS.unit else ""
        verb = what if len(self.odd) > 1 else what.replace("have", "has", 1).replace("are", "is", 1)
        return (f"recordings of {self.test} disagree: {odd} {verb} {_abbreviate_recording_names(self.others)}; check "
                f"unit{unit}, sign and size of the specimen of {suspects}; recordings of another material belong in "
                "another campaign")


def find_replicate_disagreements(measured: Mapping[str, Sequence[MeasuredCurve]]) -> list[ReplicateDisagreement]:
    """Find tests whose recordings fall into two groups of different stiffness.

    Args:
        measured: test -> its recordings.
    """
    return [found for name,
            curves in measured.items() if (found := _find_disagreement_in_test(name, curves)) is not None]


def _find_disagreement_in_test(test: str, curves: Sequence[MeasuredCurve]) -> ReplicateDisagreement | None:
    """Return the disagreement of the recordings of one test; None if there is none."""
    if len(curves) < 2:
        return None
    sizes = compute_mean_forces_or_none([(curve.displacement, curve.force) for curve in curves])
    if sizes is None:
        return None
    return find_stiffness_group_disagreement_or_none(test, [curve.name for curve in curves], sizes)


def find_stiffness_group_disagreement_or_none(test: str, names: Sequence[str], sizes: np.ndarray,
                                              scatter: float = 0.0) -> ReplicateDisagreement | None:
    """Split stiffnesses into two groups with a gap between them; None if there is no such gap.

    Args:
        test: name of the test.
        names: names of the recordings, shape (n,).
        sizes: stiffnesses of the recordings, shape (n,).
        scatter: known standard deviation of the logarithm of each stiffness.
    """
    negative = sizes <= 0
    if negative.any() and not negative.all():
        odd, others = (negative, ~negative) if negative.sum() <= (~negative).sum() else (~negative, negative)
        return ReplicateDisagreement(test, _select_names_by_mask(names, odd), _select_names_by_mask(names, others),
                                     -1.0)
    if negative.all():
        return None
    logs = np.log(sizes)
    order = np.argsort(logs)
    gaps = np.diff(logs[order])
    cut = int(np.argmax(gaps)) + 1
    low, high = logs[order[:cut]], logs[order[cut:]]
    squares = float(np.sum((low - low.mean())**2) + np.sum((high - high.mean())**2))
    within = max(float(np.sqrt(squares / max(logs.size - 2, 1))), scatter)
    if gaps[cut - 1] <= np.log(SETTINGS.ratio) or gaps[cut - 1] <= SETTINGS.scatter * within:
        return None
    below = np.isin(np.arange(logs.size), order[:cut])
    odd = below if below.sum() <= (~below).sum() else ~below
    ratio = float(np.exp(logs[odd].mean() - logs[~odd].mean()))
    return ReplicateDisagreement(test, _select_names_by_mask(names, odd), _select_names_by_mask(names, ~odd), ratio)


def compute_mean_forces_or_none(curves: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray | None:
    """Return the mean force of each recording over displacements that all recordings reach, N, shape (R,).

    None if there are no such displacements.

    Args:
        curves: displacement and force of each recording, shapes (n,).
    """
    found = find_common_upper_range_or_none([displacement for displacement, _ in curves])
    if found is None:
        return None
    grid, means = np.linspace(*found, SETTINGS.points), []
    for displacement, force in curves:
        end = int(np.argmax(displacement)) + 1
        order = np.argsort(displacement[:end], kind="stable")
        means.append(float(np.mean(np.interp(grid, displacement[:end][order], force[:end][order]))))
    return np.array(means)


def find_common_upper_range_or_none(displacements: Sequence[np.ndarray]) -> tuple[float, float] | None:
    """Return lower and upper end of the displacements at which recordings are compared, m; None if there are none."""
    reach = min(float(each.max()) for each in displacements)
    low = max((1.0 - SETTINGS.compared) * reach, *(float(each.min()) for each in displacements))
    return (low, reach) if 0 < low < reach else None


def _select_names_by_mask(names: Sequence[str], mask: np.ndarray) -> tuple[str, ...]:
    """Return the names at which `mask`, bool, shape (n,), is true."""
    return tuple(name for name, inside in zip(names, mask.tolist(), strict=True) if inside)


def _abbreviate_recording_names(names: Iterable[str]) -> str:
    """List up to three names and the number of the others."""
    several = list(names)
    more = f" and {len(several) - 3} more" if len(several) > 3 else ""
    return ", ".join(several[:3]) + more
