"""The inverse calibration of a campaign: starts, mesh difference, profiles and left-out tests, law by law."""

from __future__ import annotations

import hashlib
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from calibration.batch import Context
from calibration.campaign import Campaign
from calibration.campaign_effects import is_effect
from calibration.fit import Prediction, SensorStatement
from calibration.inverse_fem.assess import assess
from calibration.inverse_fem.build import REMAINDERS, build_problem, build_test, remainder
from calibration.inverse_fem.checks import check_start
from calibration.inverse_fem.estimate import Estimate, Stated, settle
from calibration.inverse_fem.forces import InfeasibleError
from calibration.inverse_fem.levenberg_marquardt import ENOUGH_OF_A_START, Descent, Listener, descend
from calibration.inverse_fem.problem import Problem
from calibration.inverse_fem.profiles import ProfileSide, profile_side
from calibration.inverse_fem.ranking import rank, ranking_message
from calibration.inverse_fem.solves import Solves
from calibration.inverse_fem.starts import starts
from calibration.inverse_fem.uncertainty import Uncertainty, assess_uncertainty
from calibration.inverse_fem.validation import LeftOut, leave_out, predict
from calibration.measured import MeasuredCurve, read_measured
from calibration.output_folder import SOLVES
from calibration.result import CalibrationResult
from tissue_sim.errors import ConvergenceError


class InverseWork:
    """A campaign of simulated tests; see `calibration.batch.Work`.

    Raises:
        InputError: what `read_measured` refuses.
    """

    def __init__(self, campaign: Campaign):
        self.campaign = campaign
        effects = tuple(name for name in (*campaign.fit.start, *campaign.fit.fixed) if is_effect(name))
        self.measured: dict[str, tuple[MeasuredCurve, ...]] = read_measured(campaign, effects)
        self.recordings = [curve for curves in self.measured.values() for curve in curves]
        self.solves = Solves()
        self.extra = _digests(campaign)
        #: Law -> why it has no fit.
        self.left_behind: dict[str, str] = {}
        #: Law -> simulations that looking at its start took.
        self.looked: dict[str, int] = {}

    def check(self, context: Context) -> None:
        """Refuse a start that the law or the tests do not bear, or a parameter that no test can see."""
        for number, law in enumerate(self.campaign.fit.laws):
            context.say(f"{self.campaign.name}: looking at the start of {law}")
            before = sum(self.solves.counts.values())
            check_start(self._problem(law), self.campaign, number)
            self.looked[law] = sum(self.solves.counts.values()) - before

    def _problem(self, law: str) -> Problem:
        return build_problem(law, self.campaign, self.measured, self.solves)

    def run(self, folder: Path, work: str, context: Context) -> CalibrationResult:
        """Fit all laws and write everything."""
        from calibration.inverse_fem.outputs import write_campaign

        self.solves.move_to(folder / SOLVES)
        found = [fitted for fitted in self._fit(context) if fitted is not None]
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

    def _fit(self, context: Context) -> list:
        """Each law: its fit, its predictions, its curves; None of a law without any simulation."""
        from calibration.inverse_fem.curves import draw_curves

        campaign, laws, tasks = self.campaign, self.campaign.fit.laws, context.tasks
        problems = {law: self._problem(law) for law in laws}

        def listener(law: str) -> Listener:
            return lambda iteration: context.listen(campaign.name, law, iteration)

        def several(function: Callable, keys: Sequence, arguments: Sequence[tuple], what: str) -> list:
            """Results of a function with a `listen` keyword, for each key (law first)."""
            sentence, of = f"{campaign.name}: {what}", len(arguments)
            context.say(sentence, 0, of)
            answers = []
            if not tasks.parallel:
                for key, own in zip(keys, arguments, strict=True):
                    answers.append(function(*own, listen=listener(key[0])))
                    context.say(sentence, len(answers), of)
                return answers

            def replay(index: int, answer) -> None:
                for iteration in answer.history:
                    context.listen(campaign.name, keys[index][0], iteration)
                answers.append(answer)
                context.say(sentence, len(answers), of)

            return tasks.run(function, arguments, replay)

        keys = [(law, number, theta) for law in laws
                for number, theta in enumerate(starts(problems[law].space, campaign.fit.starts), 1)]
        descents = several(run_start, keys, [(problems[law], number, theta) for law, number, theta in keys],
                           f"{len(keys)} start{'s' if len(keys) > 1 else ''}")
        grouped: dict[str, list[Descent]] = {law: [d for (own, *_), d in zip(keys, descents, strict=True) if own == law]
                                             for law in laws}
        best = {law: min(own, key=lambda d: d.error) for law, own in grouped.items()}
        usable = [law for law in laws if np.isfinite(best[law].error)]
        estimates: dict[str, Estimate] = dict(zip(usable, several(
            run_settle, [(law,) for law in usable],
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
            held_out = self._held_out(estimates[law], spreads[law])
            curves = draw_curves(estimates[law], spreads[law], self._tests_of(estimates[law]))
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

    def _run(self, context: Context, function: Callable, arguments: Sequence[tuple], what: str) -> list:
        sentence, done = f"{self.campaign.name}: {what}", []

        def note(index: int, answer) -> None:
            done.append(index)
            context.say(sentence, len(done), len(arguments))

        context.say(sentence, 0, len(arguments))
        return context.tasks.run(function, arguments, note)

    def _tests_of(self, estimate: Estimate) -> list:
        """All tests of the campaign in its order, those that are held out with a mesh difference of their own."""
        fitted = {test.name: test for test in estimate.problem.tests}
        found = []
        for test in self.campaign.tests:
            if test.name not in fitted:
                own = build_test(test, self.measured[test.name], estimate.problem.space,
                                 estimate.problem.jitter.contact)
                try:
                    own.refine(estimate.problem.space, estimate.theta, self.solves)
                except InfeasibleError:
                    own.correction = []
                fitted[test.name] = own
            found.append((fitted[test.name], remainder(fitted[test.name], REMAINDERS)))
        return found

    def _held_out(self, estimate: Estimate, spread: Uncertainty) -> list[Prediction]:
        """Predictions of the tests that the campaign holds out."""
        problem, found = estimate.problem, []
        held_out = {test.name for test in self.campaign.tests if test.hold_out}
        for test, _ in self._tests_of(estimate):
            if test.name in held_out:
                try:
                    found.append(predict(problem, test, estimate.theta, spread.covariance, []))
                except InfeasibleError as failure:
                    found.append(Prediction(test=test.name, law=problem.space.law, RMSE_N=None, RMSE_Pa=None,
                                            percent=None, note=str(failure)))
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
        if test.setup is not None:
            outline = test.setup.tool.outline
            found.append(hashlib.sha256(repr((test.setup.rig, None if outline is None else outline.tolist())).encode()
                                        ).hexdigest())
    return tuple(found)


