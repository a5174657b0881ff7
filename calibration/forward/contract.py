"""What a fit asks of a test: its force as a function of the parameters.

The forms are closed (a homogeneous test in closed form), column (the same under its own weight) and simulated (finite
elements). A fit knows no other difference between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameter_space import ParameterSpace
from calibration.forward.solves import Solves
from tissue_sim.closed_form.homogeneous import ClosedForm
from tissue_sim.specimen import Specimen


class InfeasibleError(RuntimeError):
    """No force at these parameters: no such material, or the test does not get through."""


@dataclass(frozen=True)
class Reached:
    """Principal stretches along the load that the data reach, rest included.

    Attributes:
        mode: of `Stability.limits`; None where the deformation is not homogeneous.
        low, high: the extreme stretches.
        principal: extremes of all principal stretches, those across the load included.
    """

    mode: str | None
    low: float
    high: float
    principal: tuple[float, float]


class ForwardTest(Protocol):
    """One test of a campaign, at any parameters.

    Attributes:
        name: of the test. measured: its recordings.
        proportional: whether force is proportional to the moduli. homogeneous: whether every mesh is exact.
        mesh: what its mesh is known by; tests with one name have one error of it. Empty: of its own, or none.
        timed: whether the force depends on the way that led to a displacement.
        area: cross-section that a nominal stress refers to, m2 (1 where stress was recorded); None where the stress
            is not homogeneous.
        specimen: None of a closed form without weight. closed_form: where it is homogeneous.
    """

    #: A test is a dataclass, so that `dataclasses.replace` gives another one.
    __dataclass_fields__: ClassVar[dict[str, Any]]

    @property
    def name(self) -> str: ...

    @property
    def measured(self) -> tuple[MeasuredCurve, ...]: ...

    @property
    def proportional(self) -> bool: ...

    @property
    def homogeneous(self) -> bool: ...

    @property
    def mesh(self) -> str: ...

    @property
    def timed(self) -> bool: ...

    @property
    def area(self) -> float | None: ...

    @property
    def specimen(self) -> Specimen | None: ...

    @property
    def closed_form(self) -> ClosedForm: ...

    def solve(self, space: ParameterSpace, theta: np.ndarray, solves: Solves) -> Any:
        """The answer at the free parameters `theta`, SI, shape (p,), for `evaluate`; `solves` remembers simulations.

        Raises:
            InfeasibleError: no such material, or no convergence.
        """

    def evaluate(self, answer: Any, recording: int, offset: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Force (n,), derivatives with the free parameters (n, p) and with the contact offset (n,), N and SI.

        Args:
            answer: of `solve`. recording: number in `measured`. offset: of the contact, m.

        Raises:
            InfeasibleError: the force is not a finite number.
        """

    def differences(self, answer: Any) -> frozenset[str]:
        """Names of the free parameters whose derivatives are differences, and not exact."""

    def refine(self, space: ParameterSpace, theta: np.ndarray, solves: Solves) -> float:
        """Correct the answers from here on by what the accurate mesh has more at `theta`.

        Returns:
            The largest correction, relative to the largest force; 0 where every mesh is exact.
        """

    def forget(self) -> None:
        """Take the correction back."""

    def reached(self, space: ParameterSpace, theta: np.ndarray) -> Reached:
        """What the recordings reach with these parameters."""
