"""Checks of the first start of an inverse fit."""

from __future__ import annotations

import numpy as np

from calibration.campaign.campaign import Campaign
from calibration.fit.problem import Problem
from calibration.fit.starts import generate_starts
from calibration.forward.contract import InfeasibleError
from tissue_sim.errors import InputError
from tissue_sim.laws import check_stability, find_law

#: Norm of the change of all forces, in units of their noise, below which a change of a parameter by its own size counts
#: as undetectable.
UNSEEN = 0.1


def check_start(problem: Problem, campaign: Campaign, number: int) -> None:
    """Simulate the first start and check it.

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
        raise InputError(f"{law.name} has {len(space.free)} unknown parameters and the tests only {problem.samples} "
                         "points; widen max_strain or take a simpler law", file=campaign.path,
                         field=f"fit.laws[{number}]")
    theta = generate_starts(space, 1)[0]
    values = space.values(theta)
    stated = [name for name in space.select_law_parameters(values) if name in campaign.fit.start
              or name in campaign.fit.fixed]
    key = "start" if any(name in campaign.fit.start for name in stated) else "fixed"
    try:
        space.build_material(values)
    except InputError as error:
        raise InputError(f"{law.name} is no valid material with this start: {error.problem}", file=campaign.path,
                         field=f"fit.{key}") from None
    if stated:
        _check_stable(problem, theta, campaign, key)
    try:
        evaluation = problem.evaluate(theta)
    except InfeasibleError as error:
        if stated:
            raise InputError(f"the simulation fails within the data with this start ({error}); state another start, or "
                             "a smaller max_strain", file=campaign.path, field=f"fit.{key}") from None
        return
    seen = np.linalg.norm(evaluation.rates, axis=0) * space.typical_sizes(values)
    for name, size in zip(space.free, seen, strict=True):
        if size < UNSEEN and not np.isfinite(space.prior_deviation[space.free.index(name)]):
            field = f"fit.start.{name}" if name in campaign.fit.start else f"fit.laws[{number}]"
            raise InputError(f"no test depends on {name}: a change by its own size changes all forces together by "
                             f"{size:.2g} of their noise; fix it in [fit.fixed], or add a test that depends on it",
                             file=campaign.path, field=field)


def _check_stable(problem: Problem, theta: np.ndarray, campaign: Campaign, key: str) -> None:
    """Raise an `InputError` if stated values make the law unstable within the data of a homogeneous test."""
    law, space = find_law(problem.space.law), problem.space
    own = law.as_array(space.select_law_parameters(space.values(theta)))
    for test in problem.tests:
        if not test.homogeneous or not test.closed_form.rest:
            continue
        reached = test.stretch_range(space, theta)
        low, high = reached.low, reached.high
        lower, upper = check_stability(law, own, (min(low, 0.99), max(high, 1.01))).limits[test.closed_form.mode]
        if lower > low or upper < high:
            limit, end = (lower, low) if lower > low else (upper, high)
            raise InputError(f"{law.name} loses stability at stretch {limit:.3g} with this start, inside the data of "
                             f"{test.name} (to {end:.3g}); choose values that are stable there", file=campaign.path,
                             field=f"fit.{key}")
