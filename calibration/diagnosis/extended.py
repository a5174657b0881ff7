"""The least-squares problem of a campaign with an effect added, and what the effect changes in its forces."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from calibration.campaign.campaign import Campaign
from calibration.campaign.parameter_space import ParameterSpace
from calibration.effects.effect import Candidate, NotTestableError
from calibration.fit.problem import Evaluation, Problem
from calibration.forward.contract import ForwardTest, InfeasibleError
from calibration.forward.simulated import SimulatedTest
from tissue_sim.errors import InputError


def extend(problem: Problem, campaign: Campaign, candidate: Candidate, values: Mapping[str, float] | None = None, *,
           free: bool) -> tuple[Problem, Campaign]:
    """The problem with an effect, and its campaign.

    The mesh corrections and the jitter stay those of `problem`.

    Args:
        problem: without the effect. campaign: its own. candidate: what is added.
        values: path -> value, SI; None: those at which it is tried. free: whether they are unknown, or held.

    Raises:
        NotTestableError: no test has the numbers of the effect.
    """
    changed = candidate.added_to(campaign, values, free=free)
    names = {test.name: [curve.name for curve in test.measured] for test in problem.tests}
    space = ParameterSpace.of(changed.fit.laws[0], changed, names)
    by_name = {test.name: test for test in changed.tests}
    layered = bool(changed.fit.material.layers)

    def with_part(test: ForwardTest) -> ForwardTest:
        if not isinstance(test, SimulatedTest):
            return test
        asked = by_name[test.name]
        if asked.experiment is None:
            return test
        experiment = replace(asked.experiment, protocol=test.experiment.protocol)
        return replace(test, experiment=experiment, rig=asked.rig, layered=layered)

    return Problem(space, tuple(map(with_part, problem.tests)), problem.solves, problem.jitter,
                   problem.mesh_error), changed


def unknowns(space: ParameterSpace, values: Mapping[str, float], sizes: Mapping[str, float]) -> np.ndarray:
    """The free parameters of a space, shape (p,): known values by name, those of an effect by path."""
    return np.array([values[each.name] if each.name in values else sizes[each.path] for each in space.varied])


def change_of(problem: Problem, evaluation: Evaluation, campaign: Campaign, candidate: Candidate,
              share: float = 1.0) -> np.ndarray | str:
    """What an effect of its trial size adds to the whitened model, shape (N, q); why there is none, in words.

    One column for all tests, or one for each specimen or test where it has numbers of its own there.

    Args:
        problem, evaluation: at the minimum without it. campaign: its own. share: of the trial size.
    """
    try:
        absent = {path: candidate.absent_value(campaign, path) for path in candidate.sizes}
        with_it = _residual(problem, evaluation, campaign, candidate, candidate.sizes_at(absent, share))
        # What another mesh changes is no effect.
        without = _residual(problem, evaluation, campaign, candidate, absent) if candidate.remeshes(campaign) else \
            evaluation.residual
    except (InfeasibleError, NotTestableError, InputError) as error:
        return str(error)
    column = with_it - without
    groups: dict[str, np.ndarray] = {}
    for rows, (t, _) in zip(problem.rows, problem.places, strict=True):
        if candidate.tests is not None and problem.tests[t].name not in candidate.tests:
            continue
        mark = _group(problem.tests[t], candidate)
        groups.setdefault(mark, np.zeros(column.size))[rows] = column[rows]
    return np.column_stack(list(groups.values()))


def _residual(problem: Problem, evaluation: Evaluation, campaign: Campaign, candidate: Candidate,
              sizes: Mapping[str, float]) -> np.ndarray:
    """The whitened residual with an effect of these sizes, at parameters and nuisances known."""
    extended, _ = extend(problem, campaign, candidate, sizes, free=False)
    # Held, all of them: derivatives would cost as much as the simulation.
    extended.space = extended.space.held(dict(zip(problem.space.free, evaluation.theta, strict=True)))
    answers = [test.solve(extended.space, np.zeros(0), extended.solves) for test in extended.tests]
    return extended._linearise(answers, evaluation.nuisances)[0]


def _group(test: ForwardTest, candidate: Candidate) -> str:
    """Tests with one mark share the numbers of a candidate."""
    if candidate.scope == "per_test":
        return test.name
    if candidate.scope == "per_specimen":
        specimen = test.measured[0].test.specimen
        return "" if specimen is None else specimen.name
    return ""
