"""`MujocoTissue` in MuJoCo: frames, velocities, sensors, equilibrium, light tools, work, resets and planners."""

import math

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.tool_force import ForceStatus

mujoco = pytest.importorskip("mujoco", reason="needs MuJoCo: pip install tissue_sim[mujoco]")
pytestmark = pytest.mark.slow

MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
MODEL = ts.Model(ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(0.010, 2),
                               tool=ts.Tool("flat", radius=8e-3), friction="bonded"), MATERIAL)
SENSORS = """<sensor><user name="tissue_wrench" dim="6"/><user name="tissue_error" dim="1"/>
<user name="tissue_status" dim="1"/></sensor>"""
#: Needle on a slide joint along the axis of the tissue, whose top is at z = 0.07 m.
NEEDLE = """<mujoco><option timestep="{dt}" integrator="{integrator}" gravity="0 0 0"/><worldbody>
<site name="tissue" pos="0 0 0.07"/><body name="needle" pos="0 0 {start}"><joint name="z" type="slide" axis="0 0 1"/>
<geom type="cylinder" size=".008 .03" pos="0 0 .03" mass="{mass}" contype="0" conaffinity="0"/><site name="tip"/></body>
</worldbody><actuator><position joint="z" kp="{servo}" kv="{damper}"/></actuator>{sensors}</mujoco>"""


@pytest.fixture(scope="module")
def simulator():
    one = ts.Simulator(MODEL, resolution="realtime_20")
    one.warm_up()
    return one


def load(mass=0.1, servo=2000.0, dt=1e-3, integrator="implicitfast", start=0.07, sensors=SENSORS):
    model = mujoco.MjModel.from_xml_string(NEEDLE.format(
        mass=mass, servo=servo, damper=2.0 * math.sqrt(servo * mass), dt=dt, integrator=integrator, start=start,
        sensors=sensors))
    return model, mujoco.MjData(model)


def run(tissue, target, seconds):
    """Step until a time; return the forces along z and the displacements of the joint in each step."""
    model, data = tissue.model, tissue.data
    forces, moves = [], []
    for _ in range(round(seconds / model.opt.timestep)):
        data.ctrl[0] = target(data.time)
        before = data.qpos[0]
        forces.append(tissue.step().force[2])
        moves.append(data.qpos[0] - before)
    return np.array(forces), np.array(moves)


# With Euler the servo of MuJoCo itself is unstable for lighter tools and stiffer servos.
@pytest.mark.parametrize(("mass", "servo", "dt", "integrator"), [
    (0.002, 100.0, 1e-3, "implicitfast"), (0.002, 2000.0, 1e-3, "implicitfast"), (0.002, 500.0, 2e-3, "implicitfast"),
    (1.0, 2000.0, 0.5e-3, "implicitfast"), (0.002, 500.0, 1e-3, "implicit"), (0.002, 100.0, 2e-3, "Euler"),
    (0.02, 2000.0, 2e-3, "Euler")])
def test_a_press_comes_to_rest_at_the_static_equilibrium(simulator, mass, servo, dt, integrator):
    model, data = load(mass, servo, dt, integrator, start=0.071)
    simulator.reset()
    tissue = ts.MujocoTissue(model, data, body="needle", tissue=simulator)
    forces, _ = run(tissue, lambda t: -min(0.05 * t, 6e-3), 1.0)
    hold = forces[round(0.7 / dt):]
    depth = -1e-3 - data.qpos[0]
    assert np.ptp(hold) < 0.01 * hold[-1]
    assert hold[-1] == pytest.approx(servo * (6e-3 + data.qpos[0]), rel=1e-3)
    simulator.reset()
    assert simulator.step(depth, 0.0).force == pytest.approx(hold[-1], rel=1e-3)


@pytest.mark.parametrize(("mass", "dt"), [(0.001, 1e-3), (0.002, 2e-3), (0.02, 1e-3), (0.2, 2e-3)])
def test_a_closed_motion_does_no_work(simulator, mass, dt):
    model, data = load(mass, dt=dt)
    simulator.reset()
    tissue = ts.MujocoTissue(model, data, body="needle", tissue=simulator)
    forces, moves = run(tissue, lambda t: -5e-3 * (1.0 - math.cos(2.0 * math.pi * min(t, 1.0))), 1.6)
    work = forces * moves
    assert np.minimum(work, 0.0).sum() < -7e-3 and abs(work.sum()) < 1e-3 * -np.minimum(work, 0.0).sum()


def test_sensors_hold_the_wrench_the_status_and_the_error(simulator):
    model, data = load()
    simulator.reset()
    tissue = ts.MujocoTissue(model, data, body="needle", tissue=simulator)
    run(tissue, lambda t: -min(0.05 * t, 3e-3), 0.3)
    wrench = tissue.coupling.last
    assert data.sensor("tissue_wrench").data.tolist() == [*wrench.force, *wrench.torque_about_tip]
    assert data.sensor("tissue_status").data[0] == ForceStatus.CONVERGED
    assert data.sensor("tissue_error").data[0] == wrench.force_error > 0.0


def test_the_adapter_reads_the_present_pose_and_velocity_of_a_free_body(simulator):
    """mj_step leaves the kinematics of its start; the adapter must read those of its end."""
    model = mujoco.MjModel.from_xml_string("""<mujoco><option timestep="1e-3" gravity="0 0 -9.81"/><worldbody>
      <site name="tissue"/><body name="tool" pos="0 0 1"><freejoint/><inertial pos="0.01 0.02 0.1" mass="0.2"
      diaginertia="1e-3 2e-3 1e-3" quat="0.9 0.1 0.2 0.3"/><site name="tip" pos="0 0 -.05"/></body></worldbody>
      </mujoco>""")
    data = mujoco.MjData(model)
    data.qvel[:] = (0.1, 0.2, -0.3, 2.0, 1.0, -1.5)
    simulator.reset()
    tissue = ts.MujocoTissue(model, data, body="tool", tissue=simulator)
    seen = []
    step_tissue = tissue.coupling.compute_wrench
    tissue.coupling.compute_wrench = lambda state, time: seen.append(state) or step_tissue(state, time)
    for _ in range(200):
        tissue.step()
    before, after = seen[-2], seen[-1]
    # The semi-implicit Euler rule moves the centre of mass by the velocity after the step.
    moved = (np.array(after.center_of_mass) - before.center_of_mass) / 1e-3
    assert moved == pytest.approx(np.array(after.velocity), abs=2e-3)
    assert after.position == pytest.approx(data.qpos[:3] - 1e-3 * data.qvel[:3], abs=1e-5)
    # Angular momentum about the centre of mass is conserved in free fall.
    def momentum(state):
        turn, own = np.zeros(9), np.zeros(9)
        mujoco.mju_quat2Mat(turn, state.orientation)
        mujoco.mju_quat2Mat(own, model.body_iquat[1])
        axes = turn.reshape(3, 3) @ own.reshape(3, 3)
        return axes @ np.diag(model.body_inertia[1]) @ axes.T @ np.array(state.angular_velocity)

    assert momentum(after) == pytest.approx(momentum(before), rel=1e-4)
    assert tissue.coupling.inertia == pytest.approx(tissue.coupling.inertia.T)
    assert np.linalg.eigvalsh(tissue.coupling.inertia) == pytest.approx(np.sort(model.body_inertia[1]))
    # The tool does not touch the tissue.
    assert after.velocity == pytest.approx(before.next_velocity, abs=1e-12)
    assert after.angular_velocity == pytest.approx(before.next_angular_velocity, abs=1e-12)


@pytest.mark.parametrize("callback", [None, "control", "passive", "act_dyn"])
def test_a_callback_of_the_program_is_called_once_for_each_step(simulator, callback):
    """The step of the copy of the data would call it a second time."""
    model, data = load()
    simulator.reset()
    tissue, calls, seen = ts.MujocoTissue(model, data, body="needle", tissue=simulator), [], []
    compute = tissue.coupling.compute_wrench
    tissue.coupling.compute_wrench = lambda state, time: seen.append(state) or compute(state, time)
    if callback is None:
        tissue.step()
        assert seen[0].next_velocity is not None
        return
    set_callback = getattr(mujoco, f"set_mjcb_{callback}")
    set_callback(lambda *arguments: calls.append(float(data.time)) or 0.0)
    try:
        tissue.step()
    finally:
        set_callback(None)
    assert seen[0].next_velocity is None
    assert calls.count(0.0) <= 1


@pytest.mark.parametrize("mass", [0.0, 1e-4, 0.01])
def test_a_tool_that_is_welded_to_a_link_moves_with_the_mass_of_both(simulator, mass):
    """The frame of the tool is often a body without joints and without mass."""
    inertial = f'<inertial pos="0 .01 .02" mass="{mass}" diaginertia="1e-6 1e-6 1e-6"/>' if mass else ""
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option timestep="2e-3" integrator="implicitfast"
      gravity="0 0 0"/><worldbody><site name="tissue"/>
      <body name="link" pos="0 0 .101" euler="0 0 30"><joint name="z" type="slide" axis="0 0 1"/><inertial pos="0 0 .05"
      mass="0.01" diaginertia="1e-5 1e-5 1e-6"/><body name="tool" pos="0 0 -.1" euler="0 0 -30">{inertial}
      <site name="tip"/></body></body></worldbody>
      <actuator><position joint="z" kp="200" kv="3"/></actuator></mujoco>""")
    data = mujoco.MjData(model)
    simulator.reset()
    tissue = ts.MujocoTissue(model, data, body="tool", tissue=simulator)
    assert tissue.coupling.mass == pytest.approx(0.01 + mass)
    assert tissue.coupling.tip.position == pytest.approx((0.0, 0.0, -0.1))
    mujoco.mj_subtreeVel(model, data)
    forces, _ = run(tissue, lambda t: -min(0.05 * t, 6e-3), 1.0)
    assert np.ptp(forces[350:]) < 0.01 * forces[-1]
    assert forces[-1] == pytest.approx(200.0 * (6e-3 + data.qpos[0]), rel=1e-3)
    center = data.xpos[1] + data.xmat[1].reshape(3, 3) @ tissue._center
    mujoco.mj_comPos(model, data)
    assert center == pytest.approx(data.subtree_com[1], abs=1e-12)


def test_a_mocap_body_has_a_prescribed_motion(simulator):
    model = mujoco.MjModel.from_xml_string("""<mujoco><option timestep="1e-3"/><worldbody><site name="tissue"/>
      <body name="tool" mocap="true"><geom size=".01" mass="1" contype="0" conaffinity="0"/><site name="tip"/></body>
      </worldbody></mujoco>""")
    data = mujoco.MjData(model)
    simulator.reset()
    tissue = ts.MujocoTissue(model, data, body="tool", tissue=simulator)
    assert tissue.coupling.mass is None
    forces = []
    for step in range(100):
        data.mocap_pos[0, 2] = -2e-5 * step
        forces.append(tissue.step().force[2])
    simulator.reset()
    simulator.step(0.0, 0.0)
    expected = [simulator.step(2e-5 * step, 1e-3).force for step in range(1, 100)]
    assert forces[1:] == pytest.approx(expected, rel=1e-9)


def test_a_reset_of_the_engine_gives_the_same_forces_again(simulator):
    model, data = load(0.02)
    simulator.reset()
    tissue = ts.MujocoTissue(model, data, body="needle", tissue=simulator)
    forces, _ = run(tissue, lambda t: -min(0.05 * t, 3e-3), 0.1)
    mujoco.mj_resetData(model, data)
    tissue.reset()
    again, _ = run(tissue, lambda t: -min(0.05 * t, 3e-3), 0.1)
    assert again.tolist() == forces.tolist()


def test_a_planner_runs_a_clone_with_a_copy_of_the_data(simulator):
    model, data = load(0.02)
    simulator.reset()
    tissue = ts.MujocoTissue(model, data, body="needle", tissue=simulator)
    run(tissue, lambda t: -min(0.05 * t, 3e-3), 0.1)
    copy = mujoco.MjData(model)
    mujoco.mj_copyData(copy, model, data)
    planned, _ = run(tissue.clone(copy), lambda t: -4e-3, 0.05)
    done, _ = run(tissue, lambda t: -4e-3, 0.05)
    assert planned.tolist() == done.tolist()


def test_a_restored_state_of_physics_gets_the_same_forces(simulator):
    """``mjSTATE_FULLPHYSICS`` does not contain ``xfrc_applied``."""
    model, data = load(0.002)
    simulator.reset()
    tissue = ts.MujocoTissue(model, data, body="needle", tissue=simulator)
    run(tissue, lambda t: -min(0.05 * t, 3e-3), 0.1)
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    physics, saved = np.zeros(mujoco.mj_stateSize(model, kind)), tissue.save()
    mujoco.mj_getState(model, data, physics, kind)
    first, _ = run(tissue, lambda t: -4e-3, 0.05)
    mujoco.mj_resetData(model, data)
    mujoco.mj_setState(model, data, physics, kind)
    tissue.restore(saved)
    again, _ = run(tissue, lambda t: -4e-3, 0.05)
    assert again.tolist() == first.tolist()


def test_two_tissues_act_on_two_bodies_of_one_model(simulator):
    model = mujoco.MjModel.from_xml_string("""<mujoco><option timestep="1e-3" gravity="0 0 0"/><worldbody>
      <site name="left"/><site name="right" pos="1 0 0"/>
      <body name="one"><joint type="slide" axis="0 0 1"/><geom size=".01" mass=".1" contype="0" conaffinity="0"/>
      <site name="tip one"/></body>
      <body name="two" pos="1 0 0"><joint type="slide" axis="0 0 1"/><geom size=".01" mass=".1" contype="0"
      conaffinity="0"/><site name="tip two"/></body></worldbody></mujoco>""")
    data = mujoco.MjData(model)
    data.qpos[:] = -2e-3, -4e-3
    simulator.reset()
    other = simulator.clone()
    tissues = [ts.MujocoTissue(model, data, body="one", tissue=simulator, scene="left", tip="tip one"),
               ts.MujocoTissue(model, data, body="two", tissue=other, scene="right", tip="tip two")]
    forces = [tissue.apply().force[2] for tissue in tissues]
    for simulated, depth, force in ((simulator, 2e-3, forces[0]), (other, 4e-3, forces[1])):
        simulated.reset()
        assert simulated.step(depth, 0.0).force == pytest.approx(force, rel=1e-9)
    mujoco.mj_step(model, data)
    assert data.qvel == pytest.approx(np.array(forces) / 0.1 * 1e-3, rel=0.05)


@pytest.mark.parametrize(("change", "options", "message"), [
    ({}, {"body": "needel"}, "body: must be the name of a body of the model; got 'needel'; did you mean 'needle'"),
    ({}, {"scene": "table"}, "site: must be the name of a site of the model; got 'table'; known: tissue, tip"),
    ({}, {"scene": "tip"}, "scene: must be a site that is fixed to the world; 'tip' moves"),
    ({}, {"tip": "tissue"}, "tip: must be a site of the body that carries the tool"),
    ({"integrator": "RK4"}, {}, "integrator: must be 'Euler'"),
    ({"sensors": '<sensor><user name="tissue_wrench" dim="3"/></sensor>'}, {}, "must be a user sensor of dimension 6")])
def test_mistakes_in_the_model_are_refused_by_name(simulator, change, options, message):
    model, data = load(**change)
    with pytest.raises(ts.InputError, match=message):
        ts.MujocoTissue(model, data, **{"body": "needle", "tissue": simulator, **options})
