"""Least-squares problems with an additional effect, and the change of the forces by an effect."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from calibration.campaign.campaign import Campaign
from calibration.campaign.parameter_space import ParameterSpace
from calibration.effects.effect import Candidate, NotTestableError
from calibration.fit.problem import GeneralisedProblem, ProblemEvaluation
from calibration.forward.contract import ForwardTest, InfeasibleError
from calibration.forward.simulated import SimulatedTest
from tissue_sim.errors import InputError


def add_effect_to_problem_and_campaign(problem: GeneralisedProblem, campaign: Campaign, candidate: Candidate,
                                       values: Mapping[str, float] | None = None, *,
                                       free: bool) -> tuple[GeneralisedProblem, Campaign]:
    """Return the problem and the campaign with an effect; mesh corrections and jitter are unchanged.

    Args:
        problem: problem without the effect.
        campaign: campaign of `problem`.
        candidate: candidate that is added.
        values: path -> value, SI; None: trial values.
        free: whether the parameters of the effect are free or fixed.

    Raises:
        NotTestableError: no test has the parameters of the effect.
    """
    changed = candidate.add_to_campaign(campaign, values, free=free)
    names = {test.name: [curve.name for curve in test.measured] for test in problem.tests}
    space = ParameterSpace.from_campaign(changed.fit.laws[0], changed, names)
    by_name = {test.name: test for test in changed.tests}
    layered = bool(changed.fit.placeholder_material_with_effects.layers)

    def extend_test_with_effect(test: ForwardTest) -> ForwardTest:
        """Return a test with experiment and rig of the changed campaign; a closed form is returned unchanged."""
        if not isinstance(test, SimulatedTest):
            return test
        asked = by_name[test.name]
        if asked.experiment is None:
            return test
        experiment = replace(asked.experiment, protocol=test.experiment.protocol)
        return replace(test, experiment=experiment, rig=asked.rig, layered=layered)

    return GeneralisedProblem(space, tuple(map(extend_test_with_effect, problem.tests)), problem.solves, problem.jitter,
                              problem.mesh_error), changed


def combine_free_values_with_effect_sizes(space: ParameterSpace, values: Mapping[str, float],
                                          sizes: Mapping[str, float]) -> np.ndarray:
    """Return the free parameters of a space, SI, shape (p,).

    Args:
        space: parameter space with an effect.
        values: name -> value of the parameters without the effect, SI.
        sizes: path -> value of the parameters of the effect, SI.
    """
    return np.array([values[each.name] if each.name in values else sizes[each.path] for each in space.free_parameters])


def simulate_whitened_effect_change_or_reason(problem: GeneralisedProblem, evaluation: ProblemEvaluation,
                                              campaign: Campaign,
                                              candidate: Candidate, factor: float = 1.0) -> np.ndarray | str:
    """Compute the change of the whitened model by an effect of its trial size.

    Args:
        problem: problem without the effect.
        evaluation: evaluation at its minimum.
        campaign: campaign of `problem`.
        candidate: candidate of the effect.
        factor: amplitude in units of the trial size.

    Returns:
        Change, shape (N, q): one column for all tests, or one for each specimen or test with its own parameters. If the
        simulation fails, the reason.
    """
    touched = [number for number, test in enumerate(problem.tests)
               if candidate.tests is None or test.name in candidate.tests]
    nuisances = np.concatenate([np.zeros(0), *(
        evaluation.nuisances[columns] for columns, (t, _) in zip(problem.offset_columns, problem.places, strict=True)
        if t in touched), *(evaluation.nuisances[first:last] for first, last in dict.fromkeys(
            (problem.shared[t].start, problem.shared[t].stop) for t in touched))])

    def make_fixed_problem_of_affected_tests(of: GeneralisedProblem) -> GeneralisedProblem:
        """Return the problem of the tests in `touched`, with all parameters of the fit fixed."""
        # Fixed parameters avoid the computation of derivatives.
        space = of.space.with_all_fixed(dict(zip(problem.space.free, evaluation.theta, strict=True)))
        return GeneralisedProblem(space, tuple(of.tests[t] for t in touched), of.solves, of.jitter,
                                  tuple(of.mesh_error[t] for t in touched))

    try:
        absent = {path: candidate.find_value_without_effect(campaign, path) for path in candidate.sizes}
        sizes = candidate.scale_trial_values(absent, factor)
        extended, _ = add_effect_to_problem_and_campaign(problem, campaign, candidate, sizes, free=False)
        with_it = make_fixed_problem_of_affected_tests(extended)
        # Both forces must be computed on one mesh and by one method, so that their difference is due to the effect.
        if not candidate.has_mesh_changing_shape_parameter(campaign):
            without = _match_full_motion_or_none(make_fixed_problem_of_affected_tests(problem), with_it)
        else:
            neutral, _ = add_effect_to_problem_and_campaign(problem, campaign, candidate, absent, free=False)
            without = make_fixed_problem_of_affected_tests(neutral)
        change = _compute_residual_at_given_nuisances(with_it, nuisances)
        # Without changes of mesh and method the residual without the effect is that of the evaluation.
        change -= np.concatenate([evaluation.residual[rows] for rows, (t, _) in zip(
            problem.rows, problem.places, strict=True) if t in touched]) if without is None else \
            _compute_residual_at_given_nuisances(without, nuisances)
    except (InfeasibleError, NotTestableError, InputError) as error:
        return str(error)
    groups: dict[str, np.ndarray] = {}
    for rows, (t, r) in zip(with_it.rows, with_it.places, strict=True):
        column = groups.setdefault(_get_effect_scope_key_of_test(with_it.tests[t], candidate),
                                   np.zeros(problem.samples))
        column[problem.rows[problem.places.index((touched[t], r))]] = change[rows]
    return np.column_stack(list(groups.values()))


def _match_full_motion_or_none(held: GeneralisedProblem,
                               other: GeneralisedProblem) -> GeneralisedProblem | None:
    """Return the problem with the whole motion simulated in the tests for which another problem requires it.

    Returns:
        The problem; None if no test changes.
    """
    def with_full_motion_if_other_needs_it(test: ForwardTest, of: ForwardTest) -> ForwardTest:
        """Return `test`, with the simulation of the whole motion requested if only `of` requires it."""
        if not (isinstance(test, SimulatedTest) and isinstance(of, SimulatedTest)):
            return test
        differs = test.can_use_position_curve_at_parameters(held.space, np.zeros(0)) \
            and not of.can_use_position_curve_at_parameters(
            other.space, np.zeros(0))
        return replace(test, full_motion=True) if differs else test

    tests = tuple(map(with_full_motion_if_other_needs_it, held.tests, other.tests))
    if all(one is test for one, test in zip(tests, held.tests, strict=True)):
        return None
    return GeneralisedProblem(held.space, tests, held.solves, held.jitter, held.mesh_error)


def _compute_residual_at_given_nuisances(held: GeneralisedProblem, nuisances: np.ndarray) -> np.ndarray:
    """Return the whitened model minus data of a problem without free parameters at given nuisances, shape (N,).

    Raises:
        InfeasibleError: see `ForwardTest.solve`.
    """
    answers = [test.solve(held.space, np.zeros(0), held.solves) for test in held.tests]
    return held._compute_whitened_terms_at_nuisances(answers, nuisances)[0]


def _get_effect_scope_key_of_test(test: ForwardTest, candidate: Candidate) -> str:
    """Return a key that is equal for tests with common parameters of a candidate."""
    if candidate.scope == "per_test":
        return test.name
    if candidate.scope == "per_specimen":
        specimen = test.measured[0].test.specimen
        return "" if specimen is None else specimen.name
    return ""
