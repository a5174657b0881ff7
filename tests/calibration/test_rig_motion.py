"""Tests whose force depends on the tool position alone: one simulated loading, evaluated at the true positions."""

from dataclasses import replace

import numpy as np
import pytest

import calibration
import tissue_sim as ts
from calibration.campaign.parameter_space import ParameterSpace
from calibration.diagnosis.evidence import make_one_law_whole_recording_campaign
from calibration.fit.problem import GeneralisedProblem, build_generalised_problem
from calibration.fit.trust_region import minimise_from_start
from calibration.forward.contract import InfeasibleError
from calibration.forward.forms import compute_mesh_uncertainty
from calibration.forward.meshes import ACCURATE_MESH_ERRORS, FINEST_MESH_ERRORS
from calibration.forward.motion import MonotonicLoading
from calibration.forward.readout import ForcePositionCurve, RigForceCurve
from calibration.forward.simulation_cache import SimulationCache
from calibration.statistics.jitter import ContactAndForceZeroJitter

#: Specimen.
SPECIMEN = ts.Specimen(0.020, 0.030)
#: Parameter of the law, Pa.
C10 = 1404.9
#: Speed, m/s.
SPEED = 0.2e-3
#: Largest depth, m.
DEEPEST = 3e-3
TIME = np.concatenate([np.linspace(0, 15, 61), np.linspace(15, 25, 21)[1:], np.linspace(25, 40, 61)[1:]])
DEPTH = np.interp(TIME, [0, 15, 25, 40], [0, DEEPEST, DEEPEST, 0])
CAMPAIGN = """
[[specimen]]
radius_mm = 20.0
height_mm = 30.0
[[test]]
name = "test"
kind = "{kind}"
recordings = ["test_*.csv"]
{tool}
[fit]
method = "inverse_fem"
laws = ["neo_hooke"]
bulk_ratio = 100000.0
starts = 1
start = {{ C10 = 1400.0{start} }}
{fixed}
[noise]
force_N = 0.01
correlation_time_s = 0
contact_jitter_mm = 0.02
zero_jitter_N = 0.005
"""


def squeezed(place):
    """Return the force between lubricated plates at tool positions, N; zero before contact."""
    stretch = 1.0 - np.maximum(place, 0.0) / SPECIMEN.height
    return np.pi * SPECIMEN.radius**2 * 2.0 * C10 * (stretch**-2 - stretch)


def study(folder, kind="lubricated_compression", tool="", start="", fixed="", depth=DEPTH, time=TIME):
    """Return the only test of a campaign, its parameter space with all parameters free, and the simulation cache."""
    ts.write_recording(ts.Recording({"time": time, "displacement": depth, "force": squeezed(depth)}),
                       folder / "test_1.csv")
    path = folder / "study.toml"
    path.write_text(CAMPAIGN.format(kind=kind, tool=tool, start=start, fixed=fixed), encoding="utf-8")
    campaign = make_one_law_whole_recording_campaign(calibration.load_campaign(path))
    solves = SimulationCache()
    problem = build_generalised_problem("neo_hooke", campaign, calibration.read_measured_curves(campaign), solves)
    return problem.tests[0], problem.space, solves


def evaluated(test, space, solves, values, offset=0.0):
    theta = np.array([{"C10": C10, **values}[name] for name in space.free])
    return test.evaluate_force_and_derivatives(test.solve(space, theta, solves), 0, offset)


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "tool"), [("lubricated_compression", ""), ("bonded_compression", ""), (
    "needle_indentation", 'tool = "flat"\ntool_radius_mm = 4.0')])
def test_position_curve_agrees_with_simulation_of_the_whole_motion(tmp_path, kind, tool):
    """Ramp, hold and unloading from one loading: force and derivatives are those of the whole motion.

    A contact offset moves the first contact, and a bonded face pulls.
    """
    test, space, solves = study(tmp_path, kind, tool)
    along = replace(test, full_motion=True)
    assert test.can_use_position_curve_at_parameters(space, np.array([C10])) \
        and not along.can_use_position_curve_at_parameters(space, np.array([C10]))
    for offset in (0.0, 2e-5, -2e-5):
        force, rates, rate = evaluated(test, space, solves, {}, offset)
        other = evaluated(along, space, solves, {}, offset)
        assert np.abs(force - other[0]).max() < 3e-4 * force.max(), offset
        # Derivatives along the whole motion are not shifted by the contact offset.
        assert np.abs(rates - other[1]).max() < (2e-2 if offset else 2e-3) * rates.max(), offset
        inside = DEPTH > 1e-4
        assert np.abs(rate - other[2])[inside].max() < 5e-3 * np.abs(rate).max(), offset
    pulled = evaluated(test, space, solves, {}, 2e-5)[0]
    assert pulled[0] == 0.0 and (pulled[-1] == 0.0 if kind == "lubricated_compression" else pulled[-1] < 0.0)


def check_rates(rates, force, half, more, less):
    """Compare derivatives with differences, except at samples that pass a corner of the force."""
    smooth = np.abs(more - 2 * force + less) < 2e-2 * np.abs(more - less).max()
    assert smooth.mean() > 0.8
    assert np.abs(rates - (more - less) / (2 * half))[smooth].max() < 1e-2 * np.abs(rates).max()


def behind(compliance):
    """Return the tool position with a compliant load train, by bisection of d + c F(d) = D."""
    low, high = np.zeros(DEPTH.size), DEPTH.copy()
    for _ in range(80):
        middle = 0.5 * (low + high)
        short = middle + compliance * squeezed(middle) < DEPTH
        low, high = np.where(short, middle, low), np.where(short, high, middle)
    return 0.5 * (low + high)


@pytest.mark.parametrize(("name", "value", "place"), [
    ("rig.compliance", 2e-5, lambda: behind(2e-5)),
    ("rig.displacement_gain", 0.08, lambda: 1.08 * DEPTH),
    ("rig.displacement_gain", -0.03, lambda: 0.97 * DEPTH),
    ("rig.contact_offset", 0.2e-3, lambda: DEPTH - 0.2e-3),
    ("rig.contact_offset", -0.2e-3, lambda: DEPTH + 0.2e-3),
    ("rig.step_loss", 0.1e-3, lambda: DEPTH - 0.1e-3 * (np.maximum.accumulate(DEPTH) > 1.2345e-3)),
    ("rig.backlash", 0.1e-3, lambda: np.where(TIME > 25, np.minimum(DEPTH + 0.1e-3, DEEPEST), DEPTH)),
])
def test_rig_moves_the_tool_without_a_simulation(tmp_path, name, value, place):
    """The force is the closed form at the position that the rig's definition gives, also beyond the reported depth; a
    jump occurs between two samples. Derivatives agree with differences of the force."""
    fixed = '[fit.fixed]\n"rig.step_loss_depth" = 1.2345' if name == "rig.step_loss" else ""
    test, space, solves = study(tmp_path, start=f', "{name}" = 0.0', fixed=fixed)
    force, rates, _ = evaluated(test, space, solves, {name: value})
    assert np.abs(force - squeezed(place())).max() < 2e-4 * squeezed(DEEPEST)
    counted = solves.counts.total()
    number, half = list(space.free).index(name), 1e-3 * abs(value)
    check_rates(rates[:, number], force, half,
                *(evaluated(test, space, solves, {name: value + step})[0] for step in (half, -half)))
    # A larger depth may need one more loading; other changes of the rig need no simulation.
    assert solves.counts.total() <= counted + (name == "rig.displacement_gain" or value < 0)
    half = 1e-4 * C10
    more, less = (evaluated(test, space, solves, {name: value, "C10": C10 + step})[0] for step in (half, -half))
    assert rates[:, list(space.free).index("C10")] == pytest.approx((more - less) / (2 * half), rel=1e-3, abs=1e-6)


def test_one_loading_serves_all_moduli_with_a_compliant_load_train(tmp_path):
    """The force of the tissue at a position is proportional to the modulus; the load train changes the position."""
    test, space, solves = study(tmp_path, start=', "rig.compliance" = 0.0')
    evaluated(test, space, solves, {"rig.compliance": 2e-5})
    counted = solves.counts.total()
    force, *_ = evaluated(test, space, solves, {"rig.compliance": 3e-5, "C10": 1.25 * C10})
    assert solves.counts.total() == counted
    assert np.abs(force - 1.25 * squeezed(behind(1.25 * 3e-5))).max() < 2e-4 * squeezed(DEEPEST)


@pytest.mark.slow
def test_adhesion_is_not_proportional_to_the_modulus(tmp_path):
    """The adhesive force of a sphere stays constant when the modulus changes."""
    tool = ('tool = "sphere"\ntool_radius_mm = 6.0\nfriction = "frictionless"\n'
            "contact_laws = { adhesion = { adhesion_N = 0.3, adhesion_length_mm = 0.5 } }")
    test, space, solves = study(tmp_path, "needle_indentation", tool)
    assert not test.is_force_proportional_to_moduli
    force, *_ = evaluated(test, space, solves, {"C10": 4000.0})
    experiment = replace(test.experiment, protocol=ts.Protocol(TIME, DEPTH))
    clinging, plain = (ts.simulate(ts.Model(replace(experiment, **more), ts.Material(
        "neo_hooke", {"C10": 4000.0}, ts.Bulk("bulk_ratio", 1e5))), estimate_error=False).force
        for more in ({}, {"adhesion": None, "contact_laws": {}}))
    retracting = TIME > 34
    assert (plain - clinging)[retracting].min() > 0.02
    assert np.abs(force - clinging)[retracting].max() < 0.003


@pytest.mark.slow
def test_descent_does_not_simulate_its_start_again(tmp_path):
    """The conversion of unknowns to scaled variables and back changes the last digit."""
    test, space, solves = study(tmp_path, start=', "experiment.friction" = 0.05')
    problem = GeneralisedProblem(space, (test,), solves, ContactAndForceZeroJitter(0.0, 0.005, None), (0.0,))
    start = np.array([{"C10": C10}.get(name, 0.06131956364938239) for name in space.free])
    variables = problem.make_scaled_or_long_term_variables(start)
    assert not np.array_equal(variables.convert_to_unknowns(variables.convert_from_unknowns(start)), start)
    problem.evaluate(start)
    counted = solves.counts.total()
    end = minimise_from_start(problem, start, corrected=True, enough=1e30)
    assert solves.counts.total() == counted and np.array_equal(end.theta, start)


@pytest.mark.slow
def test_stalled_descent_ends_at_its_best_point(tmp_path):
    """A descent ends after a given number of solves without a sufficient decrease."""
    test, space, solves = study(tmp_path, start=', "experiment.friction" = 0.05')
    problem = GeneralisedProblem(space, (test,), solves, ContactAndForceZeroJitter(0.0, 0.005, None), (0.0,))
    start = np.array([{"C10": 0.9 * C10}.get(name, 0.06) for name in space.free])
    whole = minimise_from_start(problem, start, corrected=True, enough=0.0)
    assert len(whole.history) > 6
    short = minimise_from_start(problem, start, corrected=True, enough=0.0, stalled=(2, 0.1))
    errors = [each.error for each in short.history]
    assert len(errors) < len(whole.history) and short.error == min(errors) and short.converged
    assert min(errors[:-2]) - min(errors) < 0.1 < min(errors[:-3]) - min(errors)
    assert short.error - whole.error < 0.2
    assert [each.error for each in whole.history[:len(errors)]] == errors


def test_force_of_a_tilted_face_is_averaged_over_strips(tmp_path):
    test, space, solves = study(tmp_path, start=', "experiment.tilt" = 0.1')
    tilt = 0.4e-3
    force, rates, _ = evaluated(test, space, solves, {"experiment.tilt": tilt})
    x = np.cos((np.arange(400) + 0.5) * np.pi / 400)
    weight = (1 - x**2) / np.sum(1 - x**2)
    expected = squeezed(DEPTH[:, None] - 0.5 * tilt * (1 - x)) @ weight
    assert np.abs(force - expected).max() < 5e-4 * squeezed(DEEPEST)
    check_rates(rates[:, list(space.free).index("experiment.tilt")], force, 1e-6, *(
        evaluated(test, space, solves, {"experiment.tilt": tilt + step})[0] for step in (1e-6, -1e-6)))
    assert solves.counts.total() == 1


def test_viscoelastic_material_requires_the_whole_motion(tmp_path):
    test, space, _ = study(tmp_path, start=', "viscoelastic.terms[0].g" = 0.1, "viscoelastic.terms[0].tau_s" = 5.0')
    assert isinstance(space, ParameterSpace) \
        and not test.can_use_position_curve_at_parameters(space, np.array([C10, 0.1, 5.0]))


def test_snapping_load_train_is_infeasible():
    """A force that falls faster than the load train unloads has no equilibrium."""
    depth = np.linspace(0.0, 1e-3, 21)
    falls = ForcePositionCurve.from_knot_values(depth, (1e3 * depth * np.cos(3e3 * depth))[:, None], holds=False)
    with pytest.raises(InfeasibleError, match="no equilibrium position"):
        RigForceCurve(falls, np.linspace(0, 1e-3, 30), 0.05).compute_tool_positions(0.0)


@pytest.mark.slow
@pytest.mark.parametrize("corners", [
    ([0, 10, 25], [3, 3, 0]),  # begins with a hold at the largest depth
    ([0, 15, 30, 40], [3, 0, 2, 2]),  # begins with unloading
    ([0, 10, 20, 40], [1, 1, 3, 0]),  # begins inside
    ([0, 30, 40], [-3, 1, 1]),  # begins in the air
])
def test_mesh_correction_depends_on_tool_position(tmp_path, corners):
    """The correction is a function of the tool position, wherever the recorded motion begins."""
    time = np.linspace(0, corners[0][-1], 161)
    depth = 1e-3 * np.interp(time, *corners)
    test, space, solves = study(tmp_path, "bonded_compression", depth=depth, time=time)
    before = evaluated(test, space, solves, {})[0]
    test.update_mesh_force_difference_and_get_ratio(space, np.array([C10]), solves)
    knots, more = test.position_correction
    inside = depth > 0
    expected = np.where(inside, np.interp(np.maximum(depth, 0), knots, more), 0.0)
    gained = evaluated(test, space, solves, {})[0] - before
    assert np.abs(gained - expected)[inside].max() < 0.02 * np.abs(more).max() + 1e-12
    test.discard_mesh_correction()
    assert evaluated(test, space, solves, {})[0] == pytest.approx(before)


def test_noise_of_displacement_in_a_hold_does_not_trigger_backlash(tmp_path):
    random = np.random.default_rng(2)
    depth = DEPTH + random.normal(0, 3e-6, DEPTH.size)
    test, space, solves = study(tmp_path, start=', "rig.backlash" = 0.0', depth=depth)
    ideal, play = (evaluated(test, space, solves, {"rig.backlash": value})[0] for value in (0.0, 60e-6))
    held = (TIME > 15) & (TIME <= 25)
    assert np.abs(play - ideal)[held].max() < 2e-3 * squeezed(DEEPEST)
    assert np.abs(play - ideal)[TIME > 30].max() > 5e-3 * squeezed(DEEPEST)


def test_pull_at_a_bonded_face_requires_the_whole_motion(tmp_path):
    """The tensile response of a bonded face cannot be extrapolated from compression."""
    depth = np.interp(TIME, [0, 15, 25, 40], [0, DEEPEST, DEEPEST, -0.5 * DEEPEST])
    test, space, _ = study(tmp_path, "bonded_compression", depth=depth)
    assert not test.can_use_position_curve_at_parameters(space, np.array([C10]))
    test, space, _ = study(tmp_path, depth=depth)
    assert test.can_use_position_curve_at_parameters(space,
                                                     np.array([C10])), "lubricated plates separate from the tissue"


@pytest.mark.slow
def test_separation_depends_on_the_true_tool_position(tmp_path):
    """With a contact offset of -0.3 mm the tool presses in unloading until its true position is zero."""
    depth = np.interp(TIME, [0, 15, 25, 40], [0, DEEPEST, DEEPEST, -0.2e-3])
    terms = ', "viscoelastic.terms[0].g" = 0.01, "viscoelastic.terms[0].tau_s" = 500.0, "rig.contact_offset" = 0.0'
    test, space, solves = study(tmp_path, start=terms, depth=depth)
    values = {name: 0.01 if name.endswith(".g") else 500.0 for name in space.free if "viscoelastic" in name}
    force = evaluated(test, space, solves, {**values, "rig.contact_offset": -0.3e-3})[0]
    assert force[-1] == pytest.approx(squeezed(0.1e-3), rel=0.1)
    assert evaluated(test, space, solves, {**values, "rig.contact_offset": 0.0})[0][-1] == 0.0


def test_descent_that_reaches_a_bound_ends_on_it(tmp_path):
    test, space, solves = study(tmp_path, start=', "rig.compliance" = 0.01', fixed="[fit.bounds]\nC10 = [1e2, 1402.0]")
    problem = GeneralisedProblem(space, (test,), solves, ContactAndForceZeroJitter(0.0, 0.005, None), (0.0,))
    end = minimise_from_start(problem, np.array([{"C10": 1350.0}.get(name, 1e-6) for name in space.free]),
                              corrected=True, enough=0.1, tolerance=2e-5)
    assert end.theta[list(space.free).index("C10")] == 1402.0


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "tool"), [("bonded_compression", ""), (
    "needle_indentation", 'tool = "flat"\ntool_radius_mm = 4.0\nfriction = "bonded"')])
def test_finest_mesh_reduces_the_error_of_the_accurate_mesh(tmp_path, kind, tool):
    """The error of the accurate mesh is computed once and corrected afterwards, which reduces the uncertainty."""
    test, space, solves = study(tmp_path, kind, tool)
    test.update_mesh_force_difference_and_get_ratio(space, np.array([C10]), solves)
    assert solves.counts["test", "finest"] == 1
    knots, more = test.position_correction
    loading = MonotonicLoading(knots, 1e-3)
    finest, *_ = test._simulate_or_load_force_and_derivatives(space, {"C10": C10}, solves, loading, "finest",
                                                              rigid=True)
    fast, *_ = test._simulate_or_load_force_and_derivatives(space, {"C10": C10}, solves, loading, "fast", rigid=True)
    assert more == pytest.approx(finest - fast, abs=2e-5 * finest.max())
    shape = "plate" if not tool else "flat"
    uncertainty = compute_mesh_uncertainty(test, ACCURATE_MESH_ERRORS)
    assert FINEST_MESH_ERRORS[shape] <= uncertainty < ACCURATE_MESH_ERRORS[shape]
    # The relative correction is the same at other parameters.
    solves.counts.clear()
    test.update_mesh_force_difference_and_get_ratio(space, np.array([1.1 * C10]), solves)
    assert not solves.counts["test", "finest"]
    assert test.position_correction[1] == pytest.approx(1.1 * more, abs=1e-6 * finest.max())


def test_failed_finest_mesh_leaves_the_uncertainty_of_the_accurate_mesh(tmp_path, monkeypatch):
    test, space, solves = study(tmp_path, "bonded_compression")
    simulate = test._simulate_or_load_force_and_derivatives

    def failing(space, values, solves, motion, resolution, *others, **named):
        if resolution == "finest":
            raise InfeasibleError("no")
        return simulate(space, values, solves, motion, resolution, *others, **named)

    monkeypatch.setattr(test, "_simulate_or_load_force_and_derivatives", failing)
    test.update_mesh_force_difference_and_get_ratio(space, np.array([C10]), solves)
    assert compute_mesh_uncertainty(test, ACCURATE_MESH_ERRORS) == ACCURATE_MESH_ERRORS["plate"]
    assert test.mesh_error.compute_correction_factor(DEPTH) == pytest.approx(1.0)


def test_puncture_occurs_at_a_true_depth(tmp_path):
    """A contact offset moves the drop to other samples, also in `compute_force_at_contact_offsets`."""
    test, space, solves = study(tmp_path, "needle_indentation", 'tool = "flat"\ntool_radius_mm = 4.0',
                                fixed='fixed = { "puncture.drop" = 0.2, "puncture.depth_mm" = 2.0 }')
    answer = test.solve(space, np.array([C10]), solves)
    offsets = np.array([-0.1e-3, 0.0, 0.1e-3])
    scanned = test.compute_force_at_contact_offsets(answer, 0, offsets)
    for column, offset in zip(scanned.T, offsets, strict=True):
        assert column == pytest.approx(test.evaluate_force_and_derivatives(answer, 0, offset)[0], abs=1e-9)
        falls = np.flatnonzero(np.diff(column[TIME <= 15]) < 0)
        assert falls.tolist() == [np.flatnonzero(DEPTH - offset > 2e-3)[0] - 1]


def test_default_shares_of_an_effect_evaluate_share_at_each_sample(tmp_path):
    """The vectorised method of the base class agrees with `compute_force_factor` of single samples."""
    depth = np.array([[0.0, 0.5e-3], [1e-3, 2e-3], [0.5e-3, 1e-3]])
    deepest, time = np.maximum.accumulate(depth, axis=0), np.array([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]])
    puncture = ts.Puncture(1e-3, 0.25)
    assert np.array_equal(super(ts.Puncture, puncture).compute_force_factors(depth, deepest, time),
                          puncture.compute_force_factors(depth, deepest, time))
    assert puncture.compute_force_factors(depth, deepest, time).tolist() == [[1, 1], [1, 0.75], [1, 0.75]]
