"""The inverse calibration of a campaign: starts, mesh difference, profiles and left-out tests, law by law."""

from __future__ import annotations

import hashlib
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from calibration.campaign.campaign import Campaign
from calibration.campaign.measured import MeasuredCurve, read_measured
from calibration.fit.assess import assess
from calibration.fit.checks import check_start
from calibration.fit.curves import draw_curves
from calibration.fit.estimate import Estimate, Stated, settle
from calibration.fit.fit import Iteration, Prediction, SensorStatement
from calibration.fit.levenberg_marquardt import ENOUGH_OF_A_START, Descent, Listener, descend
from calibration.fit.problem import Problem
from calibration.fit.profiles import ProfileSide, profile_side
from calibration.fit.ranking import Fitted, rank, ranking_message
from calibration.fit.result import CalibrationResult
from calibration.fit.starts import starts
from calibration.fit.uncertainty import Uncertainty, assess_uncertainty
from calibration.fit.validation import LeftOut, leave_out, predict, unpredicted
from calibration.forward.build import FAST_REMAINDERS, REMAINDERS, build_problem, build_test, remainder
from calibration.forward.forces import ClosedTest, InfeasibleError, SimulatedTest
from calibration.forward.solves import Solves
from calibration.pipeline import Context
from calibration.report.output_folder import SOLVES
from tissue_sim.errors import ConvergenceError


class InverseWork:
    """A campaign of simulated tests; see `calibration.pipeline.Work`.

    Raises:
        InputError: what `read_measured` refuses.
    """

    def __init__(self, campaign: Campaign):
        self.campaign = campaign
        self.measured: dict[str, tuple[MeasuredCurve, ...]] = read_measured(campaign)
        self.recordings = [curve for curves in self.measured.values() for curve in curves]
        self.solves = Solves()
        self.extra = _digests(campaign)
        #: Law -> why it has no fit.
        self.left_behind: dict[str, str] = {}
        #: Law -> simulations that looking at its start took.
        self.looked: dict[str, int] = {}

    def check(self, folder: Path, context: Context) -> None:
        """Refuse a start that the law or the tests do not bear, or a parameter that no test can see."""
        self.solves.read_from(folder / SOLVES)
        for number, law in enumerate(self.campaign.fit.laws):
            context.say(f"{self.campaign.name}: looking at the start of {law}")
            before = sum(self.solves.counts.values())
            check_start(self._problem(law), self.campaign, number)
            self.looked[law] = sum(self.solves.counts.values()) - before

    def _problem(self, law: str) -> Problem:
        return build_problem(law, self.campaign, self.measured, self.solves)

    def run(self, folder: Path, work: str, context: Context) -> CalibrationResult:
        """Fit all laws and write everything."""
        from calibration.report.outputs import write_campaign

        self.solves.move_to(folder / SOLVES)
        found = self._fit(context)
        if not found:
            raise ConvergenceError(f"{self.campaign.path}: no start of any law has a simulation that gets through "
                                   f"({next(iter(self.left_behind.values()), '')}); state another one in fit.start, or "
                                   "take a smaller max_strain")
        fits, predictions, curves = rank(found)
        noise = tuple(SensorStatement(test=name, deviation_N=own[0].noise.deviation,
                                      correlation_time_s=own[0].noise.correlation_time, source=own[0].noise.source)
                      for name, own in self.measured.items())
        sources = {entry.source for entry in noise}
        message = ranking_message(fits, predictions)
        for law, failure in self.left_behind.items():
            message += f" {law} has no fit: {failure}."
        result = CalibrationResult(
            self.campaign, tuple(fits), tuple(predictions), message, folder, work, None,
            sources.pop() if len(sources) == 1 else "mixed", noise)
        context.say(f"{self.campaign.name}: writing the report")
        write_campaign(result, curves, self.measured, figures=context.figures)
        return result

    def _fit(self, context: Context) -> list[Fitted]:
        """Each law that has simulations; why the others have none goes into `left_behind`."""
        campaign, laws = self.campaign, self.campaign.fit.laws
        problems = {law: self._problem(law) for law in laws}
        keys = [(law, number, theta) for law in laws
                for number, theta in enumerate(starts(problems[law].space, campaign.fit.starts), 1)]
        descents = self._descend(context, run_start, [law for law, *_ in keys],
                                 [(problems[law], number, theta) for law, number, theta in keys],
                                 f"{len(keys)} start{'s' if len(keys) > 1 else ''}")
        grouped: dict[str, list[Descent]] = {law: [d for (own, *_), d in zip(keys, descents, strict=True) if own == law]
                                             for law in laws}
        best = {law: min(own, key=lambda d: d.error) for law, own in grouped.items()}
        usable = [law for law in laws if np.isfinite(best[law].error)]
        estimates: dict[str, Estimate] = dict(zip(usable, self._descend(
            context, run_settle, usable,
            [(problems[law], best[law], _stated(campaign, problems[law])) for law in usable],
            "the difference of the accurate mesh"), strict=True))
        usable = [law for law in usable if np.isfinite(estimates[law].error)]
        spreads = {law: assess_uncertainty(e.problem, e.problem.evaluate(e.theta))
                   for law, e in estimates.items() if law in usable}
        for estimate in estimates.values():
            estimate.problem.solves = self.solves
        sides_of, left_of = self._explore(context, estimates, spreads, usable)
        answers = []
        for law in laws:
            if law not in usable:
                failure = estimates[law].failure if law in estimates else best[law].problem
                self.left_behind[law] = failure
                continue
            context.say(f"{campaign.name}: what {law} tells")
            began, counted = time.process_time(), Counter(self.solves.counts)
            sides, left = sides_of[law], left_of[law]
            fit = assess(estimates[law], spreads[law], grouped[law], sides, campaign)
            tests = self._tests_of(estimates[law])
            held_out = self._held_out(estimates[law], spreads[law], tests)
            curves = draw_curves(estimates[law], spreads[law], tests)
            parts = [*grouped[law], estimates[law], *sides, *left]
            simulations = sum(sum(part.simulations.values()) for part in parts)
            simulations += sum((self.solves.counts - counted).values()) + self.looked.get(law, 0)
            spent = sum(part.cpu_s for part in parts) + time.process_time() - began
            fit = replace(fit, fem_solves=simulations, cpu_s=spent,
                          estimate_cpu_s=best[law].cpu_s + estimates[law].cpu_s)
            answers.append((fit, [*(one.prediction for one in left), *held_out], curves))
        return answers

    def _explore(self, context: Context, estimates: dict[str, Estimate], spreads: dict[str, Uncertainty],
                 usable: Sequence[str]) -> tuple[dict[str, list[ProfileSide]], dict[str, list[LeftOut]]]:
        """Profiles of all parameters that have a standard error, and each test left out, of each law."""
        sides: list[tuple] = []
        left: list[tuple] = []
        for law in usable:
            estimate, spread = estimates[law], spreads[law]
            own = [i for i, error in enumerate(spread.standard_errors) if np.isfinite(error) and error > 0]
            sides += [(estimate.problem, estimate.theta, estimate.error, spread, i, side) for i in own
                      for side in (-1, 1)]
            if len(estimate.problem.tests) > 1:
                left += [(estimate.problem, estimate.theta, number) for number in range(len(estimate.problem.tests))]
        found_sides = self._run(context, profile_side, sides, "profiles")
        found_left = self._run(context, leave_out, left, "tests left out, one at a time")
        laws = {id(estimates[law].problem): law for law in usable}
        sides_of: dict[str, list[ProfileSide]] = {law: [] for law in usable}
        left_of: dict[str, list[LeftOut]] = {law: [] for law in usable}
        for (problem, *_), side in zip(sides, found_sides, strict=True):
            sides_of[laws[id(problem)]].append(side)
        for (problem, *_), one in zip(left, found_left, strict=True):
            left_of[laws[id(problem)]].append(one)
        return sides_of, left_of

    def _descend(self, context: Context, function: Callable, laws: Sequence[str], arguments: Sequence[tuple],
                 what: str) -> list:
        """As `_run`, of a function that keeps a history; its solves are told as they come, or with the result."""
        def tell(law: str, iteration: Iteration) -> None:
            context.listen(self.campaign.name, law, iteration)

        if not context.tasks.parallel:
            # In this process even while a task runs; the listener would not travel to another.
            arguments = [(*own, partial(tell, law)) for law, own in zip(laws, arguments, strict=True)]
            return self._run(context, function, arguments, what)

        def replay(index: int, answer) -> None:
            for iteration in answer.history:
                tell(laws[index], iteration)

        return self._run(context, function, arguments, what, replay)

    def _run(self, context: Context, function: Callable, arguments: Sequence[tuple], what: str,
             on_done: Callable | None = None) -> list:
        """Results of a task for each of the arguments; how many are done is said."""
        sentence, done = f"{self.campaign.name}: {what}", []

        def note(index: int, answer) -> None:
            if on_done is not None:
                on_done(index, answer)
            done.append(index)
            context.say(sentence, len(done), len(arguments))

        context.say(sentence, 0, len(arguments))
        return context.tasks.run(function, arguments, note)

    def _tests_of(self, estimate: Estimate) -> list[tuple[SimulatedTest | ClosedTest, float]]:
        """All tests of the campaign in its order, with the relative error of their mesh; those that are held out have a
        mesh difference of their own."""
        problem = estimate.problem
        found = {test.name: (test, error) for test, error in zip(problem.tests, problem.mesh_error, strict=True)}
        for test in self.campaign.tests:
            if test.hold_out:
                own = build_test(test, self.measured[test.name], self.campaign.fit.material, problem.jitter.contact)
                try:
                    own.refine(problem.space, estimate.theta, self.solves)
                    error = REMAINDERS
                except InfeasibleError:
                    own.correction, error = [], FAST_REMAINDERS
                found[test.name] = own, remainder(own, error)
        return [found[test.name] for test in self.campaign.tests]

    def _held_out(self, estimate: Estimate, spread: Uncertainty, tests: Sequence[tuple]) -> list[Prediction]:
        """Predictions of the tests that the campaign holds out."""
        problem, found = estimate.problem, []
        for (test, _), asked in zip(tests, self.campaign.tests, strict=True):
            if asked.hold_out:
                try:
                    found.append(predict(problem, test, estimate.theta, spread.covariance, []))
                except InfeasibleError as failure:
                    found.append(unpredicted(test.name, problem.space.law, [], str(failure)))
        return found


def run_start(problem: Problem, number: int, theta: np.ndarray, listen: Listener | None = None) -> Descent:
    """From one start to its minimum on the fast mesh."""
    return descend(problem, theta, start=number, enough=ENOUGH_OF_A_START, listen=listen)


def run_settle(problem: Problem, best: Descent, stated: Stated, listen: Listener | None = None) -> Estimate:
    """From the best minimum to the estimate."""
    return settle(problem, best.theta, stated, start=best.start, past=len(best.history), listen=listen)


def _stated(campaign: Campaign, problem: Problem) -> Stated:
    """The jitter that is not to be estimated: fitted offsets have their priors."""
    if campaign.fit.offset == "fit":
        return Stated(problem.jitter.contact, problem.jitter.zero)
    return Stated(campaign.noise.contact_jitter, campaign.noise.zero_jitter)


def _digests(campaign: Campaign) -> tuple[str, ...]:
    """Of rigs and tool profiles."""
    found = []
    for test in campaign.tests:
        if test.experiment is not None:
            outline = test.experiment.tool.profile.vertices.tolist()
            found.append(hashlib.sha256(repr((test.rig, outline)).encode()).hexdigest())
    return tuple(found)
