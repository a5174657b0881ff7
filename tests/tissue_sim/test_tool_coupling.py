"""`ToolCoupling`: frames, first touch, time, stability, work, statuses and saved states, with a simple rigid body."""

import itertools
import math
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import tissue_sim as ts
from tissue_sim.pose import invert_pose, multiply_poses
from tissue_sim.realtime.tool_coupling import OutsideDomainWarning, RigidBodyState, TissueFailureWarning, ToolCoupling
from tissue_sim.tool_force import (
    ForceStatus,
    PredictedForceOfNextStep,
    ToolForce,
    make_axial_stiffness_matrix,
    make_axial_wrench,
)

MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
NEEDLE = ts.Model(ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(0.010, 2),
                                tool=ts.Tool("flat", radius=8e-3), friction="bonded"), MATERIAL)
REST = RigidBodyState((0.0, 0.0, 0.001), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


class LinearTissue:
    """Elastic half space with a moving mass: F = k z + m a, with backward differences of second order."""

    def __init__(self, stiffness, mass=0.0):
        self.stiffness, self.mass, self.steps = stiffness, mass, []
        self.reset()

    def reset(self):
        self.depths, self.speeds = [0.0] * 2, [0.0] * 2

    def step(self, pose, dt):
        self.steps.append((pose, dt))
        depth, static = pose.depth, make_axial_stiffness_matrix(self.stiffness)
        if dt == 0.0 or depth < 0.0:
            return ToolForce(make_axial_wrench(max(self.stiffness * depth, 0.0)), static, ForceStatus.CONVERGED)

        def force_at(depth, depths, speeds):
            speed = (3.0 * depth - 4.0 * depths[-1] + depths[-2]) / (2.0 * dt)
            acceleration = (3.0 * speed - 4.0 * speeds[-1] + speeds[-2]) / (2.0 * dt)
            return self.stiffness * depth + self.mass * acceleration, speed

        force, speed = force_at(depth, self.depths, self.speeds)
        self.depths, self.speeds = [self.depths[-1], depth], [self.speeds[-1], speed]
        within = make_axial_stiffness_matrix(self.stiffness + 2.25 * self.mass / dt**2)
        ahead = PredictedForceOfNextStep(make_axial_wrench(force_at(depth, self.depths, self.speeds)[0]), within)
        return ToolForce(make_axial_wrench(force), static, ForceStatus.CONVERGED, ahead=ahead,
                         step_stiffness_matrix=within)


def push(tissue, mass, servo, dt, seconds, target, *, predicts_motion=False):
    """Step a mass on a servo along z by the semi-implicit Euler rule; return forces, net work and loading work."""
    coupling, damper = ToolCoupling(tissue, mass=mass), 2.0 * math.sqrt(servo * mass)
    z, speed, forces, work, loading = 0.0, 0.0, [0.0], 0.0, 0.0
    for tick in range(round(seconds / dt)):
        free = (mass * speed + dt * servo * (target(tick * dt) - z)) / (mass + dt * damper)
        again = free + dt * forces[-1] / (mass + dt * damper)
        mobility = np.diag([0.0, 0.0, 1.0 / (mass + dt * damper), 0.0, 0.0, 0.0])
        stated = ((0.0, 0.0, again), (0.0, 0.0, 0.0), mobility) if predicts_motion else ()
        wrench = coupling.compute_wrench(RigidBodyState(
            (0.0, 0.0, z), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, z), (0.0, 0.0, speed), (0.0, 0.0, 0.0), *stated), tick * dt)
        speed = free + dt * wrench.force[2] / (mass + dt * damper)
        z += speed * dt
        forces.append(wrench.force[2])
        work += wrench.force[2] * speed * dt
        loading += max(-wrench.force[2] * speed * dt, 0.0)
    return np.array(forces[1:]), work, loading


@pytest.mark.parametrize(("mass", "servo", "dt"),
                         list(itertools.product((0.002, 0.02, 1.0), (100.0, 2000.0), (1e-3, 2e-3))))
@pytest.mark.parametrize(("stiffness", "moving"), [(200.0, 0.0), (3270.0, 0.0), (200.0, 3.2e-3), (800.0, 0.02)])
def test_a_hold_is_steady_with_tools_and_servos_of_all_sizes(mass, servo, dt, stiffness, moving):
    forces, _, _ = push(LinearTissue(stiffness, moving), mass, servo, dt, 0.9, lambda t: -min(0.05 * t, 5e-3))
    hold = forces[round(0.6 / dt):]
    assert np.ptp(hold) <= 0.01 * abs(hold[-1])
    assert hold[-1] == pytest.approx(5e-3 * stiffness * servo / (stiffness + servo), rel=0.01)


def test_the_explicit_coupling_of_the_light_tool_is_unstable():
    """The coupling is what makes the hold steady: the same tool with the force of the present pose diverges."""
    tissue, z, speed, forces = LinearTissue(200.0, 3.2e-3), 0.0, 0.0, []
    for tick in range(500):
        force = tissue.step(ts.Pose((0.0, 0.0, z)), 1e-3).force
        speed = (0.002 * speed + 1e-3 * (500.0 * (-min(5e-5 * tick, 5e-3) - z) + force)) / (0.002 + 1e-3 * 2.0)
        z += 1e-3 * speed
        forces.append(force)
    assert max(map(abs, forces)) > 100.0


@pytest.mark.parametrize(("mass", "moving", "dt", "wanted"), [
    (0.002, 0.0, 1e-3, 1e-5), (0.002, 0.0, 2e-3, 1e-5), (0.2, 0.0, 2e-3, 1e-5), (0.02, 3.2e-3, 1e-3, 1e-5),
    (0.2, 3.2e-3, 2e-3, 2e-5)])
def test_a_closed_motion_in_elastic_tissue_does_no_work(mass, moving, dt, wanted):
    def target(t):
        return -0.005 * (1.0 - math.cos(2.0 * math.pi * min(t, 1.0)))

    _, work, loading = push(LinearTissue(200.0, moving), mass, 2000.0, dt, 2.0, target)
    assert loading > 1e-3 and abs(work) <= wanted * loading


@pytest.mark.parametrize("dt", [1e-3, 2e-3])
@pytest.mark.parametrize("mass", [1e-3, 2e-3, 2e-2])
def test_a_light_tool_whose_motion_is_predicted_gains_no_energy(mass, dt):
    """The moving tissue has 3.2 g."""
    def target(t):
        return -0.005 * (1.0 - math.cos(2.0 * math.pi * min(t, 1.0)))

    forces, work, loading = push(LinearTissue(200.0, 3.2e-3), mass, 2000.0, dt, 2.0, target, predicts_motion=True)
    assert forces.max() == pytest.approx(200.0 * 0.01 * 2000.0 / 2200.0, rel=0.02)
    assert loading > 1e-3 and abs(work) <= 1e-5 * loading


angles = st.floats(-3.0, 3.0)
vectors = st.tuples(*[st.floats(-0.5, 0.5)] * 3)


def quaternion(angle, axis):
    axis = np.add(axis, (0.0, 0.0, 1.0))
    return (math.cos(angle / 2), *(math.sin(angle / 2) * axis / np.linalg.norm(axis)))


@settings(max_examples=60, deadline=None)
@given(st.tuples(angles, vectors, vectors), st.tuples(st.floats(-0.5, 0.5), vectors, vectors), vectors, vectors)
def test_a_wrench_has_the_power_of_the_tissue_in_every_frame(scene, tip, velocity, spin):
    """Virtual power: the wrench at the centre of mass and the force at the tip do the same work on every motion."""
    scene = ts.Pose(scene[1], quaternion(scene[0], scene[2]))
    tip = ts.Pose(tip[1], quaternion(tip[0], tip[2]))
    tool = ts.Pose((0.01, -0.02, -0.003), quaternion(0.2, (0.3, 0.1, 0.0)))  # in the scene
    body = multiply_poses(multiply_poses(scene, tool), invert_pose(tip))
    center = np.array(body.position) + np.array(body.rotation_matrix) @ [0.0, 0.01, 0.03]

    class Tilted(LinearTissue):
        def step(self, pose, dt):
            self.steps.append((pose, dt))
            return ToolForce((0.1, -0.3, 1.0, 0.02, 0.05, -0.01), make_axial_stiffness_matrix(0.0),
                             ForceStatus.CONVERGED)

    tissue = Tilted(0.0)
    coupling = ToolCoupling(tissue, scene=scene, tip=tip, mass=0.1, inertia=(1e-4, 2e-4, 3e-4))
    state = RigidBodyState(body.position, np.array(body.orientation) * 1.7, center.tolist(), velocity, spin)
    wrench = coupling.compute_wrench(state, 0.0)
    seen, _ = tissue.steps[0]
    assert seen.position == pytest.approx(tool.position, abs=1e-12)
    assert np.array(seen.rotation_matrix) == pytest.approx(np.array(tool.rotation_matrix), abs=1e-9)
    turn = np.array(scene.rotation_matrix)
    at_tip = np.array(scene.position) + turn @ tool.position
    force, torque = turn @ wrench.answer.wrench[:3], turn @ wrench.answer.wrench[3:]
    power = force @ (np.array(velocity) + np.cross(spin, at_tip - center)) + torque @ np.array(spin)
    assert np.linalg.norm(wrench.force) == pytest.approx(math.sqrt(0.01 + 0.09 + 1.0))
    assert np.dot(wrench.force, velocity) + np.dot(wrench.torque, spin) == pytest.approx(power, abs=1e-12)


def moved(z, speed=0.0):
    return RigidBodyState((0.0, 0.0, z), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, z), (0.0, 0.0, speed), (0.0, 0.0, 0.0))


def test_the_first_step_has_no_past_and_long_steps_are_divided():
    tissue = LinearTissue(100.0)
    coupling = ToolCoupling(tissue, mass=0.1)
    coupling.compute_wrench(moved(0.0), 5.0)
    coupling.compute_wrench(moved(-0.004), 5.008)
    assert [dt for _, dt in tissue.steps] == pytest.approx([0.0, 2e-3, 2e-3, 2e-3, 2e-3])
    assert [pose.depth for pose, _ in tissue.steps] == pytest.approx([0.0, 1e-3, 2e-3, 3e-3, 4e-3])


def test_the_same_time_gives_the_same_wrench_and_an_earlier_time_restarts():
    tissue = LinearTissue(100.0)
    coupling = ToolCoupling(tissue, mass=0.1)
    coupling.compute_wrench(moved(0.0), 0.0)
    one = coupling.compute_wrench(moved(-1e-3), 0.001)
    assert coupling.compute_wrench(moved(-1e-3), 0.001) is one and len(tissue.steps) == 2
    coupling.compute_wrench(moved(0.0), 0.0)
    assert tissue.steps[-1][1] == 0.0 and tissue.depths == [0.0, 0.0]


def test_a_tool_frame_that_points_into_the_tissue_is_refused():
    coupling = ToolCoupling(LinearTissue(100.0), tip=ts.Pose((0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0)))
    with pytest.raises(ts.InputError, match=r"z axis from the tip to the handle, within 90 degrees.*got 180 degrees"):
        coupling.compute_wrench(REST, 0.0)


def test_forces_that_depend_on_the_wall_clock_are_refused_in_simulated_time():
    tissue = LinearTissue(100.0)
    tissue.budget = 8e-4
    with pytest.raises(ts.InputError, match="tissue: must have budget=None unless real_time=True"):
        ToolCoupling(tissue)
    tissue.budget, tissue.waits = None, False
    with pytest.raises(ts.InputError, match="tissue: must have waits=True unless real_time=True"):
        ToolCoupling(tissue)
    ToolCoupling(tissue, real_time=True)


@pytest.mark.parametrize(("options", "message"), [
    ({"mass": 0.0}, "mass: must be positive and finite"), ({"mass": math.nan}, "mass: must be positive and finite"),
    ({"inertia": (1.0, 1.0, 1.0)}, "mass: must be given with the inertia"),
    ({"mass": 1.0, "inertia": (1.0, 1.0)}, "inertia: must be a positive definite matrix"),
    ({"mass": 1.0, "inertia": (1.0, 1.0, -1.0)}, "inertia: must be a positive definite matrix")])
def test_mass_and_inertia_are_checked(options, message):
    with pytest.raises(ts.InputError, match=message):
        ToolCoupling(LinearTissue(100.0), **options)


def test_a_time_that_is_not_finite_is_refused_and_changes_nothing():
    tissue = LinearTissue(100.0)
    coupling = ToolCoupling(tissue, mass=0.1)
    coupling.compute_wrench(moved(0.0), 0.0)
    for time in (math.nan, math.inf):
        with pytest.raises(ts.InputError, match="time: must be finite"):
            coupling.compute_wrench(moved(-1e-3), time)
    assert len(tissue.steps) == 1 and coupling.compute_wrench(moved(-1e-3), 1e-3).status is ForceStatus.CONVERGED


def test_a_tissue_without_saved_states_names_the_missing_method():
    coupling = ToolCoupling(LinearTissue(100.0))
    with pytest.raises(ts.InputError, match=r"tissue: must have the method save\(\); a LinearTissue does not"):
        coupling.save()


def test_a_lost_pose_fades_the_force_and_keeps_the_tissue():
    coupling = ToolCoupling(LinearTissue(100.0), mass=0.1)
    for tick in range(200):
        coupling.compute_wrench(moved(-1e-5 * tick), tick * 1e-3)
    before = coupling.last.force[2]
    bad = RigidBodyState((math.nan, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    lost = [coupling.compute_wrench(bad, 0.2 + tick * 1e-3) for tick in range(150)]
    assert lost[10].force[2] == pytest.approx(before, rel=0.02) and lost[-1].force == (0.0, 0.0, 0.0)
    assert {each.status for each in lost} == {ForceStatus.REFUSED} and lost[0].pose is None
    back = [coupling.compute_wrench(moved(-1.99e-3), 0.35 + tick * 1e-3) for tick in range(200)]
    assert back[0].force[2] < 0.1 * before
    assert back[-1].status is ForceStatus.CONVERGED and back[-1].force[2] == pytest.approx(0.199, rel=1e-6)


def test_the_fade_after_a_lost_pose_is_that_of_the_watchdog():
    """The gain applies to the force of the tissue, not to the faded force of the step before."""
    coupling = ToolCoupling(LinearTissue(100.0), mass=0.1)
    for tick in range(200):
        coupling.compute_wrench(moved(-1e-5 * tick), tick * 1e-3)
    start = coupling.last.answer.force
    bad = RigidBodyState((math.nan, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    faded = [coupling.compute_wrench(bad, 0.2 + tick * 1e-3).force[2] for tick in range(120)]
    assert max(one - other for one, other in itertools.pairwise(faded)) <= 1.5 * 1e-3 / 0.05 * start * (1.0 + 1e-9)
    assert faded[45] == start and faded[-1] == 0.0
    assert np.mean(faded[48:98]) == pytest.approx(0.5 * start, rel=0.05)  # the ramp is symmetric


@pytest.mark.parametrize("lost", ["position", "velocity", "center_of_mass"])
def test_the_step_after_a_lost_state_has_the_force_of_the_pose(lost):
    state = {"position": (0.0, 0.0, 0.0), "orientation": (1.0, 0.0, 0.0, 0.0), "center_of_mass": (0.0, 0.0, 0.0),
             "velocity": (0.0, 0.0, -0.2), "angular_velocity": (0.0, 0.0, 0.0)}
    coupling, forces = ToolCoupling(LinearTissue(3000.0), mass=0.02), []
    for tick in range(40):
        at = (0.0, 0.0, -2e-4 * tick)
        now = {**state, "position": at, "center_of_mass": at}
        if tick == 20:
            now[lost] = (math.nan, 0.0, 0.0)
        forces.append(coupling.compute_wrench(RigidBodyState(**now), tick * 1e-3).force[2])
    # The mean of the forces at both ends of the step; the other forces of a prescribed motion are unknown.
    assert np.isfinite(forces).all()
    assert forces[21] == pytest.approx(3000.0 * 2e-4 * 21.5, rel=0.05)
    assert forces[-1] == pytest.approx(forces[-2] + 0.6, abs=0.01)


@pytest.mark.parametrize("predicted", ["next_velocity", "next_angular_velocity", "mobility"])
def test_a_predicted_motion_that_is_not_finite_never_reaches_the_engine(predicted):
    coupling, forces = ToolCoupling(LinearTissue(3000.0), mass=0.02), []
    for tick in range(10):
        at, stated = (0.0, 0.0, -2e-4 * tick), {
            "next_velocity": (0.0, 0.0, -0.2), "next_angular_velocity": (0.0, 0.0, 0.0), "mobility": np.eye(6) / 0.02}
        stated[predicted] = np.full_like(stated[predicted], math.nan)
        forces.append(coupling.compute_wrench(RigidBodyState(
            at, (1.0, 0.0, 0.0, 0.0), at, (0.0, 0.0, -0.2), (0.0, 0.0, 0.0), **stated), tick * 1e-3).force[2])
    assert np.isfinite(forces).all() and forces[-1] > 0.0


def test_a_mobility_of_another_shape_is_refused():
    coupling, at = ToolCoupling(LinearTissue(3000.0), mass=0.02), (0.0, 0.0, -1e-3)
    state = RigidBodyState(at, (1.0, 0.0, 0.0, 0.0), at, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), mobility=np.eye(3))
    coupling.compute_wrench(state, 0.0)
    with pytest.raises(ts.InputError, match=r"mobility: must have the shape \(6, 6\); got \(3, 3\)"):
        coupling.compute_wrench(state, 1e-3)


@pytest.mark.parametrize("part", ["wrench", "stiffness"])
def test_a_force_that_is_not_finite_never_reaches_the_engine(part):
    class Broken(LinearTissue):
        def step(self, pose, dt):
            numbers = {"wrench": 1.0, "stiffness": 1.0, part: math.nan}
            return ToolForce(make_axial_wrench(numbers["wrench"]), make_axial_stiffness_matrix(numbers["stiffness"]),
                             ForceStatus.CONVERGED)

    with pytest.warns(TissueFailureWarning, match="ArithmeticError: wrench or stiffness is not finite"):
        wrench = ToolCoupling(Broken(1.0), mass=0.1).compute_wrench(moved(0.0), 0.0)
    assert wrench.status is ForceStatus.FAILED and wrench.force == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(("limit", "message"), [
    ({"largest_force": 0.0}, "largest_force: must be positive"),
    ({"largest_tilt": 4.0}, "largest_tilt: must be at most pi"),
    ({"most_parts": 2.5}, "most_parts: must be an integer")])
def test_limits_are_checked(limit, message):
    with pytest.raises(ts.InputError, match=message):
        ts.CouplingLimits(**limit)


def test_an_error_of_the_tissue_gives_no_force_until_the_reset():
    class Failing(LinearTissue):
        def step(self, pose, dt):
            if pose.depth > 1e-3:
                raise RuntimeError("the process of the bulk has ended")
            return super().step(pose, dt)

    coupling = ToolCoupling(Failing(100.0), mass=0.1)
    coupling.compute_wrench(moved(-9e-4), 0.0)
    with pytest.warns(TissueFailureWarning, match="RuntimeError: the process of the bulk has ended. The coup"):
        failed = coupling.compute_wrench(moved(-1.1e-3), 0.001)
    assert failed.status is ForceStatus.FAILED and failed.force == (0.0, 0.0, 0.0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert coupling.compute_wrench(moved(-9e-4), 0.002).status is ForceStatus.FAILED
        coupling.reset()
        coupling.compute_wrench(moved(-5e-4), 0.0)
    assert coupling.failure is None and coupling.last.status is not ForceStatus.FAILED


def test_the_force_is_limited_and_says_so():
    coupling = ToolCoupling(LinearTissue(1e5), mass=1.0)
    for tick in range(300):
        wrench = coupling.compute_wrench(moved(-1e-5 * tick), tick * 1e-3)
        assert math.hypot(*wrench.force) <= 100.0 * (1.0 + 1e-12)
    assert wrench.is_limited and wrench.answer.force == pytest.approx(299.0)


@pytest.fixture(scope="module")
def simulator():
    one = ts.Simulator(NEEDLE, resolution="realtime_20")
    one.warm_up()
    return one


def test_a_tool_that_starts_inside_is_at_rest(simulator):
    simulator.reset()
    at_rest = simulator.step(5e-3, 0.0).force
    simulator.reset()
    coupling = ToolCoupling(simulator, mass=0.1)
    forces = [coupling.compute_wrench(moved(-5e-3), tick * 1e-3) for tick in range(200)]
    assert [each.force[2] for each in forces] == pytest.approx([at_rest] * 200, rel=1e-6)
    assert {each.status for each in forces} == {ForceStatus.CONVERGED}


def test_a_pose_off_the_axis_of_an_axisymmetric_tissue_has_no_force(simulator):
    simulator.reset()
    coupling = ToolCoupling(simulator, mass=0.1)
    with pytest.warns(OutsideDomainWarning, match="off the axis of an axisymmetric tissue. Use Simul"):
        for tick in range(200):
            at = (2e-3, 0.0, -1e-5 * tick)
            wrench = coupling.compute_wrench(
                RigidBodyState(at, (1.0, 0.0, 0.0, 0.0), at, (0.0, 0.0, -0.01), (0.0, 0.0, 0.0)), tick * 1e-3)
    assert wrench.status is ForceStatus.REFUSED and wrench.force == (0.0, 0.0, 0.0)


def test_a_planner_gets_the_same_forces_from_a_clone_and_after_a_restore(simulator):
    simulator.reset()
    coupling = ToolCoupling(simulator, mass=0.02)
    for tick in range(120):
        coupling.compute_wrench(moved(-3e-5 * tick, -0.03), tick * 1e-3)
    saved, other = coupling.save(), coupling.clone()

    def go_on(one):
        return [one.compute_wrench(moved(-3e-5 * tick, -0.03), tick * 1e-3).force for tick in range(120, 150)]

    forces = go_on(coupling)
    assert go_on(other) == forces
    coupling.restore(saved)
    assert go_on(coupling) == forces
    with pytest.raises(ts.InputError, match="must be a state that save"):
        coupling.restore("state")


def test_a_fast_touch_transfers_the_momentum_of_the_moving_tissue(simulator):
    """A step that ends just below the surface has a large force for a short time; the impulse is that of the tissue."""
    simulator.reset()
    coupling, wrenches = ToolCoupling(simulator, mass=1.0), []
    for tick in range(100):
        z = 3.5e-5 * (30 - tick) - 6e-7  # 0.6 um below the surface at tick 30
        wrenches.append(coupling.compute_wrench(moved(z, -0.035), tick * 1e-3))
    touch = next(each for each in wrenches if each.answer.time_since_touch is not None)
    assert touch.answer.time_since_touch < 1e-3 and touch.force[2] < 0.2 < 0.5 < touch.answer.force


def test_the_domain_is_stated(simulator):
    assert "an upright tool on the axis of the scene, at most" in ToolCoupling(simulator).domain
    assert "Largest known force error of this mesh: 2.7 %." in ToolCoupling(simulator).domain
