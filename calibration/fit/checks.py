"""Checks of the first start of an inverse fit."""

from __future__ import annotations

import numpy as np

from calibration.campaign.campaign import Campaign
from calibration.fit.problem import GeneralisedProblem
from calibration.fit.starts import list_starts_with_varied_exponents
from calibration.forward.contract import InfeasibleError
from tissue_sim.errors import InputError
from tissue_sim.laws import find_law, find_stability_range

#: Norm of the change of all forces, in units of their noise, below which a change of a parameter by its own size counts
#: as undetectable.
UNSEEN = 0.1


def require_fittable_start(problem: GeneralisedProblem, campaign: Campaign, number: int) -> None:
    """Simulate the tests with the first starting values, and check that a fit can start from these values.

    Args:
        problem: problem of one law.
        campaign: campaign of the problem.
        number: index of the law in ``fit.laws``.

    Raises:
        InputError: a stated start or fixed value is invalid or unstable within the data, there are more unknowns than
            samples, or no test depends on a parameter; with file and field.
    """
    space, law = problem.space, find_law(problem.space.law)
    if problem.samples <= len(space.free):
        raise InputError(f"the tests must have more samples than the {len(space.free)} unknown parameters of "
                         f"{law.name}; got {problem.samples}. Increase max_strain, or choose a law with fewer "
                         "parameters", file=campaign.path, field=f"fit.laws[{number}]")
    theta = list_starts_with_varied_exponents(space, 1)[0]
    values = space.get_values_by_name(theta)
    stated = [name for name in space.select_law_parameter_values(values) if name in campaign.fit.start
              or name in campaign.fit.fixed]
    key = "start" if any(name in campaign.fit.start for name in stated) else "fixed"
    try:
        space.build_material(values)
    except InputError as error:
        raise InputError(f"the values must give a valid material of {law.name}; got: {error.problem}. Change them",
                         file=campaign.path, field=f"fit.{key}") from None
    if stated:
        _require_stable_law_in_homogeneous_tests(problem, theta, campaign, key)
    try:
        evaluation = problem.evaluate(theta)
    except InfeasibleError as error:
        if stated:
            raise InputError(f"the simulation of the tests with these parameter values fails ({error}). State other "
                             "values, or reduce max_strain", file=campaign.path, field=f"fit.{key}") from None
        return
    seen = np.linalg.norm(evaluation.rates, axis=0) * space.compute_typical_parameter_sizes(values)
    for name, size in zip(space.free, seen, strict=True):
        if size < UNSEEN and not np.isfinite(space.prior_deviation[space.free.index(name)]):
            field = f"fit.start.{name}" if name in campaign.fit.start else f"fit.laws[{number}]"
            raise InputError(f"the force of at least one test must depend on {name}; a change of {name} by its "
                             f"typical size changes the forces of all tests by only {size:.2g} times their noise. Fix "
                             f"{name} in [fit.fixed], or add a test that depends on {name}",
                             file=campaign.path, field=field)


def _require_stable_law_in_homogeneous_tests(problem: GeneralisedProblem, theta: np.ndarray, campaign: Campaign,
                                             key: str) -> None:
    """Raise an `InputError` if stated values make the law unstable within the data of a homogeneous test."""
    law, space = find_law(problem.space.law), problem.space
    own = law.convert_parameters_to_array(space.select_law_parameter_values(space.get_values_by_name(theta)))
    for test in problem.tests:
        if not test.is_homogeneous or not test.closed_form.rest:
            continue
        reached = test.compute_stretch_range(space, theta)
        low, high = reached.low, reached.high
        lower, upper = find_stability_range(law, own, (min(low, 0.99), max(high, 1.01))).limits[test.closed_form.mode]
        if lower > low or upper < high:
            limit, end = (lower, low) if lower > low else (upper, high)
            raise InputError(f"the values must make {law.name} stable up to stretch {end:.3g}, which {test.name} "
                             f"reaches; the law loses stability at stretch {limit:.3g}. Change the values",
                             file=campaign.path, field=f"fit.{key}")
