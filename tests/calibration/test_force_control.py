"""Fits of recordings whose force is controlled: the noise is in the displacement."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

import calibration
import tissue_sim as ts
from calibration.campaign.campaign import load_campaign
from calibration.campaign.measured import read_measured_curves
from calibration.fit.curves import compute_test_curves
from calibration.fit.problem import build_generalised_problem
from calibration.fit.trust_region import minimise_from_start
from calibration.forward.contract import InfeasibleError
from calibration.forward.force_control import evaluate_residual_under_force_control
from calibration.forward.motion import TimedMotion
from calibration.forward.simulation_cache import SimulationCache
from calibration.report.quantities import ReportUnits
from calibration.report.views import get_law_trace_or_none, list_panels_of_test
from calibration.statistics.sensor_noise import ForceControlNoise
from tissue_sim.recording.segments import find_segments_of_arrays

#: Campaigns of the short version of the study.
CAMPAIGNS = 24
SERIES = ts.Prony((ts.PronyTerm(0.3, 8.0), ts.PronyTerm(0.2, 0.5)))


@pytest.fixture(scope="module")
def creep(benchmark_module):
    """The benchmark ``creep``."""
    return benchmark_module("inverse.creep")


@pytest.fixture(scope="module")
def true(creep):
    """Creep test without noise."""
    return creep.simulate_creep()


@pytest.fixture
def campaign_file(tmp_path):
    """Function that writes recordings and a campaign, and returns its path."""
    def write(recordings, text):
        for name, recording in recordings.items():
            np.savetxt(tmp_path / f"{name}.csv", np.column_stack(
                [recording.time, 1e3 * recording.displacement, recording.force]), delimiter=",",
                header="time [s],displacement [mm],force [N]", comments="", fmt="%.12g")
        path = tmp_path / "campaign.toml"
        path.write_text(text)
        return path

    return write


def noisy(recording, noise, seed):
    displacement = recording.displacement + noise * np.random.default_rng(seed).normal(size=recording.time.size)
    return ts.Recording({"time": recording.time, "displacement": displacement, "force": recording.force})


def test_the_hereditary_integral_is_inverted():
    """The integral of the solution is the right-hand side; a step gives the creep function of one Prony term."""
    time = np.concatenate([[0.0], np.geomspace(1e-3, 50.0, 200)])
    response = np.random.default_rng(1).normal(size=(time.size, 2))
    elastic = SERIES.solve_for_elastic_history(time, response)
    history = ts.closed_form.histories.compute_internal_stress_history_over_g(np.diff(time, prepend=0.0), elastic,
                                                                              SERIES.tau)
    np.testing.assert_allclose((1 - SERIES.relaxing_fraction) * elastic + history @ SERIES.g, response, atol=1e-12)
    single, fine = ts.Prony((ts.PronyTerm(0.4, 2.0),)), np.linspace(0.0, 20.0, 4001)
    creeping = single.solve_for_elastic_history(fine, np.ones((fine.size, 1)))[:, 0]
    np.testing.assert_allclose(creeping, (1 - 0.4 * np.exp(-fine * 0.6 / 2.0)) / 0.6, rtol=1e-6)


def test_intervals_of_creep_tests_contain_the_true_values(creep, true):
    """The mean error stays below half a standard error, and the scatter agrees with the standard errors."""
    found = creep.judge([creep.run_campaign(true, number, 7) for number in range(CAMPAIGNS)])
    for name, each in found.items():
        # 24 campaigns: 5 standard errors of the scatter, and coverage with a probability below 1e-3 of less.
        assert 0.5 < each["scatter"] < 1.7 and abs(each["mean"]) < 1.0 and each["coverage"] >= 0.79, (name, each)


def residuals_at_truth(creep, true, campaign_file, noise, count, moves):
    """Whitened residuals, (count, n), and errors of one linear step over their standard errors, (count, 3)."""
    curves = read_measured_curves(load_campaign(campaign_file({"creep": true}, creep.CAMPAIGN.format(control="force"))))
    curve = curves["lubricated_compression"][0]
    problem = creep.OrdinaryLeastSquaresEstimator(
        load_campaign(curve.file.with_name("campaign.toml")), curves, SimulationCache()).build_law_problem(creep.LAW)
    theta = np.array([creep.TRUTH[name] for name in problem.space.free])
    residuals, scores = [], []
    for seed in range(count):
        mine = replace(curve, displacement=noisy(true, noise, seed).displacement,
                       noise=replace(curve.noise, deviation=1.0), force_control=ForceControlNoise(noise, 1e-6))
        test = replace(problem.tests[0], measured=(mine,))
        residual, rates, _ = evaluate_residual_under_force_control(
            test, test.solve(problem.space, theta, problem.solves), 0, 0.0, 0.0, moves)
        rates = rates[:, :theta.size]
        covariance = np.linalg.inv(rates.T @ rates)
        residuals.append(residual)
        scores.append(-covariance @ rates.T @ residual / np.sqrt(np.diag(covariance)))
    return np.array(residuals), np.array(scores)


def test_residuals_are_the_noise_of_the_displacement(creep, true, campaign_file):
    """At the true parameters the whitened residuals equal the noise; without the Newton step the estimate is biased."""
    residuals, scores = residuals_at_truth(creep, true, campaign_file, 5e-5, 60, True)
    noise = np.array([noisy(true, 5e-5, seed).displacement - true.displacement for seed in range(60)]) / 5e-5
    np.testing.assert_allclose(residuals, noise, atol=0.05)
    assert np.abs(scores.mean(axis=0)).max() < 0.4 and scores.std(axis=0) == pytest.approx(np.ones(3), abs=0.3)
    _, scores = residuals_at_truth(creep, true, campaign_file, 5e-5, 20, False)
    assert np.abs(scores.mean(axis=0)).max() > 1.5


def test_the_report_draws_the_displacement_of_a_creep_test(creep, true, campaign_file):
    """The panels are displacement over time and creep in holds, and the law is the displacement at the force."""
    path = campaign_file({"creep": noisy(true, 1e-5, 2)}, creep.CAMPAIGN.format(control="force"))
    campaign = load_campaign(path)
    estimator = creep.OrdinaryLeastSquaresEstimator(campaign, read_measured_curves(campaign), SimulationCache())
    _, estimate = creep.fit_law_to_descents_and_estimate(estimator.build_law_problem(creep.LAW))
    spread = estimator.problem_uncertainty_function(estimate.problem, estimate.evaluation)
    curves, = compute_test_curves(estimate, spread, [(estimate.problem.tests[0], 0.0)], None)
    panels = list_panels_of_test(curves, ReportUnits.choose_for_typical_sizes(2e-3, 3.0, 1e4))
    assert [panel.title for panel in panels][-2:] == ["Displacement over time", "Creep in holds"]
    trace = get_law_trace_or_none(curves, shows_displacement_response=panels[-1].shows_displacement_response)
    np.testing.assert_allclose(trace.displacement, true.displacement, atol=1e-5)
    assert trace.displacement[-1] > 1.2 * trace.displacement[45]


ELASTIC = """
[[specimen]]
name = "gel"
radius_mm = 20.0
height_mm = 20.0
[[test]]
kind = "lubricated_compression"
specimen = "gel"
recordings = ["ramp.csv"]
{test}
[fit]
method = "{method}"
laws = ["neo_hooke"]
{fit}
[noise]
displacement_mm = 0.01
force_N = 1e-6
{noise}
"""


def test_an_elastic_ramp_of_the_force_equals_least_squares_on_the_displacement(campaign_file):
    """The fit equals a separate fit of the displacement at the measured force, with its standard error."""
    from scipy.optimize import brentq, least_squares

    force, area = np.linspace(0.0, 6.0, 201), np.pi * 0.02**2

    def displacements(C10):
        return np.array([0.02 * (1 - brentq(lambda x, f: 2 * C10 * (1 / x**2 - x) * area - f, 0.2, 1.1, (f,)))
                         for f in force])

    exact = ts.Recording({"time": 0.05 * np.arange(201), "displacement": displacements(5e3), "force": force})
    path = campaign_file({"ramp": noisy(exact, 1e-5, 3)}, ELASTIC.format(test='control = "force"', method="analytical",
                                                                       fit="", noise=""))
    fit = calibration.calibrate([path], path.parent / "out")[0].fits[0]
    recorded = noisy(exact, 1e-5, 3).displacement
    apart = least_squares(lambda x: (displacements(1e3 * x[0]) - recorded) / 1e-5, [5.5], x_scale=0.1, xtol=1e-12)
    assert fit.parameters["C10"] == pytest.approx(1e3 * apart.x[0], rel=1e-5)
    error = 1e3 / float(np.linalg.norm(apart.jac))
    assert fit.standard_errors["C10"] == pytest.approx(error, rel=0.03)


@pytest.mark.parametrize("jitter", ["contact_jitter_mm = 0.02", "zero_jitter_N = 0.03"])
def test_jitter_of_contact_and_zero_widens_the_interval(jitter, campaign_file):
    """The standard error is that of the noise, and the change of the estimate by one deviation of the jitter."""
    force = np.linspace(0.0, 6.0, 201)
    stretch = ts.stretch_history(ts.Material("neo_hooke", {"C10": 5e3}), 0.05 * np.arange(201),
                                 -force / (np.pi * 0.02**2))
    exact = ts.Recording({"time": 0.05 * np.arange(201), "displacement": 0.02 * (1 - stretch), "force": force})
    recorded = noisy(exact, 1e-5, 3)

    def fit(recording, noise):
        path = campaign_file({"ramp": recording}, ELASTIC.format(test='control = "force"', method="analytical", fit="",
                                                               noise=noise))
        return calibration.calibrate([path], path.parent / f"out_{recording.force[0]}_{recording.displacement[0]}_"
                                     f"{bool(noise)}")[0].fits[0]

    contact, zero = (2e-5, 0.0) if "contact" in jitter else (0.0, 0.03)
    moved = ts.Recording({"time": recorded.time, "displacement": recorded.displacement + contact,
                          "force": recorded.force + zero})
    before, shifted, widened = fit(recorded, ""), fit(moved, ""), fit(recorded, jitter)
    change = shifted.parameters["C10"] - before.parameters["C10"]
    assert abs(change) > 3 * before.standard_errors["C10"]
    expected = np.hypot(before.standard_errors["C10"], change)
    assert widened.standard_errors["C10"] == pytest.approx(expected, rel=0.03)


def test_finite_elements_find_the_parameters_of_a_creep_test(creep, true, campaign_file):
    """The residuals of the inverse fit are white, and its estimate is within 1 % of the truth."""
    text = creep.CAMPAIGN.format(control="force").replace("analytical", "inverse_fem")
    text += "[noise]\ncontact_jitter_mm = 0.002\nzero_jitter_N = 0.001\n"
    campaign = load_campaign(campaign_file({"creep": noisy(true, 5e-6, 1)}, text))
    problem = build_generalised_problem(creep.LAW, campaign, read_measured_curves(campaign), SimulationCache())
    truth = np.array([creep.TRUTH[name] for name in problem.space.free])
    found = minimise_from_start(problem, 1.1 * truth, start=1)
    assert np.sqrt(np.mean(problem.evaluate(found.theta).residual**2)) == pytest.approx(1.0, abs=0.08)
    np.testing.assert_allclose(found.theta, truth, rtol=0.01)


#: Viscoelastic material of the imported recordings.
GEL = ts.Material("neo_hooke", {"C10": 5e3}, viscoelastic=ts.Prony((ts.PronyTerm(0.3, 8.0),)))


@pytest.mark.parametrize(("times", "forces", "segments", "reason"), [
    ([0, 2], [0, 14], ["ramp"], "the force is a line in time"),
    ([0, 2, 60], [0, 3, 3], ["ramp", "hold"], "the force is held while the displacement creeps"),
    ([0, 2, 40, 42, 80], [0, 3, 3, 0.02, 0.02], ["ramp", "hold", "unload", "hold"],
     "the force is held while the displacement creeps"),
    ([0, 4, 8, 12, 16, 20], [0, 6, 2, 6, 2, 6], ["ramp", "unload", "reload", "unload", "reload"],
     "the force is a line in time"),
], ids=["ramp", "creep", "creep and recovery", "cycles"])
def test_import_states_the_controlled_force(times, forces, segments, reason, tmp_path):
    """The segments are those of the force, although the displacement creeps with noise."""
    time = np.linspace(0.0, times[-1], 401)
    force = np.interp(time, times, forces)
    stretch = ts.stretch_history(GEL, time, -force / (np.pi * 0.02**2))
    rng = np.random.default_rng(4)
    np.savetxt(tmp_path / "compression.csv", np.column_stack([
        time, 1e3 * (0.02 * (1 - stretch) + 5e-6 * rng.normal(size=401)), force + 1e-3 * rng.normal(size=401)]),
        delimiter=",", header="Time (s),Displacement (mm),Force (N)", comments="", fmt="%.6g")
    found = calibration.import_files([tmp_path / "compression.csv"])
    assert 'control = "force"' in found.text and reason in found.text
    motion = found.tests[0].parts[0].motions[0]
    assert [each.name for each in motion.segments] == segments
    assert motion.screening.control.quantity == "force"


def test_import_of_a_rheometer_creep_test_with_the_set_stress(tmp_path):
    """The stress has one value from the first sample on: the stress is controlled, and the material creeps."""
    time = np.geomspace(1e-2, 100.0, 200)
    strain = 10.0 / 1000.0 * (1 - 0.5 * np.exp(-time / 20.0)) / 0.5
    np.savetxt(tmp_path / "creep.txt", np.column_stack([time, strain, np.full(200, 10.0)]), delimiter="\t",
               header="t\tstrain\tstress\ns\t-\tPa", comments="", fmt="%.5g")
    stated = ts.recording.formats.guesses.InterpretationOverrides(kind="simple_shear")
    found = calibration.import_files([tmp_path / "creep.txt"], tmp_path / "creep.toml",
                                     calibration.ImportOptions(stated=stated))
    assert 'control = "force"' in found.text and '"viscoelastic.terms[0].g"' in found.text
    assert [each.name for each in found.tests[0].parts[0].motions[0].segments] == ["hold"]
    fit = next(fit for fit in calibration.calibrate([tmp_path / "creep.toml"], tmp_path / "out")[0].fits
               if fit.law == "neo_hooke")
    # 2 C10 is the modulus at once, 1000 Pa; the retardation time 20 s is that of relaxation over 1 - g.
    assert fit.parameters["C10"] == pytest.approx(500.0, rel=0.01)
    assert fit.parameters["viscoelastic.terms[0].g"] == pytest.approx(0.5, rel=0.02)
    assert fit.parameters["viscoelastic.terms[0].tau"] == pytest.approx(10.0, rel=0.05)


def creep_of_a_step(time, noise):
    """Displacement, m, of creep under a constant force from the first sample on, with noise."""
    return 2e-3 * (1 - 0.4 * np.exp(-time / 10.0)) / 0.6 + noise * np.random.default_rng(5).normal(size=time.size)


@pytest.mark.parametrize("noise", [0.0, 1e-6, 1e-3, 0.03])
def test_the_motion_of_a_held_force_begins_with_a_sudden_step(noise):
    """Noise of the load cell makes no corners, and the creep is not extrapolated back to first contact."""
    time = np.linspace(0.0, 60.0, 301)
    force = 3.0 + noise * np.random.default_rng(6).normal(size=301)
    motion = TimedMotion.from_recording(time, creep_of_a_step(time, 1e-5), force=force)
    assert len(motion.legs) == 2 and motion.creeping == motion.legs[1:]
    assert motion.displacement[0] == 0.0 and -0.02 < motion.time[0] < 0.0
    np.testing.assert_allclose(motion.interpolate_displacement(time), creep_of_a_step(time, 0.0), atol=1.5e-5)


def test_the_motion_of_a_ramp_of_the_force_begins_at_zero_force():
    """A ramp that is recorded from 1 N on is extrapolated to zero force, and noise of 1 % makes no corners."""
    time = np.linspace(0.0, 4.0, 401)
    for noise, error in ((0.0, 1e-9), (0.03, 0.1)):
        force = 1.0 + time + noise * np.random.default_rng(7).normal(size=401)
        motion = TimedMotion.from_recording(time, 1e-3 * np.sqrt(1.0 + time), force=force)
        assert len(motion.legs) == 2 and motion.time[0] == pytest.approx(-1.0, abs=error)


def test_the_motion_of_a_step_from_rest_begins_at_rest():
    """A recording with one sample before the step keeps the displacement of this sample."""
    time = np.append(0.0, np.linspace(0.2, 60.0, 300))
    motion = TimedMotion.from_recording(time, np.append(0.0, creep_of_a_step(time[1:], 1e-6)),
                                        force=np.append(0.0, np.full(300, 3.0)))
    assert motion.time[0] == 0.0 and motion.displacement[0] == pytest.approx(0.0, abs=1e-12)


def test_a_constant_force_with_noise_is_one_hold(campaign_file, creep):
    """The noise of both channels is estimated from all samples, for each of the seeds."""
    time = np.linspace(0.0, 60.0, 301)
    for seed in (0, 3, 4):
        rng = np.random.default_rng(seed)
        rng.normal(size=301)
        recorded = ts.Recording({"time": time, "displacement": creep_of_a_step(time, 1e-5),
                                 "force": 3.0 + 1e-3 * rng.normal(size=301)})
        path = campaign_file({"creep": recorded}, creep.CAMPAIGN.format(control="force"))
        curve, = read_measured_curves(load_campaign(path))["lubricated_compression"]
        assert set(curve.segment.tolist()) == {"hold"}
        assert curve.force_control.force == pytest.approx(1e-3, rel=0.15)
        assert curve.force_control.displacement == pytest.approx(1e-5, rel=0.15)


def test_segments_are_those_of_a_stated_force():
    """A monotonic force that is no line in time, with much noise of the displacement, is one ramp."""
    time = np.linspace(0.0, 10.0, 201)
    force = 10.0 * (1 - np.cos(np.pi * time / 10.0))
    displacement = 5e-3 * np.log1p(force) + 1e-4 * np.random.default_rng(8).normal(size=201)
    found = find_segments_of_arrays(displacement, force, time)
    stated = find_segments_of_arrays(displacement, force, time, control="force")
    assert "unload" in found.labels
    assert "unload" not in stated.labels and stated.cycles.max() == 1


@dataclass(frozen=True)
class PowerLaw:
    """Elastic test with the force `size` d^4, N, which has a soft toe.

    Attributes:
        measured: the recording.
        size: factor, N/m^4.
    """

    measured: tuple
    size: float

    def evaluate_force_and_derivatives(self, answer, recording, offset):
        depth = self.measured[recording].displacement - offset
        return self.size * depth**4, np.zeros((depth.size, 0)), -4 * self.size * depth**3

    def remove_memory(self, answer, recording, columns):
        return columns


def power_law_test(campaign_file, creep, size):
    """Recording of a power law of 1e9 N/m^4 under force control, with noise of the displacement of 1 um."""
    force = np.linspace(0.0, 1.0, 301)[1:]**4
    exact = (force / 1e9)**0.25
    recorded = ts.Recording({"time": np.arange(300.0), "displacement": exact, "force": force})
    curve, = read_measured_curves(load_campaign(campaign_file(
        {"creep": recorded}, creep.CAMPAIGN.format(control="force"))))["lubricated_compression"]
    noise = 1e-6 * np.random.default_rng(9).normal(size=300)
    return PowerLaw((replace(curve, displacement=exact + noise, noise=replace(curve.noise, deviation=1.0),
                             force_control=ForceControlNoise(1e-6, 1e-12)),), size), noise / 1e-6


def test_residuals_in_a_soft_toe_are_the_noise_of_the_displacement(campaign_file, creep):
    """The stiffness of the toe is 1e-4 of the median; the residuals beyond the noise at contact equal the noise."""
    test, noise = power_law_test(campaign_file, creep, 1e9)
    residual, _, _ = evaluate_residual_under_force_control(test, None, 0, 0.0, 0.0, True)
    np.testing.assert_allclose(residual[5:], noise[5:], rtol=0.02, atol=0.02)


@pytest.mark.parametrize("size", [0.0, -1e9])
@pytest.mark.filterwarnings("error")
def test_a_law_without_stiffness_is_infeasible_under_force_control(size, campaign_file, creep):
    """A model whose force does not increase with the displacement is refused without a warning of NumPy."""
    test, _ = power_law_test(campaign_file, creep, size)
    with pytest.raises(InfeasibleError, match="stiffness of the model must be positive"):
        evaluate_residual_under_force_control(test, None, 0, 0.0, 0.0, True)
