"""Interface between a fit and the forward model of a test (`ForwardTest`).

Three classes implement the interface: `ClosedFormTest` (homogeneous deformation), `ColumnTest` (the same with
self-weight) and `SimulatedTest` (finite elements).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameter_space import ParameterSpace
from calibration.forward.simulation_cache import SimulationCache
from tissue_sim.closed_form.homogeneous import ClosedForm
from tissue_sim.specimen import Specimen


class InfeasibleError(RuntimeError):
    """Raised if a test has no force at these parameters: the material is invalid, or the solver does not converge."""


@dataclass(frozen=True)
class StretchRange:
    """Range of the principal stretches in a test, including the undeformed state.

    Attributes:
        mode: mode of loading, a key of `StabilityRange.limits`; None if the deformation is not homogeneous.
        low: smallest stretch along the load.
        high: largest stretch along the load.
        principal: smallest and largest principal stretch in any direction.
    """

    mode: str | None
    low: float
    high: float
    principal: tuple[float, float]


class ForwardTest(Protocol):
    """Forward model of one test of a campaign."""

    #: Implementations are dataclasses, so that `dataclasses.replace` can change single fields.
    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def name(self) -> str:
        """Name of the test."""

    @property
    def measured(self) -> tuple[MeasuredCurve, ...]:
        """Recordings of the test."""

    @property
    def is_force_proportional_to_moduli(self) -> bool:
        """Whether the force is proportional to the moduli if all moduli change by the same factor."""

    @property
    def is_homogeneous(self) -> bool:
        """Whether the deformation is homogeneous, so that every mesh is exact."""

    @property
    def mesh_key(self) -> str:
        """Key of the mesh: tests with the same key have the same mesh error; empty: no other test shares the mesh."""

    @property
    def has_reversals_or_holds(self) -> bool:
        """Whether the force may depend on the loading path, so that it is no function of displacement alone."""

    @property
    def area(self) -> float | None:
        """Reference cross-section of the nominal stress, m2 (1 if stress was recorded); None if the stress varies."""

    @property
    def specimen(self) -> Specimen | None:
        """Specimen; None for a closed form without self-weight."""

    @property
    def closed_form(self) -> ClosedForm:
        """Closed form (stress as a function of strain) of a homogeneous test."""

    @property
    def largest_strain_or_none(self) -> float | None:
        """Largest I1 - 3 of the recordings, of an incompressible material; None for an inhomogeneous test."""

    def solve(self, space: ParameterSpace, theta: np.ndarray, solves: SimulationCache) -> Any:
        """Return the input of `evaluate_force_and_derivatives` at given parameters.

        It is a simulation, or the parameter values of a closed form.

        Args:
            space: parameter space.
            theta: free parameters, SI, shape (p,).
            solves: cache of simulations.

        Returns:
            Solution, the first argument of `evaluate_force_and_derivatives`.

        Raises:
            InfeasibleError: the material is invalid, or the solver does not converge.
        """

    def evaluate_force_and_derivatives(self, answer: Any, recording: int,
                                       offset: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the force at the samples of a recording, and its derivatives.

        Args:
            answer: solution from `solve`.
            recording: index in `measured`.
            offset: contact offset, m.

        Returns:
            Force, N, shape (n,); its derivatives with respect to the free parameters, shape (n, p); its derivative
            with respect to the contact offset, N/m, shape (n,).

        Raises:
            InfeasibleError: the force is not finite.
        """

    def remove_memory(self, answer: Any, recording: int, columns: np.ndarray) -> np.ndarray:
        """Return the elastic parts of changes of the force that follow from changes of the displacement.

        A change e of the displacement changes the force by K e. The tangent is K = R diag(k) with the hereditary
        integral R and the elastic stiffness k of each sample. The result is R^-1 `columns`.

        Args:
            answer: solution from `solve`.
            recording: index in `measured`.
            columns: changes of the force at the samples of the recording, shape (n, m).
        """

    def list_finite_difference_parameters(self, answer: Any) -> frozenset[str]:
        """Return the names of the free parameters whose derivatives are finite differences, not exact ones."""

    def update_mesh_force_difference_and_get_ratio(self, space: ParameterSpace, theta: np.ndarray,
                                                   solves: SimulationCache) -> float:
        """Compute and store the force difference between accurate and fast mesh at `theta`; later forces include it.

        Returns:
            The largest absolute difference divided by the largest force; 0 if every mesh is exact.
        """

    def discard_mesh_correction(self) -> None:
        """Delete the stored mesh correction, so that forces are those of the fast mesh."""

    def compute_stretch_range(self, space: ParameterSpace, theta: np.ndarray) -> StretchRange:
        """Return the range of principal stretches that the specimen reaches in all recordings at `theta`."""


def find_largest_strain_of_data_or_none(tests: Sequence[ForwardTest]) -> float | None:
    """Return the largest I1 - 3 of the homogeneous tests; None without such a test."""
    return max((strain for test in tests if (strain := test.largest_strain_or_none) is not None), default=None)
