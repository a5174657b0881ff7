"""Starts and bounds of dimensionless parameters that follow from the strains of the data, and fits of such laws."""

import numpy as np
import pytest

import calibration
import tissue_sim as ts
from calibration.campaign.measured import read_measured_curves
from calibration.fit.generalised import list_starts_with_varied_exponents
from calibration.fit.ordinary import OrdinaryLeastSquaresEstimator
from calibration.fit.ordinary_problem import compute_analytical_starts
from calibration.forward.simulation_cache import SimulationCache

CAMPAIGN = """
[[specimen]]
radius_mm = 40.0
height_mm = 70.0

[[test]]
kind = "lubricated_compression"
recordings = ["run.csv"]

[fit]
laws = [LAWS]
MORE

[noise]
force_N = 0.001
"""
TRUTH = {"gent": {"mu": 2800.0, "J_m": 1.2}, "arruda_boyce": {"mu": 2800.0, "lambda_m": 1.3},
         "fung_demiray": {"mu": 2800.0, "b": 1.4}}
#: Displacement, m; the last stretch is 0.5.
DISPLACEMENT = np.linspace(0.0, 0.035, 71)
#: Largest I1 - 3 of this compression.
LARGEST_STRAIN = 0.25 + 4.0 - 3.0


def write_campaign(folder, law, *, more="", laws=None):
    force = -np.pi * 0.04**2 * ts.find_law(law).nominal_stress(1 - DISPLACEMENT / 0.07, TRUTH[law])
    keep = np.isfinite(force)
    ts.write_recording(ts.Recording({"displacement": DISPLACEMENT[keep], "force": force[keep]}), folder / "run.csv")
    text = CAMPAIGN.replace("LAWS", laws or f'"{law}"').replace("MORE", more)
    (folder / "study.toml").write_text(text, encoding="utf-8")
    return folder / "study.toml"


def build_problem(path, law):
    campaign = calibration.load_campaign(path)
    return OrdinaryLeastSquaresEstimator(campaign, read_measured_curves(campaign), SimulationCache()).build_law_problem(
        law)


def test_the_largest_strain_bounds_gent_from_below(tmp_path):
    """The data end before I1 - 3 = J_m = 1.2, so that the bound is below the truth."""
    problem = build_problem(write_campaign(tmp_path, "gent"), "gent")
    stretch = 1 - problem.tests[0].measured[0].displacement.max() / 0.07
    largest = stretch**2 + 2 / stretch - 3
    assert largest == problem.space.low[1] < TRUTH["gent"]["J_m"] and problem.space.low[0] == -np.inf
    assert not np.isfinite(ts.find_law("gent").nominal_stress(stretch, {"mu": 1.0, "J_m": largest}))
    assert np.isfinite(ts.find_law("gent").nominal_stress(stretch, {"mu": 1.0, "J_m": largest * (1 + 1e-9)}))


def test_overflow_bounds_the_exponential_law_from_above(tmp_path):
    problem = build_problem(write_campaign(tmp_path, "arruda_boyce", laws='"fung_demiray"'), "fung_demiray")
    assert problem.space.low[1] == 0.0
    assert problem.space.high[1] == pytest.approx(300.0 / LARGEST_STRAIN, rel=1e-12)


@pytest.mark.parametrize("law", TRUTH)
def test_starts_give_finite_stresses(tmp_path, law):
    problem = build_problem(write_campaign(tmp_path, law), law)
    low, high = problem.space.low, problem.space.high
    for theta in [*compute_analytical_starts(problem), *list_starts_with_varied_exponents(problem.space, 5)]:
        assert (low <= theta).all() and (theta <= high).all()
        assert np.isfinite(problem.evaluate(theta).residual).all()


def test_bounds_that_exclude_the_data_are_refused(tmp_path):
    path = write_campaign(tmp_path, "arruda_boyce", more="[fit.bounds]\nJ_m = [0.1, 0.5]", laws='"gent"')
    with pytest.raises(ts.InputError, match=r"must include values from 1\.25 to inf") as raised:
        build_problem(path, "gent")
    assert raised.value.field == "fit.bounds.J_m"


def test_a_campaign_names_a_law_by_its_alias(tmp_path):
    campaign = calibration.load_campaign(write_campaign(tmp_path, "arruda_boyce", laws='"yeoh"'))
    assert campaign.fit.laws == ("reduced_polynomial_3",)
    with pytest.raises(ts.InputError, match="yeoh is listed twice"):
        calibration.load_campaign(write_campaign(tmp_path, "arruda_boyce", laws='"reduced_polynomial_3", "yeoh"'))


@pytest.mark.slow
@pytest.mark.parametrize("law", TRUTH)
def test_fits_recover_the_parameters(tmp_path, law):
    result, = calibration.calibrate([write_campaign(tmp_path, law)], tmp_path / "out", figures=False)
    assert result.best.parameters == pytest.approx(TRUTH[law], rel=1e-6)
    material = ts.load_material(tmp_path / "out" / f"{law}.material.json")
    assert material.law == law and dict(material.parameters) == pytest.approx(TRUTH[law], rel=1e-6)
