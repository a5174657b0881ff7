"""From a campaign and its recordings to the least-squares problem of a law."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from calibration.campaign.campaign import Campaign
from calibration.campaign.measured import MeasuredCurve, default_contact_deviation
from calibration.campaign.parameter_space import ParameterSpace
from calibration.fit.problem import Problem
from calibration.forward.forms import build_test, remainder
from calibration.forward.meshes import FAST_REMAINDERS
from calibration.forward.solves import Solves
from calibration.statistics.jitter import Jitter

#: Standard deviation of the zero with which an estimate of the jitter begins, and which is assumed where no test has
#: two recordings, as a share of the largest force.
FIRST_ZERO = 0.002


def build_problem(law: str, campaign: Campaign, measured: Mapping[str, Sequence[MeasuredCurve]],
                  solves: Solves) -> Problem:
    """The least-squares problem of one law over all tests that are not held out.

    Args:
        law: its name. campaign: what is asked. measured: test -> its recordings. solves: what has been simulated.
    """
    names = {test: [curve.name for curve in curves] for test, curves in measured.items()}
    space = ParameterSpace.of(law, campaign, names)
    fitted = [test for test in campaign.tests if not test.hold_out]
    jitter = first_jitter(campaign, [curve for test in fitted for curve in measured[test.name]])
    tests = tuple(build_test(test, measured[test.name], campaign.fit, jitter.contact) for test in fitted)
    # What the fast mesh is off is no misfit that offsets should make up for.
    return Problem(space, tests, solves, jitter, tuple(remainder(test, FAST_REMAINDERS) for test in tests))


def first_jitter(campaign: Campaign, curves: Sequence[MeasuredCurve]) -> Jitter:
    """What is stated, and a first guess where it is to be estimated."""
    fit, noise = campaign.fit, campaign.noise
    contact, zero, freedom = noise.contact_jitter, noise.zero_jitter, None
    largest = float(np.median([np.abs(curve.force).max() for curve in curves]))
    if fit.offset == "fit":
        contact, zero = fit.offset_prior, fit.zero_prior or 5.0 * max(curve.noise.deviation for curve in curves)
    if contact is None:
        contact, freedom = default_contact_deviation(curves), 0
    if zero is None:
        zero, freedom = FIRST_ZERO * largest, 0
    return Jitter(contact, zero, freedom)
