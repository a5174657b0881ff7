"""What is refused before an inverse fit begins, because nothing good would come of it."""

from __future__ import annotations

import numpy as np

from calibration.campaign.campaign import Campaign
from calibration.fit.problem import Problem
from calibration.fit.starts import starts
from calibration.forward.contract import InfeasibleError
from tissue_sim.errors import InputError
from tissue_sim.laws import check_stability, find_law

#: A parameter is unseen where a change by its own size moves all forces together by less than this, in units of
#: their noise.
UNSEEN = 0.1


def check_start(problem: Problem, campaign: Campaign, number: int) -> None:
    """Simulate the first start once and look at it.

    Args:
        problem: of one law. campaign: where it comes from. number: of the law in ``fit.laws``.

    Raises:
        InputError: a stated start (or fixed value) that no material has or that is unstable inside the data, more
            unknowns than samples, a parameter that no test can see; with the file and the field.
    """
    space, law = problem.space, find_law(problem.space.law)
    if problem.samples <= len(space.free):
        raise InputError(f"{law.name} has {len(space.free)} unknown parameters and the tests only {problem.samples} "
                         "points; widen max_strain or take a simpler law", file=campaign.path,
                         field=f"fit.laws[{number}]")
    theta = starts(space, 1)[0]
    values = space.values(theta)
    stated = [name for name in space.of_law(values) if name in campaign.fit.start or name in campaign.fit.fixed]
    key = "start" if any(name in campaign.fit.start for name in stated) else "fixed"
    try:
        space.material(values)
    except InputError as error:
        raise InputError(f"{law.name} is no material with this start: {error.problem}", file=campaign.path,
                         field=f"fit.{key}") from None
    if stated:
        _check_stable(problem, theta, campaign, key)
    try:
        evaluation = problem.evaluate(theta)
    except InfeasibleError as error:
        if stated:
            raise InputError(f"the simulation does not get through the data with this start ({error}); state another "
                             "one, or a smaller max_strain", file=campaign.path, field=f"fit.{key}") from None
        return
    seen = np.linalg.norm(evaluation.rates, axis=0) * space.sizes(values)
    for name, size in zip(space.free, seen, strict=True):
        if size < UNSEEN and not np.isfinite(space.prior_deviation[space.free.index(name)]):
            field = f"fit.start.{name}" if name in campaign.fit.start else f"fit.laws[{number}]"
            raise InputError(f"no test can see {name}: changing it by its own size moves all forces together by "
                             f"{size:.2g} of their noise; fix it in [fit.fixed], or add a test that it acts on",
                             file=campaign.path, field=field)


def _check_stable(problem: Problem, theta: np.ndarray, campaign: Campaign, key: str) -> None:
    """Refuse a stated law that loses stability in a homogeneous test inside its data."""
    law, space = find_law(problem.space.law), problem.space
    own = law.as_array(space.of_law(space.values(theta)))
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
