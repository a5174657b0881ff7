"""Construction of the least-squares problem of a law from a campaign and its recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from calibration.campaign.campaign import Campaign
from calibration.campaign.measured import MeasuredCurve, compute_default_contact_offset_deviation
from calibration.campaign.offset_defaults import OFFSET_DEFAULTS
from calibration.campaign.parameter_space import ParameterSpace
from calibration.fit.problem import GeneralisedProblem
from calibration.forward.forms import build_forward_test_of_inverse_fit, compute_mesh_uncertainty
from calibration.forward.meshes import FAST_MESH_ERRORS
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.jitter import ContactAndForceZeroJitter


def build_generalised_problem(law: str, campaign: Campaign, measured: Mapping[str, Sequence[MeasuredCurve]],
                              solves: SimulationCache) -> GeneralisedProblem:
    """Return the least-squares problem of one law over all tests that are not held out.

    Args:
        law: name of the law.
        campaign: campaign.
        measured: test -> its recordings.
        solves: cache of simulations.
    """
    names = {test: [curve.name for curve in curves] for test, curves in measured.items()}
    space = ParameterSpace.from_campaign(law, campaign, names)
    fitted = [test for test in campaign.tests if not test.hold_out]
    jitter = make_stated_or_guessed_jitter(campaign, [curve for test in fitted for curve in measured[test.name]])
    tests = tuple(build_forward_test_of_inverse_fit(test, measured[test.name], campaign.fit, jitter.contact)
                  for test in fitted)
    # With the error of the fast mesh in the covariance, offsets do not compensate for this error.
    return GeneralisedProblem(space, tests, solves, jitter,
                              tuple(compute_mesh_uncertainty(test, FAST_MESH_ERRORS) for test in tests))


def make_stated_or_guessed_jitter(campaign: Campaign, curves: Sequence[MeasuredCurve]) -> ContactAndForceZeroJitter:
    """Return one jitter for all tests: stated values, or first guesses of values that are estimated later."""
    fit, noise = campaign.fit, campaign.noise
    contact, zero, freedom = noise.contact_jitter, noise.zero_jitter, None
    largest = float(np.median([np.abs(curve.force).max() for curve in curves]))
    if fit.offset == "fit":
        noisiest = max(curve.noise.deviation for curve in curves)
        contact, zero = fit.offset_prior, fit.zero_prior or OFFSET_DEFAULTS.zero_prior * noisiest
    if contact is None:
        contact, freedom = compute_default_contact_offset_deviation(curves), 0
    if zero is None:
        zero, freedom = OFFSET_DEFAULTS.first_zero * largest, 0
    return ContactAndForceZeroJitter(contact, zero, freedom)
