"""The two ways to weigh residuals, and what each does its own way along the one pipeline."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from calibration.campaign.campaign import Campaign, Test
from calibration.campaign.measured import MeasuredCurve
from calibration.fit.estimate import Estimate
from calibration.fit.predictor import Predictor
from calibration.fit.problem import Evaluation
from calibration.fit.run_context import RunContext
from calibration.fit.trust_region import Descent
from calibration.forward.contract import ForwardTest
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.jitter import Jitter
from calibration.statistics.uncertainty import Uncertainty


@dataclass(frozen=True, eq=False)
class Findings:
    """What is known of an estimate before anybody has put it into words.

    Attributes:
        estimate, spread: the minimum. descents: of all starts.
        values: all parameters. loose: names that the data do not determine.
        status, unusable: the verdict. lost: warnings of stability in loading that was not measured.
    """

    estimate: Estimate
    spread: Uncertainty
    descents: Sequence[Descent]
    values: Mapping[str, float]
    loose: Sequence[str]
    status: str
    unusable: str | None
    lost: Sequence[str]


class Estimator(ABC):
    """Weights, and what follows from them.

    Attributes:
        explores: whether profiles are computed, and simulations kept.
        words: what is fitted how, for material files.
    """

    explores: bool
    words: str

    def __init__(self, campaign: Campaign, measured: Mapping[str, Sequence[MeasuredCurve]], solves: SimulationCache):
        self.campaign, self.measured, self.solves = campaign, measured, solves

    @property
    def pooled_noise(self) -> float | None:
        """Of the nominal stress, Pa; None where each test has its own."""
        return None

    @abstractmethod
    def check(self, law: str, number: int) -> None:
        """Refuse what cannot be fitted: a law, and its number in ``fit.laws``.

        Raises:
            InputError: with file and field.
        """

    @abstractmethod
    def estimate(self, laws: Sequence[str], context: RunContext) -> dict[str, tuple[list[Descent], Estimate | str]]:
        """Law -> its descents and its estimate, or why it has none."""

    @property
    @abstractmethod
    def uncertainty(self) -> Callable[[Any, Evaluation], Uncertainty]:
        """Of the unknowns of a problem at its minimum; it travels to worker processes."""

    @abstractmethod
    def describe(self, found: Findings) -> dict[str, Any]:
        """Fields of the `Fit` that say it in words, and those that only this way to weigh has."""

    @abstractmethod
    def held_out(self, test: Test, estimate: Estimate, predictor: Predictor) -> tuple[ForwardTest, float]:
        """A test that was not fitted, ready to be predicted with these parameters, and the relative error of its
        mesh."""

    def scatter(self, estimate: Estimate) -> Jitter | None:
        """What differs from recording to recording beside the noise; None where nobody says."""
        return None
