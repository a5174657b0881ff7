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
    changed = candidate.add_to(campaign, values, free=free)
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
    touched = [number for number, test in enumerate(problem.tests)
               if candidate.tests is None or test.name in candidate.tests]
    nuisances = np.concatenate([np.zeros(0), *(
        evaluation.nuisances[columns] for columns, (t, _) in zip(problem.offset_columns, problem.places, strict=True)
        if t in touched), *(evaluation.nuisances[first:last] for first, last in dict.fromkeys(
            (problem.shared[t].start, problem.shared[t].stop) for t in touched))])

    def held(of: Problem) -> Problem:
        # Derivatives would cost as much as the simulation.
        space = of.space.held(dict(zip(problem.space.free, evaluation.theta, strict=True)))
        return Problem(space, tuple(of.tests[t] for t in touched), of.solves, of.jitter,
                       tuple(of.mesh_error[t] for t in touched))

    try:
        absent = {path: candidate.absent_value(campaign, path) for path in candidate.sizes}
        with_it = held(extend(problem, campaign, candidate, candidate.scaled_sizes(absent, share), free=False)[0])
        # What another mesh, or another way to the force at a sample, changes is no effect.
        without = held(extend(problem, campaign, candidate, absent, free=False)[0]) if candidate.changes_mesh(
            campaign) \
            else _simulated_like(held(problem), with_it)
        change = _residual(with_it, nuisances)
        # As it is, it is known already.
        change -= np.concatenate([evaluation.residual[rows] for rows, (t, _) in zip(
            problem.rows, problem.places, strict=True) if t in touched]) if without is None else \
            _residual(without, nuisances)
    except (InfeasibleError, NotTestableError, InputError) as error:
        return str(error)
    groups: dict[str, np.ndarray] = {}
    for rows, (t, r) in zip(with_it.rows, with_it.places, strict=True):
        column = groups.setdefault(_group(with_it.tests[t], candidate), np.zeros(problem.samples))
        column[problem.rows[problem.places.index((touched[t], r))]] = change[rows]
    return np.column_stack(list(groups.values()))


def _simulated_like(held: Problem, other: Problem) -> Problem | None:
    """The problem whose tests are simulated along the whole way where those of another one are; None: as it is."""
    def like(test: ForwardTest, of: ForwardTest) -> ForwardTest:
        if not (isinstance(test, SimulatedTest) and isinstance(of, SimulatedTest)):
            return test
        along = test.uses_position_curve(held.space, np.zeros(0)) and not of.uses_position_curve(
            other.space, np.zeros(0))
        return replace(test, full_motion=True) if along else test

    tests = tuple(map(like, held.tests, other.tests))
    if all(one is test for one, test in zip(tests, held.tests, strict=True)):
        return None
    return Problem(held.space, tests, held.solves, held.jitter, held.mesh_error)


def _residual(held: Problem, nuisances: np.ndarray) -> np.ndarray:
    """The whitened residual at nuisances that are known, shape (N,).

    Raises:
        InfeasibleError: as `ForwardTest.solve`.
    """
    answers = [test.solve(held.space, np.zeros(0), held.solves) for test in held.tests]
    return held._linearise(answers, nuisances)[0]


def _group(test: ForwardTest, candidate: Candidate) -> str:
    """Tests with one mark share the numbers of a candidate."""
    if candidate.scope == "per_test":
        return test.name
    if candidate.scope == "per_specimen":
        specimen = test.measured[0].test.specimen
        return "" if specimen is None else specimen.name
    return ""
