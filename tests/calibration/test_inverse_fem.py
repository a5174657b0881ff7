"""The inverse calibration: the least-squares problem, what it finds, what it says of it, and what it refuses."""

import pickle
from dataclasses import replace
from pathlib import Path

import distributed
import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import calibration
import tissue_sim as ts
from calibration.campaign.campaign import Noise
from calibration.campaign.parameter_space import ParameterSpace
from calibration.fit.estimate import iterate_mesh_correction_and_jitter
from calibration.fit.generalised import list_starts_with_varied_exponents, require_fittable_start
from calibration.fit.problem import build_generalised_problem
from calibration.fit.trust_region import minimise_from_start
from calibration.fit.uncertainty import compute_marginal_uncertainty, compute_profile_side
from calibration.forward.motion import TimedMotion
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.jitter import ContactAndForceZeroJitter
from tissue_sim.recording.segmentation import append_numbers_to_repeated_runs, label_samples_ramp_hold_unload

TRUTH = {"C10": 1404.9, "C20": 699.4}
SPECIMEN = ts.Specimen(0.040, 0.070)
SPEED = 0.248e-3
HEAD = """
[[specimen]]
name = "phantom"
radius_mm = 40.0
height_mm = 70.0
"""
TESTS = {
    "lubricated": 'kind = "lubricated_compression"\n',
    "bonded": 'kind = "bonded_compression"\n',
    "needle": 'kind = "needle_indentation"\ntool = "flat"\ntool_radius_mm = 8.0\n',
}
FIT = """
[fit]
method = "inverse_fem"
laws = ["reduced_polynomial_2"]
bulk_ratio = 10000.0
starts = 1
start = { C10 = 1400.0, C20 = 600.0 }

[noise]
force_N = 0.02
correlation_time_s = 0
contact_jitter_mm = 0.03
zero_jitter_N = 0.01
"""


def lubricated_force(depth, values=TRUTH, law="reduced_polynomial_2"):
    return -ts.find_law(law).nominal_stress(1 - depth / SPECIMEN.height, values, "uniaxial") * SPECIMEN.area


def reference_force(reference: Path, name: str):
    table = np.loadtxt(reference / name, delimiter=",", comments="#")
    return CubicSpline(table[:, 0] * 1e-3, table[:, 1])


def write_recordings(folder, name, depth, force, count=3, noise=0.02, seed=0, jitter=(0.0, 0.0), time=None, **labels):
    """Replicates `NAME_1.csv` ... of a force that is a function of the depth."""
    rng = np.random.default_rng([seed, sum(map(ord, name))])
    for number in range(1, count + 1):
        offset, zero = rng.normal(0.0, jitter[0]), rng.normal(0.0, jitter[1])
        clean = force(np.maximum(depth - offset, 0.0)) + zero
        channels = {"time": depth / SPEED if time is None else time, "displacement": depth,
                    "force": clean + rng.normal(0.0, noise, depth.size)}
        ts.write_recording(ts.Recording(channels, labels=labels), folder / f"{name}_{number}.csv")


def campaign_text(*names, fit=FIT, extra=""):
    tests = "".join(f'[[test]]\nname = "{name}"\n{TESTS[name]}recordings = ["{name}_*.csv"]\n{extra}'
                    for name in names)
    return HEAD + tests + fit


def problem_of(folder, text, law="reduced_polynomial_2", solves=None):
    path = folder / "study.toml"
    path.write_text(text, encoding="utf-8")
    campaign = calibration.load_campaign(path)
    return campaign, build_generalised_problem(law, campaign, calibration.read_measured_curves(campaign),
                                               solves or SimulationCache())


@pytest.fixture
def plates(tmp_path):
    """Lubricated and bonded compression; the bonded force is our own fast mesh's."""
    depth = np.linspace(0.0, 0.010, 41)
    write_recordings(tmp_path, "lubricated", depth, lubricated_force, jitter=(0.03e-3, 0.01))
    experiment = ts.Experiment(SPECIMEN, ts.Protocol.ramp(0.010, 21))
    curve = ts.simulate(ts.Model(experiment, ts.Material("reduced_polynomial_2", TRUTH, ts.Bulk("bulk_ratio", 1e4))))
    write_recordings(tmp_path, "bonded", depth, CubicSpline(curve.displacement, curve.force), jitter=(0.03e-3, 0.01))
    return tmp_path


class TestProblem:
    def test_gradient_is_exact(self, plates):
        """Sensitivities of the solver, nuisances that follow, whitening: all of it against differences."""
        _, problem = problem_of(plates, campaign_text("lubricated", "bonded"))
        theta = np.array([1380.0, 820.0])
        residual, jacobian = problem.evaluate(theta).projected_residual_and_jacobian
        gradient = 2 * jacobian.T @ residual
        for i, width in enumerate((0.5, 0.5)):
            step = np.eye(2)[i] * width
            difference = (problem.evaluate(theta + step).penalised_sum_of_squares
                          - problem.evaluate(theta - step).penalised_sum_of_squares) / (2 * width)
            assert gradient[i] == pytest.approx(difference, rel=1e-4)

    @pytest.mark.slow
    def test_gradient_is_exact_where_offsets_are_far(self, plates):
        """A touch at 0.3 mm where 0.03 mm is stated: there the force and its derivatives are extrapolated linearly."""
        depth = np.linspace(0.0, 0.010, 81)
        write_recordings(plates, "lubricated", depth, lambda d: lubricated_force(np.maximum(d - 0.3e-3, 0.0)))
        _, problem = problem_of(plates, campaign_text("lubricated"))
        theta = np.array([1350.0, 900.0])
        evaluation = problem.evaluate(theta)
        assert np.abs(evaluation.nuisances).max() > 5
        residual, jacobian = evaluation.projected_residual_and_jacobian
        for i in range(2):
            step = np.eye(2)[i] * 0.1
            difference = (problem.evaluate(theta + step).penalised_sum_of_squares
                          - problem.evaluate(theta - step).penalised_sum_of_squares) / 0.2
            assert 2 * jacobian[:, i] @ residual == pytest.approx(difference, rel=1e-3)

    def test_error_is_that_of_generalised_least_squares(self, plates):
        """The error is r' V^-1 r with the dense covariance of zero offset, mesh modes and correlated noise."""
        text = campaign_text("lubricated", "bonded").replace("correlation_time_s = 0", "correlation_time_s = 2.0")
        _, problem = problem_of(plates, text)
        theta, errors = np.array([1390.0, 700.0]), (0.0, 0.002)
        problem = replace(problem, jitter=ContactAndForceZeroJitter(0.0, 0.015, None), mesh_error=errors)
        total = 0.0
        for test, error in zip(problem.tests, errors, strict=True):
            answer = test.solve(problem.space, theta, problem.solves)
            gaps, modes = [], []
            for r, m in enumerate(test.measured):
                force = test.evaluate_force_and_derivatives(answer, r, 0.0)[0]
                gaps.append(force - m.force)
                modes.append(error * np.stack([force, (2 * m.displacement / 0.010 - 1) * force]))
            count, time = len(gaps), test.measured[0].time
            own = 0.02**2 * np.exp(-np.abs(time[:, None] - time) / 2.0) + 0.015**2
            V = np.kron(np.eye(count), own)
            modes = np.concatenate(modes, axis=1)
            V += modes.T @ modes
            r = np.concatenate(gaps)
            total += r @ np.linalg.solve(V, r)
        assert problem.evaluate(theta).penalised_sum_of_squares == pytest.approx(total, rel=1e-8)

    @pytest.mark.slow
    def test_carried_mesh_error_does_not_pull_the_moduli(self, plates):
        """Many samples and a large carried error: modes made of the noisy data would lower C10 by several percent."""
        depth = np.linspace(0.0, 0.010, 1001)
        write_recordings(plates, "lubricated", depth, lubricated_force)
        _, problem = problem_of(plates, campaign_text("lubricated"))
        free = minimise_from_start(problem, np.array([1400.0, 600.0])).theta
        problem = replace(problem, mesh_error=(0.008,))
        held = minimise_from_start(problem, free, corrected=True).theta
        errors = compute_marginal_uncertainty(problem, problem.evaluate(held)).standard_errors
        # The carried error is in the standard error, and moves nothing.
        assert errors[0] == pytest.approx(0.008 * free[0], rel=0.3)
        assert np.abs(held - free)[0] < 0.1 * errors[0]

    @pytest.mark.slow
    def test_an_offset_far_off_is_named(self, plates):
        """A touch at 0.6 mm where 0.03 mm is stated."""
        depth = np.linspace(0.0, 0.010, 81)
        write_recordings(plates, "lubricated", depth, lambda d: lubricated_force(np.maximum(d - 0.6e-3, 0.0)))
        (plates / "study.toml").write_text(campaign_text("lubricated"), encoding="utf-8")
        result, = calibration.calibrate([plates / "study.toml"], plates / "out", figures=False)
        warning, = (warning for warning in result.best.warnings if "check the contact of these recordings" in warning)
        assert all(f"lubricated/lubricated_{number}" in warning for number in (1, 2, 3))

    def test_force_is_proportional_to_the_moduli(self, plates):
        """One solve serves every multiple, so a law of one modulus is fitted with a single one."""
        campaign, _ = problem_of(plates, campaign_text("lubricated", "bonded"))
        solves = SimulationCache()
        _, problem = problem_of(plates, campaign_text("lubricated", "bonded").replace(
            "reduced_polynomial_2", "neo_hooke").replace(", C20 = 600.0", ""), "neo_hooke", solves)
        descent = minimise_from_start(problem, np.array([14.0]))
        assert descent.converged
        assert descent.simulations == {("lubricated", "fast"): 1, ("bonded", "fast"): 1}
        # The minimum of a linear problem.
        lowest = problem.evaluate(descent.theta).penalised_sum_of_squares
        for factor in (0.999, 1.001):
            assert lowest < problem.evaluate(descent.theta * factor).penalised_sum_of_squares
        space = ParameterSpace.from_campaign("reduced_polynomial_2", campaign)
        one, factor = space.normalise_moduli_and_get_factor({"C10": 3.0, "C20": 1.5})
        other, larger = space.normalise_moduli_and_get_factor({"C10": 3e4, "C20": 1.5e4})
        assert one == other
        assert larger == pytest.approx(1e4 * factor)

    def test_weight_is_not_proportional(self, plates):
        text = campaign_text("lubricated").replace("height_mm = 70.0", "height_mm = 70.0\ngravity = true\n"
                                                   "density_kg_m3 = 1000.0")
        _, problem = problem_of(plates, text)
        assert not problem.tests[0].is_force_proportional_to_moduli
        _, jacobian = problem.evaluate(np.array([1404.9, 699.4])).projected_residual_and_jacobian
        assert np.isfinite(jacobian).all()

    def test_it_travels_to_another_process(self, plates):
        _, problem = problem_of(plates, campaign_text("lubricated"))
        theta = np.array([1400.0, 700.0])
        copied = pickle.loads(pickle.dumps(problem))
        assert copied.evaluate(theta).penalised_sum_of_squares == problem.evaluate(theta).penalised_sum_of_squares


class TestStarts:
    def test_starts_differ_and_keep_the_bounds(self, plates):
        text = campaign_text("lubricated") + "\n[fit.bounds]\nC20 = [0.0, 1000.0]\n"
        campaign, _ = problem_of(plates, text)
        found = list_starts_with_varied_exponents(ParameterSpace.from_campaign("reduced_polynomial_2", campaign), 7)
        assert len({tuple(theta) for theta in found}) == 7
        assert found[0].tolist() == [1400.0, 600.0]
        assert all(0.0 <= theta[1] <= 1000.0 for theta in found)

    @pytest.mark.parametrize("law", ["ogden_2", "ogden_3", "mooney_rivlin", "reduced_polynomial_3"])
    def test_every_law_has_starts(self, plates, law):
        text = campaign_text("lubricated").replace("reduced_polynomial_2", law).replace(
            "start = { C10 = 1400.0, C20 = 600.0 }", "")
        campaign, _ = problem_of(plates, text, law)
        space = ParameterSpace.from_campaign(law, campaign)
        for theta in list_starts_with_varied_exponents(space, 5):
            assert space.build_material(space.get_values_by_name(theta)).mu0 > 0


class TestStudy:
    """The study's situation: data of an independent solver."""

    @pytest.fixture
    def folder(self, tmp_path, reference):
        depth = np.linspace(0.0, 0.010, 401)
        write_recordings(tmp_path, "lubricated", depth, lubricated_force)
        for name, file in (("bonded", "bonded_RP.csv"), ("needle", "punch_bonded_face_side_wall_RP.csv")):
            write_recordings(tmp_path, name, depth, reference_force(reference, file))
        return tmp_path

    @pytest.mark.slow
    def test_joint_fit_finds_the_truth_from_far_off(self, folder):
        _, problem = problem_of(folder, campaign_text("lubricated", "bonded", "needle"))
        ends = []
        for start in ((1400.0, 600.0), (140.0, 6990.0), (14000.0, 70.0)):
            descent = minimise_from_start(replace(problem, solves=SimulationCache()), np.array(start))
            assert descent.converged
            assert max(descent.simulations.values()) <= 9
            ends.append(descent.theta)
        spread = compute_marginal_uncertainty(problem, problem.evaluate(ends[0]))
        assert np.ptp(ends, axis=0) == pytest.approx([0.0, 0.0], abs=0.2 * spread.standard_errors.max())
        estimate = iterate_mesh_correction_and_jitter(problem, ends[0], Noise(contact_jitter=0.03e-3, zero_jitter=0.01))
        assert estimate.theta[0] == pytest.approx(TRUTH["C10"], rel=0.003)
        assert estimate.theta[1] == pytest.approx(TRUTH["C20"], rel=0.03)
        # The meshes differ by what docs/simulation.md says.
        assert estimate.differences[0] == 0.0
        assert 0.001 < estimate.differences[1] < 0.004
        assert 0.003 < estimate.differences[2] < 0.008

    @pytest.mark.slow
    def test_profiles_meet_the_likelihood(self, folder):
        _, problem = problem_of(folder, campaign_text("lubricated", "bonded"))
        descent = minimise_from_start(problem, np.array([1400.0, 600.0]), enough=1e-6)
        spread = compute_marginal_uncertainty(problem, problem.evaluate(descent.theta))
        side = compute_profile_side(problem, descent.theta, descent.error, spread, 1, 1)
        assert side.note == ""
        # Nearly linear, so the profile is nearly a parabola.
        assert side.end - descent.theta[1] == pytest.approx(1.96 * spread.standard_errors[1], rel=0.03)
        # At its end no value of the other parameter does better than the rise says.
        others = descent.theta[0] + np.linspace(-4, 4, 9) * spread.standard_errors[0]
        errors = [problem.evaluate(np.array([c10, side.end])).penalised_sum_of_squares for c10 in others]
        assert min(errors) >= descent.error + 0.95 * 1.96**2
        problem.space.high[1] = descent.theta[1] + 0.5 * spread.standard_errors[1]
        cut = compute_profile_side(problem, descent.theta, descent.error, spread, 1, 1)
        assert cut.note.startswith("bound")
        assert cut.end == problem.space.high[1]


def test_motion_of_a_ramp_hold_and_return():
    protocol = ts.Protocol.parse("ramp 5mm @0.5mm/s; hold 20s; unload 2mm @0.5mm/s", points=101)
    time = np.arange(0.0, protocol.time[-1], 0.1)
    displacement = np.interp(time, protocol.time, protocol.displacement)
    motion = TimedMotion.from_recording(time, displacement)
    assert len(motion.legs) == 3
    assert np.interp(time, motion.time, motion.displacement) == pytest.approx(displacement, abs=2e-5)
    labels = label_samples_ramp_hold_unload(time, displacement)
    assert dict.fromkeys(labels.tolist()).keys() == {"ramp", "hold", "unload"}
    assert labels[0] == "ramp"
    assert labels[-1] == "unload"
    # A function that is smooth on each leg comes back at the samples.
    force = np.where(motion.time < 10, motion.displacement * 200, 1 - 0.3 * (1 - np.exp(-(motion.time - 10) / 3)))
    exact = np.where(time < 10, displacement * 200, 1 - 0.3 * (1 - np.exp(-(time - 10) / 3)))
    values, rate = motion.make_force_curve(force[:, None])(time, displacement, 0.0)
    held = (time > 10.5) & (time < 29)
    assert values[held, 0] == pytest.approx(exact[held], abs=2e-3)
    assert values[time < 9, 0] == pytest.approx(exact[time < 9], abs=1e-4)
    # A later touch means less force while loading.
    assert (rate[(time > 1) & (time < 9)] < 0).all()


def test_motion_that_is_not_quite_straight():
    """A bow of 0.25 % of the way: the force follows the tool, not the line."""
    time = np.linspace(0.0, 20.0, 401)
    share = time / time[-1]
    displacement = 0.010 * share + 25e-6 * np.sin(np.pi * share)
    motion = TimedMotion.from_recording(time, displacement)
    values, _ = motion.make_force_curve((200.0 * motion.displacement)[:, None])(time, displacement, 0.0)
    assert values[:, 0] == pytest.approx(200.0 * displacement, abs=2e-4)


def test_segments_that_come_again_have_numbers():
    labels = np.array(["ramp", "ramp", "unload", "ramp", "hold", "ramp"])
    assert append_numbers_to_repeated_runs(labels).tolist() == ["ramp", "ramp", "unload", "ramp 2", "hold", "ramp 3"]


@pytest.mark.slow
def test_viscoelastic_parameters_from_ramp_and_hold(tmp_path):
    material = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e4),
                           viscoelastic=ts.Prony((ts.PronyTerm(0.3, 4.0),)))
    protocol = ts.Protocol.parse("ramp 5mm @0.5mm/s; hold 20s; unload 2mm @0.5mm/s", points=81)
    truth = ts.simulate(ts.Model(ts.Experiment(SPECIMEN, protocol, friction="frictionless",
                                               friction_base="frictionless"), material))
    time = np.arange(0.0, protocol.time[-1], 0.2)
    depth = np.interp(time, truth.time, truth.displacement)
    force = np.interp(time, truth.time, truth.force)
    write_recordings(tmp_path, "lubricated", depth, lambda _: force, time=time, noise=0.01)
    fit = FIT.replace("reduced_polynomial_2", "neo_hooke").replace("force_N = 0.02", "force_N = 0.01").replace(
        "start = { C10 = 1400.0, C20 = 600.0 }",
        'start = { C10 = 900.0, "viscoelastic.terms[0].g" = 0.5, "viscoelastic.terms[0].tau_s" = 10.0 }')
    _, problem = problem_of(tmp_path, campaign_text("lubricated", fit=fit), "neo_hooke")
    assert problem.tests[0].measured[0].segment is not None
    descent = minimise_from_start(problem, np.array([900.0, 0.5, 10.0]))
    assert descent.converged
    errors = compute_marginal_uncertainty(problem, problem.evaluate(descent.theta)).standard_errors
    assert (np.abs(descent.theta - [1500.0, 0.3, 4.0]) < 4 * errors + [1.5, 3e-3, 0.06]).all()


#: Name in [fit] -> kind of test, its lines, experiment and rig that made the data, start, truth (units of the file).
SURROUNDINGS = {
    "experiment.tool.radius": ("needle", "", {"tool": ts.Tool("flat", radius=0.0084)}, {}, 8.0, 8.4),
    # Without friction_base both plates have the friction that is fitted; to fit the base alone, state friction_base.
    "experiment.friction": ("friction_compression", "friction = 0.2\n", {"friction": 0.3}, {}, 0.2, 0.3),
    "experiment.friction_base": ("friction_compression", "friction = 0.3\nfriction_base = 0.3\n",
                                 {"friction": 0.3, "friction_base": 0.2}, {}, 0.3, 0.2),
    "rig.compliance": ("bonded", 'rig = "frame.rig.json"\n', {}, {"compliance": 4e-5}, 0.02, 0.04),
    "rig.sensor_gain": ("bonded", 'rig = "frame.rig.json"\n', {}, {"sensor_gain": 0.05}, 0.01, 0.05),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SURROUNDINGS)
def test_a_number_of_geometry_friction_or_rig_is_fitted_beside_the_material(name, tmp_path):
    """The plates tell the modulus, the other test what surrounds the tissue there."""
    test, lines, changed, faults, start, truth = SURROUNDINGS[name]
    kind = {"needle": "needle_indentation", "bonded": "bonded_compression"}.get(test, test)
    depth = np.linspace(0.0, 0.008, 41)
    write_recordings(tmp_path, "lubricated", depth, lambda d: lubricated_force(d, {"C10": 1500.0}, "neo_hooke"))
    experiment = ts.KINDS[kind].experiment(specimen=SPECIMEN, protocol=ts.Protocol.ramp(0.008, 21), **changed)
    material = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e4))
    curve = ts.simulate(ts.Model(experiment, material, ts.Rig(**faults)))
    write_recordings(tmp_path, "other", depth, CubicSpline(curve.displacement, curve.force), noise=0.002)
    ts.write_rig(ts.Rig(**dict.fromkeys(faults, 1e-9)), tmp_path / "frame.rig.json")
    other = f'[[test]]\nname = "other"\nkind = "{kind}"\nrecordings = ["other_*.csv"]\n{lines}'
    if test == "needle":
        other += 'tool = "flat"\ntool_radius_mm = 8.0\n'
    fit = FIT.replace("reduced_polynomial_2", "neo_hooke").replace(
        "C10 = 1400.0, C20 = 600.0", f'C10 = 1400.0, "{name}" = {start}').replace(
        "[noise]", f'scope = {{ "{name}" = ["other"] }}\n[noise]')
    campaign, problem = problem_of(tmp_path, campaign_text("lubricated", fit=other + fit), "neo_hooke")
    factor = campaign.fit.named[name].declaration.factor
    assert problem.space.free == ("C10", name)
    begin = np.array([1400.0, start * factor])
    residual, jacobian = problem.evaluate(begin).projected_residual_and_jacobian
    width = 1e-3 * begin[1]
    more, less = (problem.evaluate(begin + np.array([0.0, sign * width])).penalised_sum_of_squares for sign in (1, -1))
    assert 2 * jacobian[:, 1] @ residual == pytest.approx((more - less) / (2 * width), rel=0.02)
    descent = minimise_from_start(problem, begin, enough=1e-4)
    errors = compute_marginal_uncertainty(problem, problem.evaluate(descent.theta)).standard_errors
    assert descent.converged
    assert (np.abs(descent.theta - [1500.0, truth * factor]) < 4 * errors + [5.0, 0.01 * truth * factor]).all()


def test_tension_without_a_specimen_is_a_closed_form(tmp_path):
    stretch = np.linspace(1.0, 1.8, 81)
    law = ts.find_law("mooney_rivlin")
    truth = {"C10": 20e3, "C01": 5e3}
    rng = np.random.default_rng(1)
    for number in (1, 2):
        stress = law.nominal_stress(stretch, truth, "uniaxial") + rng.normal(0.0, 100.0, stretch.size)
        recording = ts.Recording({"stretch": stretch, "nominal stress": stress})
        ts.write_recording(recording, tmp_path / f"pull_{number}.csv")
    text = ('[[test]]\nkind = "uniaxial_tension"\nrecordings = ["pull_*.csv"]\n'
            '[fit]\nmethod = "inverse_fem"\nlaws = ["mooney_rivlin"]\n'
            '[noise]\nnominal_stress_Pa = 100.0\ncontact_jitter_mm = 0\nzero_jitter_N = 0\n')
    _, problem = problem_of(tmp_path, text, "mooney_rivlin")
    descent = minimise_from_start(problem, np.array([1e3, 1e3]))
    errors = compute_marginal_uncertainty(problem, problem.evaluate(descent.theta)).standard_errors
    assert (np.abs(descent.theta - [20e3, 5e3]) < 4 * errors).all()
    assert descent.simulations == {}


class TestSolves:
    def test_a_killed_run_goes_on(self, plates):
        folder = plates / "solves"
        _, problem = problem_of(plates, campaign_text("bonded"), solves=SimulationCache(folder))
        first = minimise_from_start(problem, np.array([1400.0, 600.0]))
        assert first.simulations[("bonded", "fast")] >= 2
        _, again = problem_of(plates, campaign_text("bonded"), solves=SimulationCache(folder))
        second = minimise_from_start(again, np.array([1400.0, 600.0]))
        assert second.simulations == {}
        assert second.theta.tolist() == first.theta.tolist()

    def test_a_damaged_file_counts_as_none(self, plates):
        folder = plates / "solves"
        _, problem = problem_of(plates, campaign_text("bonded"), solves=SimulationCache(folder))
        theta = np.array([1400.0, 600.0])
        error = problem.evaluate(theta).penalised_sum_of_squares
        for file in folder.iterdir():
            file.write_bytes(file.read_bytes()[:40])
        _, again = problem_of(plates, campaign_text("bonded"), solves=SimulationCache(folder))
        assert again.evaluate(theta).penalised_sum_of_squares == error
        assert sum(again.solves.counts.values()) == 1

    def test_another_model_is_another_solve(self, plates):
        solves = SimulationCache()
        for text in (campaign_text("bonded"), campaign_text("bonded").replace("70.0", "71.0"),
                     campaign_text("bonded").replace("10000.0", "1000.0")):
            _, problem = problem_of(plates, text, solves=solves)
            problem.evaluate(np.array([1400.0, 600.0]))
        assert sum(solves.counts.values()) == 3


class TestWhole:
    """Through the function that users call."""

    @pytest.mark.slow
    def test_law_is_preferred_for_its_prediction(self, plates):
        text = campaign_text("lubricated", "bonded").replace(
            '["reduced_polynomial_2"]', '["neo_hooke", "reduced_polynomial_2"]')
        (plates / "study.toml").write_text(text, encoding="utf-8")
        heard = []
        result, = calibration.calibrate([plates / "study.toml"], plates / "out", figures=False,
                                        listen=lambda campaign, law, iteration: heard.append((law, iteration.run)))
        assert result.best.law == "reduced_polynomial_2"
        best, other = result.fits
        assert best.left_out < 0.5 < other.left_out
        assert {p.test for p in result.predictions} == {"lubricated", "bonded"}
        assert all(p.fitted and p.test not in p.fitted for p in result.predictions)
        mine = [p for p in result.predictions if p.law == best.law]
        assert max(p.RMSE_N / p.expected_N for p in mine) < 1.5
        for name, value in TRUTH.items():
            low, high = best.intervals95[name]
            assert low < best.parameters[name] < high
            assert abs(best.parameters[name] - value) < 4 * best.standard_errors[name]
        assert all(region.adequate for region in best.regions)
        assert not all(region.adequate for region in other.regions)
        assert len([law for law, _ in heard if law == best.law]) == len(best.history)
        material = ts.load_material(plates / "out" / best.material_file)
        assert material.parameters["C10"] == best.parameters["C10"]
        again, = calibration.calibrate([plates / "study.toml"], plates / "out", figures=False)
        assert again.resumed
        assert again.fits == result.fits

    @pytest.mark.slow
    def test_what_is_not_told_and_what_would(self, plates):
        """Mooney-Rivlin on a short lubricated compression: a flat valley, and a test that ends it."""
        text = campaign_text("lubricated", extra="max_strain = 0.05\n").replace(
            "reduced_polynomial_2", "mooney_rivlin").replace("C20 = 600.0", "C01 = 600.0")
        (plates / "study.toml").write_text(text, encoding="utf-8")
        result, = calibration.calibrate([plates / "study.toml"], plates / "out", figures=False)
        fit = result.best
        assert fit.directions
        # Their sum is told, their difference is not.
        shares = fit.directions[0].shares
        assert shares["C10"] * shares["C01"] < 0
        assert fit.suggestions
        assert fit.suggestions[0].standard_errors["C10"] < 0.7 * fit.standard_errors["C10"]
        assert fit.left_out is None
        assert "single test" in result.message

    @pytest.mark.slow
    def test_a_left_out_test_does_not_leak(self, plates):
        """Softening shows in a return only: without that test its loss is open, and nothing is predicted."""
        material = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e4), softening=ts.Softening(0.3))
        protocol = ts.Protocol.parse("ramp 8mm @0.5mm/s; unload", points=61)
        truth = ts.simulate(ts.Model(ts.Experiment(SPECIMEN, protocol, friction="frictionless",
                                                   friction_base="frictionless"), material))
        write_recordings(plates, "lubricated", np.asarray(truth.displacement), lambda _: truth.force, time=truth.time,
                         noise=0.01)
        stretch = np.linspace(1.0, 1.3, 41)
        stress = ts.find_law("neo_hooke").nominal_stress(stretch, {"C10": 1500.0}, "uniaxial")
        for number in (1, 2):
            noise = np.random.default_rng(number).normal(0.0, 5.0, 41)
            ts.write_recording(ts.Recording({"time": 10 * (stretch - 1), "stretch": stretch,
                                             "nominal stress": stress + noise}), plates / f"pull_{number}.csv")
        text = campaign_text("lubricated").replace("reduced_polynomial_2", "neo_hooke").replace(
            "C20 = 600.0", '"softening.loss" = 0.6').replace("force_N", "nominal_stress_Pa = 5.0\nforce_N")
        text += '[[test]]\nname = "pull"\nkind = "uniaxial_tension"\nrecordings = ["pull_*.csv"]\n'
        (plates / "study.toml").write_text(text, encoding="utf-8")
        result, = calibration.calibrate([plates / "study.toml"], plates / "out", figures=False)
        assert result.best.parameters["softening.loss"] == pytest.approx(0.3, abs=0.02)
        found = {p.test: p for p in result.predictions}
        assert found["lubricated"].percent is None
        assert found["lubricated"].note == "the other tests do not determine r"
        assert found["pull"].percent < 1.0

    @pytest.mark.slow
    def test_workers_give_the_same_numbers(self, plates):
        (plates / "study.toml").write_text(campaign_text("lubricated", "bonded").replace("starts = 1", "starts = 2"),
                                           encoding="utf-8")
        own, = calibration.calibrate([plates / "study.toml"], plates / "own", figures=False)
        other, = calibration.calibrate([plates / "study.toml"], plates / "other", figures=False,
                                       workers=calibration.Workers(2))
        assert other.best.parameters == own.best.parameters
        assert other.best.intervals95 == own.best.intervals95
        assert [p.RMSE_N for p in other.predictions] == [p.RMSE_N for p in own.predictions]
        assert other.best.fem_solves >= own.best.fem_solves

    @pytest.mark.slow
    def test_a_cluster_gives_the_same_numbers(self, plates, tmp_path_factory, monkeypatch):
        """Worker processes of a local dask cluster that stand in another folder."""
        (plates / "study.toml").write_text(campaign_text("lubricated"), encoding="utf-8")
        own, = calibration.calibrate([plates / "study.toml"], plates / "own", figures=False)
        elsewhere = tmp_path_factory.mktemp("elsewhere")
        monkeypatch.chdir(elsewhere)
        with distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=True, dashboard_address=None,
                                      local_directory=str(elsewhere / "scratch")) as cluster:
            monkeypatch.chdir(plates)
            other, = calibration.calibrate(["study.toml"], "other", figures=False,
                                           workers=calibration.Workers(dask=cluster.scheduler_address))
        assert other.best.parameters == own.best.parameters
        assert other.best.intervals95 == own.best.intervals95
        assert any((plates / "other" / "solves").iterdir())
        assert not (elsewhere / "other").exists()

    @pytest.mark.slow
    def test_a_held_out_test_is_predicted(self, plates):
        text = campaign_text("lubricated") + (
            '[[test]]\nname = "bonded"\nkind = "bonded_compression"\nrecordings = ["bonded_*.csv"]\nhold_out = true\n')
        (plates / "study.toml").write_text(text, encoding="utf-8")
        result, = calibration.calibrate([plates / "study.toml"], plates / "out", figures=False)
        prediction, = result.predictions
        assert prediction.test == "bonded"
        assert prediction.fitted == []
        assert prediction.percent < 1.0
        assert "held-out" in result.message

    def test_a_single_recording_has_an_assumed_scatter(self, plates):
        text = campaign_text("lubricated").replace("lubricated_*", "lubricated_1").replace(
            "contact_jitter_mm = 0.03\nzero_jitter_N = 0.01\n", "")
        (plates / "study.toml").write_text(text, encoding="utf-8")
        result, = calibration.calibrate([plates / "study.toml"], plates / "out", figures=False)
        fit = result.best
        assert fit.jitter.freedom == 0
        assert fit.jitter.contact_mm == pytest.approx(0.05)
        assert any("assumed: contact 0.05 mm" in warning for warning in fit.warnings)
        for name, value in TRUTH.items():
            low, high = fit.intervals95[name]
            assert low < value < high


def bad(folder, text):
    """The error of a calibration, and that nothing was written."""
    (folder / "study.toml").write_text(text, encoding="utf-8")
    with pytest.raises(ts.InputError) as caught:
        calibration.calibrate([folder / "study.toml"], folder / "out", figures=False)
    assert not (folder / "out").exists()
    return caught.value


BOUNDS = "\n[fit.bounds]\nC20 = [0.0, 500.0]\n"


class TestRefused:
    @pytest.mark.slow
    @pytest.mark.parametrize(("change", "field", "hint"), [
        (lambda t: t.replace("height_mm = 70.0", "height_mm = 9.0"), "test[0].recordings",
         "must be smaller than the height"),
        (lambda t: t + BOUNDS, "fit.start.C20", "must be within its bounds"),
        (lambda t: t.replace("C20 = 600.0", "C20 = -6000.0"), "fit.start", "the law loses stability at stretch"),
        (lambda t: t.replace("C10 = 1400.0", "C10 = -1400.0"), "fit.start", "must give a valid material"),
        (lambda t: t.replace("lubricated_*.csv", "none_*.csv"), "test[0].recordings[0]", "no file matches"),
        (lambda t: t.replace("C20 = 600.0", 'C20 = 600.0, "softening.loss" = 0.3'), "fit.start.softening.loss",
         "at least one test must depend on"),
        (lambda t: t.replace("C20 = 600.0", 'C20 = 600.0, "viscoelastic.terms[0].g" = 0.3'),
         "fit.start.viscoelastic.terms[0].tau_s", "missing"),
        (lambda t: t.replace("C20 = 600.0", 'C20 = 600.0, "viscoelastic.terms[0].tao" = 0.3'),
         "fit.start.viscoelastic.terms[0].tao", "did you mean 'viscoelastic.terms[0].tau'"),
        (lambda t: t.replace("C20 = 600.0", 'C20 = 600.0, "softening.loss" = 1.3'), "fit.start.softening.loss",
         "must be within its bounds"),
        (lambda t: t.replace("lubricated_compression", "needle_indentation"), "test[0].tool",
         "requires the shape of the tool"),
        (lambda t: t.replace("lubricated_compression", "friction_compression"), "test[0].friction",
         "requires the friction of the plates"),
        (lambda t: t.replace("kind =", "friction = 0.3\nkind ="), "test[0].friction", "friction_compression"),
        (lambda t: t.replace("kind =", 'rig = "none.rig.json"\nkind ='), "test[0].rig", "none.rig.json"),
        (lambda t: t.replace("kind =", 'tool = "flat"\ntool_radius_mm = 8.0\nkind ='), "test[0].tool",
         "needle_indentation"),
        (lambda t: t.replace("starts = 1", "offset_bounds_mm = 0.1"), "fit.offset_bounds_mm", "priors"),
        (lambda t: t.replace("starts = 1", "offset_prior_mm = 0.1"), "fit.offset_prior_mm", 'offset = "fit"'),
        (lambda t: t.replace("C20 = 600.0", 'C20 = 600.0, "bulk.bulk_ratio" = 300.0'), "fit.start.bulk.bulk_ratio",
         "both state the bulk response"),
        (lambda t: t.replace("C20 = 600.0", 'C20 = 600.0, "viscoelastic.terms[00].g" = 0.3'),
         "fit.start.viscoelastic.terms[00].g", "no material has"),
        (lambda t: t.replace("zero_jitter_N = 0.01", "zero_jitter_N = -1"), "noise.zero_jitter_N",
         "must be at least 0"),
    ], ids=["deep", "bounds", "unstable", "no material", "missing file", "unseen", "incomplete", "path", "value",
            "tool", "friction", "contradiction", "rig", "plate", "bounds of offsets", "unused prior", "bulk twice",
            "index", "jitter"])
    def test_one_sentence_with_the_field(self, plates, change, field, hint):
        error = bad(plates, change(campaign_text("lubricated")))
        assert hint in str(error)
        assert error.field == field or field in str(error)
        assert "study.toml" in str(error) or "rig.json" in str(error)

    def test_recordings_that_are_no_replicates(self, plates):
        depth = np.linspace(0.0, 0.004, 41)
        ts.write_recording(ts.Recording({"time": depth / SPEED, "displacement": depth,
                                         "force": lubricated_force(depth)}), plates / "lubricated_4.csv")
        error = bad(plates, campaign_text("lubricated"))
        assert "lubricated_4.csv to 4 mm" in str(error)
        assert "[[test]]" in str(error)
        depth = np.linspace(0.0, 0.010, 41)
        ts.write_recording(ts.Recording({"time": depth / (10 * SPEED), "displacement": depth,
                                         "force": lubricated_force(depth)}), plates / "lubricated_4.csv")
        assert "at 2.48 mm/s" in str(bad(plates, campaign_text("lubricated")))

    def test_columns_that_do_not_fit_the_kind(self, plates):
        stretch = np.linspace(1.0, 0.9, 21)
        ts.write_recording(ts.Recording({"stretch": stretch, "nominal stress": 1e4 * (stretch - 1)}),
                           plates / "needle_1.csv")
        error = bad(plates, campaign_text("needle"))
        assert error.file == plates / "needle_1.csv"
        assert "displacement" in str(error)

    def test_a_material_that_ages_needs_time(self, plates):
        depth = np.linspace(0.0, 0.010, 21)
        ts.write_recording(ts.Recording({"displacement": depth, "force": lubricated_force(depth)}),
                           plates / "lubricated_1.csv")
        start = 'C20 = 600.0, "viscoelastic.terms[0].g" = 0.3, "viscoelastic.terms[0].tau_s" = 3.0'
        error = bad(plates, campaign_text("lubricated").replace("C20 = 600.0", start))
        assert "speed_mm_s" in str(error)

    def test_a_speed_cannot_date_a_hold(self, plates):
        depth = np.append(np.linspace(0.0, 0.010, 21), np.full(10, 0.010))
        for number in (1, 2, 3):
            ts.write_recording(ts.Recording({"displacement": depth, "force": lubricated_force(depth)}),
                               plates / f"lubricated_{number}.csv")
        start = 'C20 = 600.0, "viscoelastic.terms[0].g" = 0.3, "viscoelastic.terms[0].tau_s" = 3.0'
        error = bad(plates, campaign_text("lubricated", extra="speed_mm_s = 0.248\n").replace("C20 = 600.0", start))
        assert "has holds or reversals" in str(error)
        assert "speed_mm_s" in error.field

    @pytest.mark.slow
    def test_a_hold_that_is_left_out_is_said(self, plates):
        depth = np.append(np.linspace(0.0, 0.010, 41), np.full(10, 0.010))
        force = lubricated_force(depth)
        write_recordings(plates, "lubricated", depth, lambda _: force, time=np.arange(51.0))
        (plates / "study.toml").write_text(campaign_text("lubricated"), encoding="utf-8")
        result, = calibration.calibrate([plates / "study.toml"], plates / "out", figures=False)
        warning, = (warning for warning in result.best.warnings if "are not fitted" in warning)
        assert "(30 samples)" in warning
        assert "viscoelastic.terms[0].g" in warning

    def test_more_unknowns_than_samples(self, plates):
        campaign, problem = problem_of(plates, campaign_text("lubricated"))
        short = problem.with_samples_up_to_displacement_fraction(0.03)
        test, = short.tests
        problem = replace(short, tests=(replace(test, measured=test.measured[:1]),))
        with pytest.raises(ts.InputError, match=r"fit\.laws\[0\]: .* more samples than the 2 unknown .*got 2"):
            require_fittable_start(problem, campaign, 0)
