"""Base class of the two estimation methods (ordinary and generalised least squares) in the calibration pipeline.

A failure of one law does not end the calibration of the others.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from calibration.campaign.campaign import Campaign, Test
from calibration.campaign.measured import MeasuredCurve
from calibration.fit.estimate import Estimate
from calibration.fit.population import PredictionParameters
from calibration.fit.problem import ProblemEvaluation
from calibration.fit.run_context import RunContext
from calibration.fit.trust_region import DescentResult
from calibration.forward.contract import ForwardTest, InfeasibleError
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.jitter import ContactAndForceZeroJitter
from calibration.statistics.uncertainty import ParameterUncertainty
from tissue_sim.errors import ConvergenceError

#: Exceptions that the parameter values of one law can cause: no convergence, no force, an invalid material
#: (`InputError` is a `ValueError`), overflow, a singular matrix (`LinAlgError` is a `ValueError`).
LAW_ERRORS = (ConvergenceError, InfeasibleError, ArithmeticError, ValueError)


@dataclass(frozen=True)
class LawFailureRecord:
    """Failure of the calibration of one law, which does not end the calibration of the other laws.

    Attributes:
        reason: description of the failure.
    """

    reason: str


def call_and_catch_law_errors(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function and convert exceptions of `LAW_ERRORS` to a `LawFailureRecord`.

    Args:
        function: function to call.
        arguments: arguments of the function.

    Returns:
        Result of the function, or a `LawFailureRecord`.
    """
    try:
        return function(*arguments)
    except LAW_ERRORS as error:
        return LawFailureRecord(str(error) or type(error).__name__)


@dataclass(frozen=True, eq=False)
class FitFieldInputs:
    """Results of an estimate from which `Estimator.make_method_specific_fit_fields` derives text and further fields.

    Attributes:
        estimate: minimum of the fit.
        spread: uncertainty of the estimate.
        descents: descents from all starts.
        values: name -> value of all parameters, SI.
        loose: names of parameters that the data do not determine.
        status: status of the fit.
        unusable: reason why the fit is not usable; None: it is usable.
        lost: further warnings, such as instability in other modes of loading.
    """

    estimate: Estimate
    spread: ParameterUncertainty
    descents: Sequence[DescentResult]
    values: Mapping[str, float]
    loose: Sequence[str]
    status: str
    unusable: str | None
    lost: Sequence[str]


class Estimator(ABC):
    """Estimation method of a campaign.

    Attributes:
        explores: whether profile likelihoods are computed and simulations are kept on disk.
        words: description of the method for material files.
        campaign: campaign.
        measured: test -> its recordings.
        solves: cache of simulations.
    """

    explores: bool
    words: str

    def __init__(self, campaign: Campaign, measured: Mapping[str, Sequence[MeasuredCurve]], solves: SimulationCache):
        self.campaign, self.measured, self.solves = campaign, measured, solves

    @property
    def pooled_sensor_stress_noise_or_none(self) -> float | None:
        """Pooled noise of the nominal stress, Pa; None if each test has its own noise."""
        return None

    @abstractmethod
    def require_fittable_law(self, law: str, number: int) -> None:
        """Check that a law can be fitted.

        Args:
            law: name of the law.
            number: index of the law in ``fit.laws``.

        Raises:
            InputError: the law cannot be fitted; with file and field.
        """

    @abstractmethod
    def fit_laws(self, laws: Sequence[str],
                 context: RunContext) -> dict[str, tuple[list[DescentResult], Estimate | str]]:
        """Estimate the parameters of several laws.

        Args:
            laws: names of the laws.
            context: workers and listeners.

        Returns:
            Law -> its descents, and its estimate or the reason of the failure.
        """

    @property
    @abstractmethod
    def problem_uncertainty_function(self) -> Callable[[Any, ProblemEvaluation], ParameterUncertainty]:
        """Function that returns the uncertainty of a problem at its minimum; it can be pickled for worker processes."""

    @abstractmethod
    def make_method_specific_fit_fields(self, found: FitFieldInputs) -> dict[str, Any]:
        """Return name -> value of the fields of `Fit` with messages, and of those that only this estimator computes."""

    @abstractmethod
    def build_held_out_test_and_mesh_error(self, test: Test, estimate: Estimate,
                                           predictor: PredictionParameters) -> tuple[ForwardTest, float]:
        """Return the forward model of a held-out test, and the relative error of its mesh.

        Args:
            test: held-out test.
            estimate: minimum of the fit.
            predictor: parameters for the prediction.
        """

    def get_replicate_jitter_or_none(self, estimate: Estimate) -> ContactAndForceZeroJitter | None:
        """Return the scatter of contact and zero between recordings; None: unknown."""
        return None
