"""The two ways to weigh residuals, and what each does its own way along the one pipeline."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from calibration.campaign.campaign import Campaign
from calibration.campaign.measured import MeasuredCurve
from calibration.fit.estimate import Estimate
from calibration.fit.fit import Fit, Prediction
from calibration.fit.levenberg_marquardt import Descent
from calibration.fit.problem import Evaluation
from calibration.forward.contract import ForwardTest, Reached
from calibration.forward.solves import Solves
from calibration.statistics.jitter import Jitter
from calibration.statistics.uncertainty import Uncertainty


class Runner(Protocol):
    """Where the parts of a calibration run, and who is told of them."""

    def say(self, sentence: str) -> None:
        """What is done from now on."""

    def descents(self, function: Callable, laws: Sequence[str], arguments: Sequence[tuple], what: str) -> list:
        """Results of a function that keeps a history of solves, of one law for each of the arguments."""


@dataclass(frozen=True, eq=False)
class Findings:
    """What is known of an estimate before anybody has put it into words.

    Attributes:
        estimate, evaluation, spread: the minimum. descents: of all starts.
        values: all parameters. loose: names that the data do not determine.
        status, unusable: the verdict. lost: warnings of stability in loading that was not measured.
    """

    estimate: Estimate
    evaluation: Evaluation
    spread: Uncertainty
    descents: Sequence[Descent]
    values: Mapping[str, float]
    loose: Sequence[str]
    status: str
    unusable: str | None
    lost: Sequence[str]


class Estimator(Protocol):
    """Weights, and what follows from them.

    Attributes:
        explores: whether profiles and tests that are left out are computed.
        by_prediction: whether laws are ranked by tests that they have not seen, or by BIC.
        words: what is fitted how, for material files.
        pooled_noise: of the nominal stress, Pa; None where each test has its own.
    """

    explores: bool
    by_prediction: bool
    words: str

    @property
    def pooled_noise(self) -> float | None: ...

    def __init__(self, campaign: Campaign, measured: Mapping[str, Sequence[MeasuredCurve]], solves: Solves): ...

    def check(self, law: str, number: int) -> None:
        """Refuse what cannot be fitted: a law, and its number in ``fit.laws``.

        Raises:
            InputError: with file and field.
        """

    def estimate(self, laws: Sequence[str], run: Runner) -> dict[str, tuple[list[Descent], Estimate | str]]:
        """Law -> its descents and its estimate, or why it has none."""

    def uncertainty(self, estimate: Estimate, evaluation: Evaluation) -> Uncertainty:
        """Of the unknowns at the estimate."""

    def stretch_range(self, reached: Sequence[Reached]) -> tuple[float, float]:
        """What counts as the range of the data."""

    def describe(self, found: Findings) -> dict[str, Any]:
        """Fields of the `Fit` that say it in words, and those that only this way to weigh has."""

    def held_out(self, test: Any, estimate: Estimate) -> tuple[ForwardTest, float]:
        """A test that was not fitted, ready to be predicted, with the relative error of its mesh."""

    def scatter(self, estimate: Estimate) -> Jitter | None:
        """What differs from recording to recording beside the noise; None where nobody says."""

    def rank_message(self, fits: Sequence[Fit], predictions: Sequence[Prediction]) -> str:
        """What the first place is worth."""
