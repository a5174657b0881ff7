"""A solver from one file outside the packages, through everything that speaks to the contract.

Its wrench is known in closed form, so that what comes out of `simulate` and `Simulator` along an oblique, turning path
must be that to the last digits: nothing on the way may drop a component or take a pose for a depth.
"""

from dataclasses import dataclass, replace
from math import cos, sin

import numpy as np
import pytest

import tissue_sim as ts
from scenes.figures import draw_simulation
from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.standard_tests import NEEDLE
from tissue_sim.fem.solver import SOLVERS
from tissue_sim.parameters import get_parameter_value
from tissue_sim.pose import interpolate_pose
from tissue_sim.tool_force import ForceStatus

MATERIAL = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3))
CHANNELS = ("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")


@dataclass(frozen=True)
class Oblique(ts.Experiment):
    """The tool goes down askew, and turns as it goes."""

    def tool_pose(self, displacement):
        return oblique(displacement)


def oblique(way: float) -> ts.Pose:
    half = 20.0 * way
    axis = np.array([0.6, 0.0, 0.8]) * sin(half)
    return ts.Pose((0.5 * way, -0.25 * way, -way), (cos(half), *axis.tolist()))


@pytest.fixture
def spring(plugin, registers):
    module = plugin("spring_solver")
    registers(SOLVERS, module.SpringSolver, "spring")
    return module


def model(kind=Oblique, points=9):
    protocol = ts.Protocol.ramp(8e-3, points)
    return ts.Model(kind(ts.Specimen(0.04, 0.07), protocol), MATERIAL)


def expected(spring, ways) -> np.ndarray:
    """Wrenches along a path, the slider followed step by step."""
    solver, wrenches = spring.SpringSolver(model(), resolution="fast"), []
    for way in ways:
        step = solver.step(oblique(way))
        assert np.allclose(step.wrench, spring.wrench(oblique(way), solver.save().slid), rtol=0, atol=1e-15)
        wrenches.append(step.wrench)
    return np.array(wrenches)


def test_simulate_gives_the_whole_wrench(spring):
    tested = model()
    recording = ts.simulate(tested, solver="spring")
    wrenches = expected(spring, recording.displacement)
    assert (abs(wrenches[1:]) > 1e-9).all(), "every component is in use"
    assert 0.49 < np.hypot(*wrenches[-1, :2]) < 0.51, "the slider has given way"
    found = np.stack([recording.channel(name) for name in CHANNELS], axis=1)
    np.testing.assert_allclose(found, wrenches, rtol=1e-12, atol=0)
    np.testing.assert_array_equal(recording.force, recording.channel("Fz"))
    assert recording.metadata["solver"]["element"] == "spring"


def test_along_the_axis_there_is_no_other_motion(spring):
    """The same solver under an ordinary experiment: the protocol's displacement is a depth."""
    recording = ts.simulate(model(ts.Experiment), solver="spring")
    way = np.zeros((9, 6))
    way[:, 2] = -recording.displacement
    assert np.hypot(*(way @ spring.STIFFNESS[:2].T).T).max() < spring.LIMIT
    np.testing.assert_allclose(recording.force, -way @ spring.STIFFNESS[2], rtol=1e-12)


def test_simulator_follows_the_path(spring):
    """And back from a saved state: the wrench of the solver alone at every pose."""
    sim = ts.Simulator(model(), solver="spring", inertia="off")
    sim.warm_up()
    ways = np.linspace(0.0, 8e-3, 23)
    poses, wrenches = [oblique(way) for way in ways], expected(spring, ways)
    for number, (pose, wrench) in enumerate(zip(poses, wrenches, strict=True)):
        answer = sim.step(pose, 1e-3)
        np.testing.assert_allclose(answer.wrench, wrench, rtol=1e-12, atol=0)
        np.testing.assert_array_equal(answer.stiffness_matrix, spring.STIFFNESS)
        assert answer.status is ForceStatus.CONVERGED and answer.pose == pose
        if number == 11:
            saved = sim.save(), answer
    sim.restore(saved[0])
    assert sim.step(poses[11], 1e-3).wrench == saved[1].wrench
    assert sim.surface().outline is None and sim.snapshot().pose == poses[11]
    sim.set_parameters(C10=3000.0)
    np.testing.assert_allclose(sim.step(poses[5], 1e-3).stiffness_matrix, 2.0 * spring.STIFFNESS, rtol=1e-12)


def test_parts_of_a_long_way_lie_on_the_rigid_motion(spring, monkeypatch):
    """A jump is followed along a straight line and about one axis at an even rate, turns counted at the contact's
    edge."""
    seen, step = [], spring.SpringSolver.step

    def note(solver, pose, *args, **options):
        seen.append(pose)
        return step(solver, pose, *args, **options)

    monkeypatch.setattr(spring.SpringSolver, "step", note)
    sim = ts.Simulator(model(), solver="spring")
    start, end = oblique(0.0), ts.Pose((0.0, 0.0, -1e-4), oblique(8e-3).orientation)
    sim.step(end, 1e-3)
    turn, radius = 0.32, sim.model.experiment.contact_radius
    assert len(seen) == int(np.ceil((1e-4 + turn * radius) / (0.0625 * radius))) > 2
    for pose in seen:
        share = pose.position[2] / end.position[2]
        on_the_way = interpolate_pose(start, end, share)
        np.testing.assert_allclose(pose.position, on_the_way.position, atol=1e-15)
        np.testing.assert_allclose(pose.orientation, on_the_way.orientation, atol=1e-12)


def test_a_late_answer_is_carried_on_with_the_whole_matrix(spring):
    sim = ts.Simulator(model(), solver="spring", inertia="off")
    sim.step(oblique(1e-3), 1e-3)
    sim.budget = 1e-12
    at, to = sim.step(oblique(1e-3), 1e-3), oblique(1.2e-3)
    late = sim.step(to, 1e-3)
    assert late.status is ForceStatus.LATE
    np.testing.assert_allclose(late.wrench, spring.wrench(to, (0.0, 0.0)), rtol=1e-5)
    assert at.pose == oblique(1e-3)


def differences(tested, name, width):
    """Central difference of whole simulations, N per unit of the parameter."""
    value = get_parameter_value(tested, name)
    more, less = (ts.simulate(ts.with_values(tested, {name: value + sign * width}), solver="spring").force
                  for sign in (1.0, -1.0))
    return (more - less) / (2.0 * width)


def inclined_needle():
    """A needle that moves along its inclined axis: its force along the axis needs the derivatives of the vector."""
    return ts.Model(NEEDLE.experiment(specimen=ts.Specimen(0.04, 0.07), protocol=ts.Protocol.ramp(8e-3, 33),
                                      approach=ts.Approach(1e-3, 0.5)), MATERIAL)


@pytest.mark.parametrize("tested", [model(points=33), inclined_needle()], ids=["oblique", "inclined"])
def test_exact_derivatives_are_those_of_differences(tested, spring):
    """Before and after the slider starts to move."""
    derivatives = ts.sensitivities(tested, ["C10", "bulk.bulk_ratio"], solver="spring")
    assert derivatives.exact.all() and (derivatives.values[:, 1] == 0.0).all()
    expected = differences(tested, "material.C10", 1.0)
    np.testing.assert_allclose(derivatives.values[:, 0], expected, rtol=0, atol=1e-8 * abs(expected).max())
    start, = np.flatnonzero(derivatives.kinks)
    held = derivatives.recording.force[:start]
    np.testing.assert_allclose(1500.0 * derivatives.values[:start, 0], held, rtol=1e-9)
    sliding = derivatives.recording.force[start:] - 1500.0 * derivatives.values[start:, 0]
    assert abs(sliding).min() > 1e-6, "the force is no longer proportional to the modulus"


def test_a_restored_state_has_its_derivatives(spring):
    """The derivatives of the slider are a part of the state."""
    def neighbours():
        return [(replace(MATERIAL, parameters={"C10": 1501.0}), replace(MATERIAL, parameters={"C10": 1499.0}), 2.0)]

    solver = spring.SpringSolver(model(), resolution="fast")
    derivatives = solver.enable_force_derivatives(neighbours())
    for way in np.linspace(0.0, 8e-3, 9):
        solver.step(oblique(way))
    saved, expected = solver.save(), derivatives.vector
    solver.step(oblique(1e-3))
    solver.restore(saved)
    solver.step(saved.pose)
    np.testing.assert_allclose(derivatives.vector, expected, rtol=1e-9)


def test_fields_belong_to_the_spring(spring):
    recording = ts.simulate(model(), solver="spring", fields=True)
    fields, geometry = recording.fields, recording.fields.geometry()
    assert geometry.top.size == 14**2 and (geometry.nodes[geometry.top, 2] == 0.0).all()
    at_tool = geometry.top[np.hypot(*geometry.nodes[geometry.top, :2].T) < 3e-3]
    for sample, follows in ((2, True), (8, False)):
        position = oblique(recording.displacement[sample]).position
        moved = fields.displacement(sample)[at_tool].mean(axis=0)
        assert moved[2] == pytest.approx(position[2], rel=0.1)
        assert (np.hypot(*moved[:2]) > 0.85 * np.hypot(*position[:2])) == follows, "the slider moves in the last steps"
        energy = float((fields.at_points("energy", sample) * fields.weights).sum())
        assert energy == pytest.approx(fields.energies[sample], rel=1e-12)
    assert fields.stretch_range(0) == pytest.approx((1.0, 1.0)) and fields.stretch_range(8)[1] > 1.01
    np.testing.assert_allclose(fields.at_nodes("displacement"), np.linalg.norm(fields.displacement(), axis=1))


def test_a_figure_is_drawn(spring, tmp_path):
    recording = ts.simulate(model(ts.Experiment), solver="spring", fields=True)
    draw_simulation(recording, model(ts.Experiment), tmp_path / "f.png")
    assert (tmp_path / "f.png").read_bytes().startswith(b"\x89PNG")
    with pytest.raises(InputError, match="does not compute von_mises; it computes displacement, energy"):
        draw_simulation(recording, model(ts.Experiment), tmp_path / "g.png", "von_mises")


def test_a_solver_without_fields_shows_its_surface(plugin, registers):
    registers(SOLVERS, plugin("plain_spring").PlainSpringSolver, "plain_spring")
    sim = ts.Simulator(model(), solver="plain_spring", inertia="off")
    snapshot = sim.snapshot()
    assert snapshot.fields is None and snapshot.drawable_fields is None and snapshot.is_three_dimensional
    assert snapshot.skin.vertices.shape == (4, 3) and snapshot.arrays()[0] is snapshot.skin.vertices
    with pytest.raises(InputError, match="no fields with a geometry, and no node positions"):
        _ = snapshot.node_positions


def test_what_it_does_not_know_is_refused(spring):
    with pytest.raises(InputError, match="a spring has 'realtime' and 'fast'"):
        ts.simulate(model(), solver="spring", resolution="accurate")
    with pytest.raises(InputError, match=r"unknown solver 'sprung'; did you mean 'spring'"):
        ts.Simulator(model(), solver="sprung")
    with pytest.raises(InputError, match="taken by another solver"):
        SOLVERS.register(lambda *_, **__: None, "spring")
