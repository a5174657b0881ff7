"""Tests of one kind in a campaign whose materials disagree, compared by their secant moduli."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.campaign.campaign import Test
from calibration.campaign.measured import MeasuredCurve
from calibration.fit.replicates import (
    compute_mean_forces_or_none,
    find_common_upper_range_or_none,
    find_stiffness_group_disagreement_or_none,
)


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
        if curves:
            groups.setdefault(_make_kind_tool_and_size_key(curves[0].test), {})[name] = curves
    return [found for tests in groups.values() if len(tests) > 1
            and (found := _find_disagreement_of_kind(tests)) is not None]


def _make_kind_tool_and_size_key(test: Test) -> tuple:
    """Return a key that tests with comparable stiffnesses share: the kind, and without a closed form tool and size."""
    specimen = test.specimen
    if _is_homogeneous(test):
        return test.kind.name, True
    tool = None if test.experiment is None else (test.experiment.tool, test.experiment.friction,
                                                 test.experiment.friction_base)
    return test.kind.name, False, str(tool), specimen and tuple(sorted(specimen.sizes.items()))


def _is_homogeneous(test: Test) -> bool:
    """Return whether nominal strain and stress of the test are homogeneous."""
    return test.kind.closed_form is not None and (test.specimen is None or test.specimen.is_prism)


def _find_disagreement_of_kind(tests: Mapping[str, Sequence[MeasuredCurve]]) -> SameKindDisagreement | None:
    """Return the disagreement of the tests of one kind; None if there is none."""
    first = next(iter(tests.values()))[0].test
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
    if specimen is None or not _is_homogeneous(curve.test):
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
