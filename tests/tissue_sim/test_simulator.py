"""The real-time simulator against the offline one, against differences, and in everything that can go wrong."""

import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.axisymmetric import newton
from tissue_sim.fem.axisymmetric.discretisation import build_mesh

SPECIMEN = ts.Specimen(0.040, 0.070)
LAW = {"C10": 1404.9, "C20": 699.4}
MATERIAL = ts.Material("reduced_polynomial_2", LAW, ts.Bulk("bulk_ratio", 1e4))
RELAXING = replace(MATERIAL, viscoelastic=ts.Prony((ts.PronyTerm(0.3, 2.0),)))
NEEDLE = {"tool": ts.Tool("flat", 0.008)}
ROUNDED = {"tool": ts.Tool("flat", 0.008, 0.25e-3), "friction": 0.7, "friction_wall": 0.7}
CASES = {
    "needle": (NEEDLE, MATERIAL),
    "plate": ({}, MATERIAL),
    "needle with friction that relaxes": (ROUNDED, RELAXING),
    "sticking ball": ({"tool": ts.Tool("sphere", 0.008), "friction": "stick"}, MATERIAL),
    "heavy, layered, softening": (
        {**NEEDLE, "specimen": ts.Specimen(0.040, 0.070, density=1040.0, gravity=9.81)},
        replace(MATERIAL, softening=ts.Softening(0.3), layers=(ts.Layer(0.004, 2.0),))),
    "punctured": (NEEDLE, replace(MATERIAL, puncture=ts.Puncture(1e-3, 0.3))),
}


def experiment(speed=0.01, depth=2e-3, points=21, specimen=SPECIMEN, **options) -> ts.Experiment:
    return ts.Experiment(specimen, ts.Protocol.ramp(depth, points, speed), **options)


def simulator(options=None, material=MATERIAL, **how) -> ts.Simulator:
    return ts.Simulator(ts.Model(experiment(**(NEEDLE if options is None else options)), material),
                        **{"inertia": "off", **how})


@pytest.fixture(scope="module")
def needle() -> ts.Simulator:
    """The bonded needle; whoever takes it resets it."""
    sim = simulator()
    sim.warm_up()
    return sim


@pytest.fixture
def sim(needle) -> ts.Simulator:
    needle.reset()
    needle.budget = None
    return needle


@pytest.mark.parametrize("name", CASES)
def test_same_curve_as_offline(name):
    """Two programs over one solver: another tolerance, another predictor, the same forces."""
    options, material = CASES[name]
    model = ts.Model(experiment(**options), material)
    offline = ts.simulate(model, mesh=build_mesh(model.experiment, "realtime", layers=material.layers))
    sim = ts.Simulator(model, inertia="off")
    waits = np.diff(offline.time, prepend=0.0)
    answers = [sim.step(depth, dt) for depth, dt in zip(offline.displacement.tolist(), waits.tolist(), strict=True)]
    force = np.array([answer.force for answer in answers])
    assert {answer.status for answer in answers} == {ts.ForceStatus.CONVERGED}
    # Which point slips first depends on the way there, by what the contact's tolerance leaves open.
    np.testing.assert_allclose(force, offline.force, atol=(2e-3 if "friction" in options else 2e-5) * force.max())
    assert all(answer.age == 0.0 and answer.residual < 2e-6 for answer in answers)


@pytest.mark.parametrize("name", ["needle", "plate", "sticking ball", "heavy, layered, softening", "punctured"])
def test_stiffness_is_the_slope_of_the_force(name):
    options, material = CASES[name]
    sim = simulator(options, material)
    for k in range(1, 21):
        answer = sim.step(k * 1e-4, 1e-3)
    saved, width = sim.save(), 2e-6
    slopes = []
    for way in (1, -1):
        sim.restore(saved)
        slopes.append(sim.step(answer.depth + way * width, 0.0).force)
    # Tissue that softens unloads along another curve.
    more, less = slopes
    slope = (more - answer.force) / width if material.softening else (more - less) / (2 * width)
    assert answer.stiffness == pytest.approx(slope, rel=5e-3)
    matrix = np.array(answer.stiffness_matrix)
    assert matrix.shape == (6, 6) and matrix[2, 2] == answer.stiffness == matrix.sum()


def test_stiffness_of_a_step_that_takes_time():
    """The stiffness includes relaxation within the step."""
    sim = simulator(NEEDLE, RELAXING)
    for k in range(1, 11):
        sim.step(k * 1e-4, 0.5)
    saved, width = sim.save(), 1e-5
    answers = []
    for way in (1, 0, -1):
        sim.restore(saved)
        answers.append(sim.step(1e-3 + way * width, 0.5))
    more, middle, less = answers
    assert middle.stiffness == pytest.approx((more.force - less.force) / (2 * width), rel=1e-3)


def test_a_jump_is_followed_in_parts(sim):
    small = [sim.step(k * 1e-4, 1e-3) for k in range(1, 31)][-1]
    sim.reset()
    jump = sim.step(3e-3, 1e-3)
    assert jump.status is ts.ForceStatus.CONVERGED and jump.force == pytest.approx(small.force, rel=1e-5)
    assert jump.iterations > 6


@pytest.mark.parametrize("pose, dt", [(math.nan, 1e-3), (math.inf, 1e-3), (1e-3, math.nan), (1e-3, -1e-3),
                                      (ts.Pose((0.0, 0.0, math.nan)), 1e-3)])
def test_what_is_no_number_is_refused(sim, pose, dt):
    before = sim.step(1e-3, 1e-3)
    refused = sim.step(pose, dt)
    assert refused.status is ts.ForceStatus.REFUSED and refused.force == before.force
    after = sim.step(1.1e-3, 1e-3)
    sim.reset()
    sim.step(1e-3, 1e-3)
    assert sim.step(1.1e-3, 1e-3).force == after.force, "unchanged by the request"


def test_a_late_step_answers_the_local_model_and_the_next_one_catches_up():
    sim = simulator(NEEDLE, RELAXING)
    sim.warm_up()
    for k in range(1, 11):
        last = sim.step(k * 1e-4, 0.1)
    saved = sim.save()
    sim.budget = 1e-9
    late = sim.step(1.2e-3, 0.1)
    assert late.status is ts.ForceStatus.LATE and late.iterations == 0 and late.age == pytest.approx(0.1)
    assert late.depth == pytest.approx(1e-3)
    assert late.force == pytest.approx(last.force + last.stiffness * 2e-4, rel=1e-12)
    sim.budget = None
    caught = sim.step(1.3e-3, 0.1)
    sim.restore(saved)
    sim.step(1.2e-3, 0.1)
    assert caught.force == pytest.approx(sim.step(1.3e-3, 0.1).force, rel=1e-6), "the late tick was followed, too"
    assert caught.age == 0.0


def test_a_budget_that_ends_between_parts_keeps_the_parts():
    """A motion of many increments is completed over several steps."""
    sim = simulator()
    sim.warm_up()
    # A simulated clock: every part takes as long as the budget of four solves.
    sim.budget = 12 * sim._clock.solve
    seen = [sim.step(4e-3, 1e-3)]
    while seen[-1].status is ts.ForceStatus.LATE and len(seen) < 500:
        seen.append(sim.step(4e-3, 1e-3))
    assert seen[-1].status is ts.ForceStatus.CONVERGED and seen[-1].depth == 4e-3
    depths = [answer.depth for answer in seen]
    assert depths == sorted(depths)
    sim.budget = None
    sim.reset()
    assert seen[-1].force == pytest.approx(sim.step(4e-3, 1e-3).force, rel=1e-5)


def test_no_equilibrium_says_so_and_comes_back(sim):
    """A needle that is pushed through nearly all of the specimen: no number without a word, and a way back."""
    seen, depth = [sim.step(0.0, 1e-3)], 0.0
    while seen[-1].status is ts.ForceStatus.CONVERGED and depth < 0.069:
        depth += 3e-3
        seen.append(sim.step(depth, 1e-3))
    stopped = seen[-1]
    assert stopped.status is ts.ForceStatus.STOPPED and math.isfinite(stopped.force)
    assert "move the tool back" in stopped.status.message
    assert stopped.force == pytest.approx(seen[-2].force + stopped.stiffness * (depth - seen[-2].depth), rel=0.5)
    back = sim.step(stopped.depth - 1e-3, 1e-3)
    assert back.status is ts.ForceStatus.CONVERGED and back.age == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("friction", ["bonded", "stick", 0.3, "frictionless"])
def test_after_a_jump_far_beyond_the_next_press_is_that_of_a_new_one(friction):
    """With friction at the base, which the jump has dragged along; in the air the tissue is free."""
    edge = 0.0 if friction == "bonded" else 1e-3
    options = {"tool": ts.Tool("flat", 8e-3, edge), "friction": friction, "friction_base": 0.3}
    used, new = simulator(options, inertia="off"), simulator(options, inertia="off")
    used.step(2e-3, 1e-3)
    used.step(45e-3, 1e-3)
    back = used.step(3e-3, 1e-3)
    used.step(-5e-3, 1e-3)
    if friction != "bonded":
        assert used.step(-5e-3, 1e-3).force == 0.0
    again, first = used.step(3e-3, 1e-3), new.step(3e-3, 1e-3)
    assert back.status is again.status is first.status is ts.ForceStatus.CONVERGED
    assert again.force == pytest.approx(first.force, rel=2e-2)
    # What slid on the base far below has to slide back.
    assert back.force == pytest.approx(first.force, rel=0.1)


def test_lift_off_and_touch_again():
    sim = simulator({"tool": ts.Tool("flat", 0.008, 1e-3), "friction": "stick"})
    path = [*np.linspace(0, 1e-3, 11), *np.linspace(1e-3, -2e-3, 31), *np.linspace(-2e-3, 1e-3, 31)]
    answers = [sim.step(float(depth), 1e-3) for depth in path]
    force = np.array([answer.force for answer in answers])
    assert {answer.status for answer in answers} == {ts.ForceStatus.CONVERGED}
    in_air = np.array(path) < -5e-4
    assert in_air.any() and abs(force[in_air]).max() < 1e-9
    assert force[-1] == pytest.approx(force[10], rel=2e-3)


@pytest.mark.parametrize("friction", ["stick", 0.6])
@pytest.mark.parametrize("heights, inertia", [([-2e-4, 0.0, 2e-4], "off"), ([-2e-4, 0.0, 2e-4], "on"),
                                              ([-2e-3], "off")])
def test_elastic_tissue_is_touched_again_as_at_first(friction, heights, inertia):
    """A path that stops at the surface, and a jump across it."""
    sim = simulator({"tool": ts.Tool("flat", 0.008, 1e-3), "friction": friction}, inertia=inertia)
    path = [*heights, 1e-3]
    first = [sim.step(depth, 1e-3).force for depth in path]
    for depth in [5e-4, 0.0, -2e-3]:
        sim.step(depth, 1.0)
    again = [sim.step(depth, 1e-3).force for depth in path]
    assert first[-1] > 0.0
    assert again == pytest.approx(first, rel=1e-6)


def test_air_before_the_first_touch():
    """A bonded face does not pull what it has not met, and time in the air is not time on the tissue."""
    sim = simulator(NEEDLE, RELAXING)
    assert [sim.step(-d, 1.0).force for d in (5e-3, 1e-3)] == [0.0, 0.0]
    crossing = sim.step(1e-3, 1.0)
    sim.reset()
    assert crossing.force == pytest.approx(sim.step(1e-3, 0.5).force, rel=1e-9)


def test_save_restore_reset_and_determinism(sim):
    rng = np.random.default_rng(1)
    path = np.abs(np.cumsum(rng.normal(scale=5e-5, size=60)))
    first = [sim.step(depth, 1e-3).force for depth in path[:30]]
    saved = sim.save()
    rest = [sim.step(depth, 1e-3).force for depth in path[30:]]
    sim.restore(saved)
    assert [sim.step(depth, 1e-3).force for depth in path[30:]] == rest
    sim.reset()
    assert [sim.step(depth, 1e-3).force for depth in path] == first + rest, "bit for bit"


def test_parameters_change_without_compiling(sim, monkeypatch):
    for k in range(1, 11):
        before = sim.step(k * 1e-4, 1e-3).force
    monkeypatch.setattr(newton, "make_element_assembly_functions", None)  # a new kernel would need it
    try:
        sim.set_parameters(C10=2 * LAW["C10"], C20=2 * LAW["C20"])
        assert sim.step(1e-3, 1e-3).force == pytest.approx(2 * before, rel=1e-4)
        assert sim.model.material.parameters["C10"] == 2 * LAW["C10"]
        with pytest.raises(ts.InputError, match="C02"):
            sim.set_parameters(C02=1.0)
    finally:
        sim.set_parameters(**LAW)
    assert sim.step(1e-3, 1e-3).force == pytest.approx(before, rel=1e-5)


def test_thickness_of_a_layer_is_refused():
    sim = simulator(*CASES["heavy, layered, softening"])
    with pytest.raises(ts.InputError, match="must keep the thickness of the layers"):
        sim.set_parameters(**{"layers[0].thickness": 5.0})


def test_nothing_is_allocated_in_the_loop(sim):
    """Python's small objects come and go; no array does, and nothing stays."""
    path = [1e-3 + 2e-4 * math.sin(0.3 * k) for k in range(400)]
    for depth in path[:50]:
        sim.step(depth, 1e-3)
    tracemalloc.start()
    try:
        start, _ = tracemalloc.get_traced_memory()
        for depth in path[50:]:
            sim.step(depth, 1e-3)
        end, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert end - start < 2048 and peak - start < sim._solver.state.nbytes


class TestSurface:
    def test_at_rest_it_is_the_specimen(self, sim):
        outline = sim.surface().outline
        np.testing.assert_allclose(outline[0], [0.0, 0.0], atol=1e-12)
        np.testing.assert_allclose(outline[-1], [0.040, -0.070], atol=1e-12)
        assert (np.diff(outline[:, 0]) >= 0).all() and (np.diff(outline[:, 1]) <= 1e-15).all()

    def test_it_follows_the_tool(self, sim):
        for k in range(1, 11):
            sim.step(k * 1e-4, 1e-3)
        outline = sim.surface().outline
        face = outline[outline[:, 0] < 0.008 - 1e-9]
        np.testing.assert_allclose(face[:, 1], -1e-3, atol=1e-9)
        assert outline[:, 0].max() > 0.040, "it bulges"

    def test_of_a_settled_specimen_the_top_is_where_the_tool_touches(self):
        sim = simulator(*CASES["heavy, layered, softening"])
        outline = sim.surface().outline
        assert outline[outline[:, 0] <= 0.008 + 1e-9, 1].max() == pytest.approx(0.0, abs=1e-12)
        assert outline[:, 1].max() > 1e-4, "the bonded base holds the rim less than the middle"

    def test_triangles_look_outward_and_enclose_the_volume(self, sim):
        surface = sim.surface()
        vertices, triangles = surface.triangles(96)
        a, b, c = (vertices[triangles[:, i]] for i in range(3))
        flux = np.einsum("ti,ti->", a, np.cross(b, c)) / 6.0
        # The open base at z = -H adds H A / 3.
        polygon = 96 / 2 * math.sin(2 * math.pi / 96) * 0.040**2
        assert flux + polygon * 0.070 / 3.0 == pytest.approx(polygon * 0.070, rel=1e-9)


@pytest.mark.parametrize("name", ["needle", "heavy, layered, softening"])
def test_a_snapshot_has_the_fields_of_the_offline_simulation(name):
    options, material = CASES[name]
    offline = ts.simulate(ts.Model(experiment(depth=1e-3, points=11, **options), material), fields=True).fields
    sim = simulator(options, material, resolution="fast")
    for k in range(1, 11):
        sim.step(k * 1e-4, 0.01)
    snapshot = sim.snapshot()
    assert snapshot.depth == pytest.approx(1e-3) and len(snapshot.fields.displacements) == 1
    np.testing.assert_allclose(snapshot.node_positions, sim.mesh.nodes + offline.displacement() - [0.0, snapshot.datum],
                               atol=1e-8)
    for field in ("von_mises", "pressure", "energy", "stretch"):
        expected = offline.at_points(field)
        np.testing.assert_allclose(snapshot.fields.at_points(field), expected, atol=1e-4 * np.abs(expected).max())


def test_the_largest_stretch_of_a_free_column():
    lubricated = experiment(depth=7e-3, points=2, tool=ts.Tool(), friction="frictionless", friction_base="frictionless")
    fields = ts.simulate(ts.Model(lubricated, MATERIAL), fields=True).fields
    np.testing.assert_allclose(fields.at_points("stretch"), 0.9**-0.5, rtol=1e-4)


def test_pose_and_vectors(sim):
    by_depth = sim.step(1e-3, 1e-3)
    sim.reset()
    by_pose = sim.step(ts.Pose((0.001, 0.0, -1e-3), (1.0, 0.0, 0.0, 0.0)), 1e-3)
    assert by_pose.force == by_depth.force
    assert by_pose.force_vector == (0.0, 0.0, by_pose.force) and by_pose.torque_vector == (0.0, 0.0, 0.0)
    with pytest.raises(ts.InputError, match="unit quaternion"):
        ts.Pose((0.0, 0.0, 0.0), (1.0, 1.0, 0.0, 0.0))


@pytest.mark.parametrize("options, field", [({"inertia": "maybe"}, "inertia"), ({"budget": 0.0}, "budget"),
                                            ({"resolution": "best"}, "resolution")])
def test_bad_choices(options, field):
    with pytest.raises(ts.InputError, match=field):
        simulator(**options)


def test_tilt_is_refused():
    with pytest.raises(ts.InputError, match="tilt"):
        simulator({**NEEDLE, "tilt": 1e-4})
