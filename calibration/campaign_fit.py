"""One campaign, from its recordings to its results: the same steps whatever the weights and the forward models."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace

from calibration.campaign.campaign import Campaign
from calibration.campaign.measured import MeasuredCurve, read_measured
from calibration.campaign.segmented import notes_in_short
from calibration.fit.assess import assess
from calibration.fit.context import Context
from calibration.fit.curves import draw_curves
from calibration.fit.estimate import Estimate
from calibration.fit.estimator import Estimator
from calibration.fit.fit import Iteration, SensorStatement
from calibration.fit.generalised import Generalised
from calibration.fit.levenberg_marquardt import Descent
from calibration.fit.ordinary import Ordinary
from calibration.fit.profiles import ProfileSide, profile_side
from calibration.fit.ranking import Fitted, rank
from calibration.fit.result import CalibrationResult
from calibration.fit.validation import LeftOut, leave_out, predict_held_out
from calibration.forward.solves import Solves
from calibration.output_folder import SOLVES
from calibration.report.outputs import write_campaign
from calibration.statistics.uncertainty import Uncertainty
from tissue_sim.errors import ConvergenceError

#: Method of a campaign -> its weights.
ESTIMATORS: dict[str, type[Estimator]] = {"analytical": Ordinary, "inverse_fem": Generalised}


class CampaignFit:
    """A campaign that has been read.

    Attributes:
        campaign: what is asked. measured: test -> its recordings. recordings: all of them. extra: digests of the other
            files that it reads.

    Raises:
        InputError: what `read_measured` refuses.
    """

    def __init__(self, campaign: Campaign):
        self.campaign = campaign
        self.measured: dict[str, tuple[MeasuredCurve, ...]] = read_measured(campaign)
        self.recordings = [curve for curves in self.measured.values() for curve in curves]
        self.extra = _digests(campaign)
        self.solves = Solves()
        self.estimator: Estimator = ESTIMATORS[campaign.fit.method](campaign, self.measured, self.solves)
        #: Law -> simulations that the check of its start took.
        self.checked: dict[str, int] = {}

    def check(self, folder: Path, context: Context) -> None:
        """Refuse what cannot be fitted, before anything is written; not asked of what is finished.

        Args:
            folder: what an earlier run of the same campaign kept may be read there. context: to say what is done.

        Raises:
            InputError: with file and field.
        """
        self.solves.read_from(folder / SOLVES)
        for number, law in enumerate(self.campaign.fit.laws):
            if self.estimator.explores:
                context.say(f"{self.campaign.name}: looking at the start of {law}")
            before = sum(self.solves.counts.values())
            self.estimator.check(law, number)
            self.checked[law] = sum(self.solves.counts.values()) - before

    def run(self, folder: Path, digest: str, context: Context) -> CalibrationResult:
        """Fit all laws and write everything into the folder; ``fit.json`` last, because it says that it is finished.

        Raises:
            ConvergenceError: no law could be fitted.
        """
        if self.estimator.explores:
            self.solves.move_to(folder / SOLVES)
        found, failures = self._fit(_Steps(self.campaign, context))
        if not found:
            raise ConvergenceError(f"{self.campaign.path}: no start of any law gets through the data "
                                   f"({next(iter(failures.values()), '')}); state another one in fit.start, or take a "
                                   "smaller max_strain")
        fits, predictions, curves = rank(found, by_prediction=self.estimator.by_prediction)
        message = self.estimator.rank_message(fits, predictions)
        for law, failure in failures.items():
            message += f" {law} has no fit: {failure}."
        message += notes_in_short((curve.test.name, curve.name, curve.notes) for curve in self.recordings)
        noises = {name: several[0].noise for name, several in self.measured.items()}
        noise = tuple(SensorStatement(test=name, deviation_N=one.deviation, correlation_time_s=one.correlation_time,
                                      source=one.source) for name, one in noises.items())
        sources = {curve.noise.source for test in self.campaign.tests if not test.hold_out
                   for curve in self.measured[test.name]}
        result = CalibrationResult(
            self.campaign, tuple(fits), tuple(predictions), message, folder, digest, self.estimator.pooled_noise,
            sources.pop() if len(sources) == 1 else "mixed", noise if self.estimator.explores else ())
        if self.estimator.explores:
            context.say(f"{self.campaign.name}: writing the report")
        write_campaign(result, curves, self.measured, self.estimator.words, figures=context.figures)
        return result

    def _fit(self, steps: _Steps) -> tuple[list[Fitted], dict[str, str]]:
        """Each law that has an estimate, and why the others have none."""
        laws, campaign = self.campaign.fit.laws, self.campaign
        ends = self.estimator.estimate(laws, steps)
        estimates = {law: estimate for law, (_, estimate) in ends.items() if isinstance(estimate, Estimate)}
        failures = {law: estimate for law, (_, estimate) in ends.items() if not isinstance(estimate, Estimate)}
        spreads = {law: self.estimator.uncertainty(estimate, estimate.problem.evaluate(estimate.theta))
                   for law, estimate in estimates.items()}
        sides_of, left_of = self._explore(steps, estimates, spreads)
        answers: list[Fitted] = []
        for law, estimate in estimates.items():
            if self.estimator.explores:
                steps.say(f"what {law} tells")
            began, counted = time.process_time(), self.solves.counts.copy()
            (descents, _), sides, left, spread = ends[law], sides_of[law], left_of[law], spreads[law]
            fit = assess(self.estimator, estimate, spread, descents, sides, campaign)
            known = {test.name: (test, error) for test, error in zip(
                estimate.problem.tests, estimate.problem.mesh_error, strict=True)}
            tests = [known[test.name] if not test.hold_out else self.estimator.held_out(test, estimate)
                     for test in campaign.tests]
            scatter = self.estimator.scatter(estimate)
            held_out = [predict_held_out(test, estimate, spread, scatter) for (test, _), asked in zip(
                tests, campaign.tests, strict=True) if asked.hold_out]
            curves = draw_curves(estimate, spread, tests, scatter)
            parts: list[Any] = [*descents, estimate, *sides, *left]
            simulations = sum(sum(part.simulations.values()) for part in parts)
            simulations += (self.solves.counts - counted).total() + self.checked.get(law, 0)
            spent = sum(part.cpu_s for part in parts) + time.process_time() - began
            best = min(descents, key=lambda end: end.error)
            fit = replace(fit, fem_solves=simulations, cpu_s=spent,
                          estimate_cpu_s=best.cpu_s + estimate.cpu_s if self.estimator.explores else 0.0)
            answers.append((fit, [*(one.prediction for one in left), *held_out], curves))
        return answers, failures

    def _explore(self, steps: _Steps, estimates: dict[str, Estimate], spreads: dict[str, Uncertainty]
                 ) -> tuple[dict[str, list[ProfileSide]], dict[str, list[LeftOut]]]:
        """Profiles of all parameters that have a standard error, and each test left out, of each law."""
        sides_of: dict[str, list[ProfileSide]] = {law: [] for law in estimates}
        left_of: dict[str, list[LeftOut]] = {law: [] for law in estimates}
        if not self.estimator.explores:
            return sides_of, left_of
        sides, left = [], []
        for law, estimate in estimates.items():
            known = [i for i, error in enumerate(spreads[law].standard_errors) if np.isfinite(error) and error > 0]
            sides += [(law, (estimate.problem, estimate.theta, estimate.error, spreads[law], i, side)) for i in known
                      for side in (-1, 1)]
            if len(estimate.problem.tests) > 1:
                left += [(law, (estimate.problem, estimate.theta, number))
                         for number in range(len(estimate.problem.tests))]
        for function, tasks, words, found in ((profile_side, sides, "profiles", sides_of),
                                              (leave_out, left, "tests left out, one at a time", left_of)):
            answers = steps.all_of(function, [arguments for _, arguments in tasks], words)
            for (law, _), answer in zip(tasks, answers, strict=True):
                found[law].append(answer)
        return sides_of, left_of


@dataclass(frozen=True)
class _Steps:
    """The parts of one campaign, see `calibration.fit.estimator.Runner`."""

    campaign: Campaign
    context: Context

    def say(self, sentence: str) -> None:
        self.context.say(f"{self.campaign.name}: {sentence}")

    def descents(self, function: Callable, laws: Sequence[str], arguments: Sequence[tuple], what: str) -> list:
        """As `all_of`, of a function that keeps a history; its solves are told as they come, or with the result."""
        def tell(law: str, iteration: Iteration) -> None:
            self.context.listen(self.campaign.name, law, iteration)

        if not self.context.tasks.parallel:
            # In this process even while a task runs; the listener would not travel to another.
            arguments = [(*given, partial(tell, law)) for law, given in zip(laws, arguments, strict=True)]
            return self.all_of(function, arguments, what)

        def replay(index: int, answer: Descent | Estimate) -> None:
            for iteration in answer.history:
                tell(laws[index], iteration)

        return self.all_of(function, arguments, what, replay)

    def all_of(self, function: Callable, arguments: Sequence[tuple], what: str,
               on_done: Callable | None = None) -> list:
        """Results of a task for each of the arguments; how many are done is said."""
        sentence, done = f"{self.campaign.name}: {what}", []

        def note(index: int, answer) -> None:
            if on_done is not None:
                on_done(index, answer)
            done.append(index)
            self.context.say(sentence, len(done), len(arguments))

        self.context.say(sentence, 0, len(arguments))
        return self.context.tasks.run(function, arguments, note)


def _digests(campaign: Campaign) -> tuple[str, ...]:
    """Of rigs and tool profiles."""
    found = []
    for test in campaign.tests:
        if test.experiment is not None:
            outline = test.experiment.tool.profile.vertices.tolist()
            found.append(hashlib.sha256(repr((test.rig, outline)).encode()).hexdigest())
    return tuple(found)
