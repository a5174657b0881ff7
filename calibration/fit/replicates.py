"""Recordings of one test, and tests of one kind, that disagree: two materials, a wrong unit or a wrong sign.

Tests of one kind are compared by their secant moduli. Recordings of several motions, such as the stretches of both axes
of a sheet, are compared only if their motions are equal.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.campaign.campaign import Test
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
        motion: largest difference of several motions that count as equal, as a fraction of the largest displacement at
            which the recordings are compared.
    """

    ratio: float = 1.5
    scatter: float = 3.0
    compared: float = 0.5
    unit: float = 0.1
    points: int = 32
    motion: float = 0.05


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
    if len(curves) < 2 or curves[0].test.modulus:
        return None
    sizes = compute_mean_forces_or_none([(curve.displacement, curve.force) for curve in curves])
    if sizes is None or not _have_equal_motions(curves):
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
    grid = np.linspace(*found, SETTINGS.points)
    return np.array([np.mean(_interpolate_loading(grid, displacement, force)) for displacement, force in curves])


def _interpolate_loading(grid: np.ndarray, displacement: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return values at the displacements `grid`, from the samples up to the largest displacement, shape of `grid`."""
    end = int(np.argmax(displacement)) + 1
    order = np.argsort(displacement[:end], kind="stable")
    return np.interp(grid, displacement[:end][order], values[:end][order])


def _have_equal_motions(curves: Sequence[MeasuredCurve]) -> bool:
    """Return whether all motions agree at equal displacements, true for recordings of one motion."""
    found = find_common_upper_range_or_none([curve.displacement for curve in curves])
    if found is None:
        return False
    grid = np.linspace(*found, SETTINGS.points)
    paths = np.array([[_interpolate_loading(grid, curve.displacement, motion) for motion in curve.motions.T]
                      for curve in curves if curve.motions is not None])
    return not paths.size or bool(np.ptp(paths, axis=0).max() <= SETTINGS.motion * found[1])


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


@dataclass(frozen=True)
class SameKindDisagreement:
    """Tests of one kind in two groups of different stiffness.

    Attributes:
        kind: name of the kind of test.
        secants: test -> mean secant modulus, Pa (stiffness, N/m, without a closed form).
        has_modulus: whether `secants` are moduli.
        low: smallest strain, or displacement in m, at which the tests are compared.
        high: largest strain, or displacement in m, at which the tests are compared.
    """

    kind: str
    secants: Mapping[str, float]
    has_modulus: bool
    low: float
    high: float

    def describe(self) -> str:
        """Describe the disagreement and its remedy."""
        unit, what, ends = ("kPa", "secant modulus at strains of", (self.low, self.high)) if self.has_modulus else \
            ("N/mm", "secant stiffness at displacements in mm of", (1e3 * self.low, 1e3 * self.high))
        values = ", ".join(f"{name} {1e-3 * value:.3g} {unit}" for name, value in self.secants.items())
        return (f"tests of {self.kind} disagree: {values} ({what} {ends[0]:.2g} to {ends[1]:.2g}); different "
                "materials? Fit each material in a separate campaign; for one material check unit, sign and size of "
                "the specimens")


def find_same_kind_disagreements(measured: Mapping[str, Sequence[MeasuredCurve]]) -> list[SameKindDisagreement]:
    """Find kinds of test whose tests fall into two groups of different stiffness.

    Args:
        measured: test -> its recordings.
    """
    groups: dict[tuple, dict[str, Sequence[MeasuredCurve]]] = {}
    for name, curves in measured.items():
        if curves and not curves[0].test.modulus:
            groups.setdefault(_make_kind_tool_and_size_key(curves[0].test), {})[name] = curves
    return [found for tests in groups.values() if len(tests) > 1
            and (found := _find_disagreement_of_kind(tests)) is not None]


def _make_kind_tool_and_size_key(test: Test) -> tuple:
    """Return a key that tests with comparable stiffnesses share: kind and load, without a closed form tool and size."""
    specimen = test.specimen
    if _is_homogeneous(test):
        return test.kind.name, True, test.kind.channels
    tool = None if test.experiment is None else (test.experiment.tool, test.experiment.friction,
                                                 test.experiment.friction_base)
    return test.kind.name, False, str(tool), specimen and tuple(sorted(specimen.sizes.items()))


def _is_homogeneous(test: Test) -> bool:
    """Return whether nominal strain and stress of the test are homogeneous."""
    return test.kind.closed_form is not None and (test.specimen is None or test.specimen.is_prism)


def _find_disagreement_of_kind(tests: Mapping[str, Sequence[MeasuredCurve]]) -> SameKindDisagreement | None:
    """Return the disagreement of the tests of one kind; None if there is none."""
    first = next(iter(tests.values()))[0].test
    if not _have_equal_motions([curve for curves in tests.values() for curve in curves]):
        return None
    scaled = {name: [_get_strain_stress_or_displacement_force(curve) for curve in curves] for name,
              curves in tests.items()}
    every = [pair for pairs in scaled.values() for pair in pairs]
    span, forces = find_common_upper_range_or_none([motion for motion, _ in every]), compute_mean_forces_or_none(every)
    if span is None or forces is None:
        return None
    index = np.repeat(np.arange(len(tests)), [len(pairs) for pairs in scaled.values()])
    means = np.array([forces[index == number].mean() for number in range(len(tests))])
    if find_stiffness_group_disagreement_or_none(first.kind.name, list(tests), means,
                                                 _estimate_log_force_scatter(forces, index)) is None:
        return None
    middle = 0.5 * (span[0] + span[1])
    return SameKindDisagreement(first.kind.name, dict(zip(tests, (means / middle).tolist(), strict=True)),
                                _is_homogeneous(first), *span)


def _get_strain_stress_or_displacement_force(curve: MeasuredCurve) -> tuple[np.ndarray, np.ndarray]:
    """Return nominal strain and stress of a homogeneous test, otherwise displacement, m, and force, N."""
    specimen = curve.test.specimen
    if specimen is None or curve.test.states_stress or not _is_homogeneous(curve.test):
        return curve.displacement, curve.force
    return curve.displacement / specimen.height, curve.force / specimen.area


def _estimate_log_force_scatter(forces: np.ndarray, index: np.ndarray) -> float:
    """Return the standard deviation of the logarithms of the forces within the tests; 0 with one recording in each.

    Args:
        forces: mean force of each recording, shape (R,).
        index: number of the test of each recording, shape (R,).
    """
    count = int(index.max()) + 1
    if bool(np.any(forces <= 0)) or forces.size == count:
        return 0.0
    logs = np.log(forces)
    squares = sum(float(np.sum((logs[index == i] - logs[index == i].mean())**2)) for i in range(count))
    return float(np.sqrt(squares / (forces.size - count)))
