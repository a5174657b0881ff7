"""Contact on a condensed bulk against the solver of the whole solid, at the same poses."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.condensed.model import (
    CondensedBulk,
    ContactState,
    compute_packed_state_size,
    max_packed_linearisation_size,
)
from tissue_sim.fem.condensed.predictive_linearisation import PredictiveLineariser
from tissue_sim.fem.condensed.stepper import CondensedStepper
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solid.linearisation import SolidLineariser
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh.solid import create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0
from tissue_sim.pose import Pose

PHANTOM = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
TIP = ts.Tool("round", radius=8e-3)
FLAT = ts.Tool("flat", radius=8e-3)
MESH = create_cylinder_mesh_under_needle(0.04, 0.07, 8e-3, HEX8P0, smallest=2.4e-3, growth=2.2, largest=20e-3, around=2)
CASES = {"frictionless tip": (TIP, "frictionless"), "bonded punch": (FLAT, "bonded"),
         "punch that sticks": (ts.Tool("flat", radius=8e-3, edge_radius=1e-3), "stick")}


def model(tool=TIP, friction=0.3, material=PHANTOM, **changes):
    return ts.Model(ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.ramp(3e-3, 3), tool=tool, friction=friction,
                                  **changes), material)


def two_rates(tool=TIP, friction=0.3, **changes):
    bulk = SolidLineariser(make_solver(model(tool, friction, **changes), mesh=MESH))
    return bulk, CondensedStepper(bulk.surface)


def turned(angle):
    return (np.cos(0.5 * angle), 0.0, np.sin(0.5 * angle), 0.0)


def settle(bulk, stepper, pose, time, times=5):
    """Linearise where the tool is until nothing changes; the last step."""
    for _ in range(times):
        stepper.set_linearisation(bulk.iterate_and_linearise_or_none(stepper.export_state(time, pose, time, pose)))
        step = stepper.step(pose, exact=True)
        assert step.converged
    return step


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_at_the_pose_of_the_solve_wrench_and_stiffness_are_those_of_the_whole_solid(case):
    tool, friction = CASES[case]
    bulk, stepper = two_rates(tool, friction)
    solver = make_solver(model(tool, friction), mesh=MESH)
    solver.enable_stiffness_output()
    # What sticks and turns would meet more nodes, whose place remembers the way.
    turn = 0.0 if friction == "stick" else 0.02
    for pose in (Pose((0.0, 0.0, -1e-3)), Pose((0.0, 0.0, -2e-3)), Pose((3e-4, 1e-4, -2e-3), turned(turn))):
        exact = solver.step(pose, tolerance=1e-10, max_iterations=40)
        assert exact.status is StepStatus.CONVERGED
        step = settle(bulk, stepper, pose, 0.0)
        np.testing.assert_allclose(step.wrench, exact.wrench, atol=1e-9 * np.linalg.norm(exact.wrench[:3]))
        stiffness = np.array(exact.stiffness_matrix)
        np.testing.assert_allclose(step.stiffness_matrix, stiffness, atol=1e-7 * np.abs(stiffness).max())
    assert bulk.residual < 1e-8


@pytest.mark.slow
def test_the_stiffness_is_the_derivative_of_the_wrench_on_one_model():
    bulk, stepper = two_rates(TIP, "stick")
    pose = Pose((3e-4, -2e-4, -2e-3))
    settle(bulk, stepper, Pose((0.0, 0.0, -1e-3)), 0.0)
    stiffness = np.array(settle(bulk, stepper, pose, 0.0).stiffness_matrix)
    state, h = stepper.export_state(0.0, pose, 0.0, pose), 1e-7
    for axis in range(3):
        wrenches = []
        for sign in (1.0, -1.0):
            stepper.load_state(state)
            moved = list(pose.position)
            moved[axis] += sign * h
            wrenches.append(np.array(stepper.step(Pose(tuple(moved)), exact=True).wrench))
        slope = -(wrenches[0] - wrenches[1]) / (2 * h)
        np.testing.assert_allclose(stiffness[:, axis], slope, atol=1e-4 * np.abs(stiffness[:, :3]).max())


def drag(start, end, ticks):
    start, end = np.array(start), np.array(end)
    return [Pose(tuple((1e-3 * (start + (end - start) * k / ticks)).tolist())) for k in range(ticks)]


@pytest.mark.slow
def test_a_drag_with_lift_off_and_touch_is_that_of_the_whole_solid():
    """Friction at 50 mm/s, a model every 8 ms that is as old when it comes: normal and lateral force to 2 % and 3 %."""
    way = [(0, 0, 0.2), (0, 0, -2), (3, 0, -2), (3, 0, 0.5), (0, 0, 0.5), (-1, 0, -2)]
    poses = [pose for start, end in pairwise(way)
             for pose in drag(start, end, round(20 * np.linalg.norm(np.subtract(end, start))))]
    bulk, stepper = two_rates()
    predictive, solver = PredictiveLineariser(bulk), make_solver(model(), mesh=MESH)
    stepper.set_linearisation(
        predictive.linearise_at_predicted_pose_or_none(stepper.export_state(0.0, poses[0], 0.0, poses[0]), 0.0, 0.0))
    coming, found, exact = None, [], []
    for tick, pose in enumerate(poses):
        if tick % 8 == 0:
            if coming is not None:
                stepper.set_linearisation(coming)
            before = max(0, tick - 8)
            state = stepper.export_state(1e-3 * tick, pose, 1e-3 * before, poses[before])
            coming = predictive.linearise_at_predicted_pose_or_none(state, 8e-3, 16e-3)
        step = stepper.step(pose)
        assert step.converged
        if tick % 4 == 0:
            whole = solver.step(pose, tolerance=1e-6, max_iterations=40)
            assert whole.status is StepStatus.CONVERGED
            found.append(step.wrench[:3])
            exact.append(whole.wrench[:3])
    found, exact = np.array(found), np.array(exact)
    in_the_air = exact[:, 2] == 0.0
    assert in_the_air.sum() > 8 and not found[in_the_air][3:-3].any()
    lateral = np.hypot(*(found - exact)[:, :2].T)
    assert np.hypot(*exact[:, :2].T).max() > 0.2 * exact[:, 2].max()
    assert np.abs(found - exact)[:, 2].max() < 0.02 * exact[:, 2].max()
    assert lateral.max() < 0.03 * np.hypot(*exact[:, :2].T).max() + 5e-4


def test_sliding_friction_is_on_the_cone():
    """Gross sliding of a tip: lateral force over normal force between mu and what the tip's slope adds to it."""
    bulk, stepper = two_rates()
    for tick, pose in enumerate(drag((0, 0, 0), (0, 0, -1.5), 30) + drag((0, 0, -1.5), (4, 0, -1.5), 80)):
        if tick % 5 == 0:
            stepper.set_linearisation(
                bulk.iterate_and_linearise_or_none(stepper.export_state(1e-3 * tick, pose, 1e-3 * tick, pose)))
        step = stepper.step(pose)
    nodes = np.abs(stepper.forces).sum(axis=1) > 0.0
    assert step.slipping == step.pressed == nodes.sum()
    x, y, z = step.wrench[:3]
    assert abs(y) < 0.02 * z and -0.4 < x / z < -0.25


def test_models_and_states_travel_as_numbers():
    bulk, stepper = two_rates()
    pose = Pose((1e-3, 0.0, -1e-3))
    first = bulk.iterate_and_linearise_or_none(stepper.export_state(0.0, pose, 0.0, pose))
    stepper.set_linearisation(first)
    stepper.step(pose)
    state = stepper.export_state(0.25, pose, 0.2, Pose((0.0, 0.0, 0.0)), epoch=0)
    packed = state.pack_to_array()
    again = ContactState.unpack_from_array(packed)
    assert packed.size == compute_packed_state_size(bulk.surface) and (again.model, again.time, again.before) == (
        1, 0.25, Pose((0.0, 0.0, 0.0)))
    model = bulk.iterate_and_linearise_or_none(again)
    assert model.pack_to_array().size <= max_packed_linearisation_size(bulk.surface)
    copy = CondensedBulk.unpack_from_array(model.pack_to_array())
    for name in ("nodes", "free_displacement", "compliance", "tool_coupling", "wrench", "stiffness"):
        np.testing.assert_array_equal(getattr(copy, name), getattr(model, name))
    assert (copy.number, copy.pose, copy.reach) == (2, pose, model.reach)


def test_a_state_of_another_model_waits_and_an_untouched_one_begins_again():
    bulk, stepper = two_rates()
    pose = Pose((0.0, 0.0, -1e-3))
    rest = bulk.iterate_and_linearise_or_none(stepper.export_state(0.0, pose, 0.0, pose))
    stepper.set_linearisation(rest)
    stepper.step(pose)
    state = stepper.export_state(0.0, pose, 0.0, pose)
    assert bulk.iterate_and_linearise_or_none(replace(state, model=7)) is None
    assert bulk.iterate_and_linearise_or_none(state).number == 2
    again = bulk.iterate_and_linearise_or_none(replace(state, model=0, epoch=1, forces=np.zeros_like(state.forces)))
    np.testing.assert_allclose(again.free_displacement, rest.free_displacement, atol=1e-12)
    assert again.epoch == 1


def test_a_specimen_that_nothing_holds_is_refused():
    with pytest.raises(ts.InputError, match="a base that slides or lifts off would not hold the bulk"):
        two_rates(friction_base=0.3)


@pytest.mark.slow
@pytest.mark.parametrize("softer", [1.0, 2.0, 3.0, 10.0])
@pytest.mark.parametrize("friction", ["frictionless", 0.3])
def test_no_node_is_left_in_the_tool_where_tissue_becomes_softer_at_once(friction, softer):
    """Forces that are far too large push the nodes away; those that come back are met again, wherever the tool has gone
    since the model."""
    bulk, stepper = two_rates(TIP, friction)
    for depth in (1e-3, 2e-3, 3e-3):
        there, pose = Pose((2e-4, 0.0, -depth)), Pose((2e-4 + depth, 0.0, -depth))
        settle(bulk, stepper, there, 0.0)
        last, other = stepper.model, CondensedStepper(bulk.surface)
        other.set_linearisation(last)
        other.load_state(stepper.export_state(0.0, there, 0.0, there))
        assert other.step(pose).converged
        other.set_linearisation(replace(last, number=10**6, base=10**6, compliance=softer * last.compliance,
                                        modulus=last.modulus / softer))
        step = other.step(pose)
        assert step.converged and step.pressed > 0
        forces = other.forces[last.nodes]
        u = last.free_displacement - softer * (last.compliance @ forces.ravel()).reshape(-1, 3)
        x, y, z = pose.position
        centre = x, y, z + bulk.surface.datum + TIP.radius
        gaps = np.linalg.norm(bulk.surface.places[last.nodes] + u - centre, axis=1) - TIP.radius
        assert gaps.min() > -2.0 * bulk.surface.tolerance
        np.testing.assert_allclose(gaps[forces.any(axis=1)], 0.0, atol=2.0 * bulk.surface.tolerance)
        np.testing.assert_allclose(step.wrench[:3], forces.sum(axis=0), rtol=1e-9, atol=1e-12)
