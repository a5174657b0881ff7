"""`NewtonTissue` in Newton on the CPU: static equilibrium, light tools, frames, several bodies."""

import math

import numpy as np
import pytest

import tissue_sim as ts

newton = pytest.importorskip("newton", reason="needs Newton: pip install tissue_sim[newton]")
import warp as wp  # noqa: E402 - after the check that Newton is installed

pytestmark = pytest.mark.slow

MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
MODEL = ts.Model(ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(0.010, 2),
                               tool=ts.Tool("flat", radius=8e-3), friction="bonded"), MATERIAL)
TOP = ts.Pose((0.0, 0.0, 0.07))


@pytest.fixture(scope="module")
def simulator():
    one = ts.Simulator(MODEL, resolution="realtime_20")
    one.warm_up()
    return one


def make_needle(mass, servo, start=0.071):
    """Make a model with a needle on a servo along z; its centre of mass is 30 mm above the tip."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    moment = 1e-4 * mass
    body = builder.add_link(mass=mass, com=wp.vec3(0.0, 0.0, 0.03), label="needle", lock_inertia=True,
                            inertia=wp.mat33(moment, 0.0, 0.0, 0.0, moment, 0.0, 0.0, 0.0, moment))
    joint = builder.add_joint_prismatic(-1, body, parent_xform=wp.transform((0.0, 0.0, start), wp.quat_identity()),
                                        axis=newton.Axis.Z, target_ke=servo, target_kd=2.0 * math.sqrt(servo * mass),
                                        target_q=0.0, armature=0.0)
    builder.add_articulation([joint])
    return builder.finalize(device="cpu")


def run(model, tissue, dt, seconds, target):
    solver, control = newton.solvers.SolverFeatherstone(model), model.control()
    state, other = model.state(), model.state()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    forces = []
    for tick in range(round(seconds / dt)):
        control.joint_target_q.assign([target(tick * dt)])
        state.clear_forces()
        forces.append(tissue.apply(state, dt).force[2])
        solver.step(state, other, control, None, dt)
        state, other = other, state
    return np.array(forces), float(state.body_q.numpy()[0][2])


@pytest.mark.parametrize(("mass", "servo", "dt"), [(0.002, 100.0, 1e-3), (0.02, 500.0, 1e-3), (1.0, 2000.0, 2e-3)])
def test_a_press_comes_to_rest_at_the_static_equilibrium(simulator, mass, servo, dt):
    model = make_needle(mass, servo)
    simulator.reset()
    tissue = ts.NewtonTissue(model, body="needle", tissue=simulator, scene=TOP)
    forces, height = run(model, tissue, dt, 1.0, lambda t: -min(0.05 * t, 6e-3))
    hold = forces[round(0.7 / dt):]
    assert np.ptp(hold) < 0.01 * hold[-1]
    assert hold[-1] == pytest.approx(servo * (height - 0.065), rel=2e-3)
    simulator.reset()
    assert simulator.step(0.07 - height, 0.0).force == pytest.approx(hold[-1], rel=2e-3)
    tissue.reset()
    again, _ = run(model, tissue, dt, 0.2, lambda t: -min(0.05 * t, 6e-3))
    assert again.tolist() == forces[:len(again)].tolist()


def test_a_torque_is_about_the_centre_of_mass(simulator):
    """The centre of mass is 20 mm from the line of the force: the torque is the moment of the force about it."""
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_body(mass=0.1, com=wp.vec3(0.02, 0.0, 0.05), label="tools/needle", lock_inertia=True,
                     inertia=wp.mat33(1e-4, 0.0, 0.0, 0.0, 1e-4, 0.0, 0.0, 0.0, 1e-4),
                     xform=wp.transform((0.0, 0.0, 0.067), wp.quat_identity()))
    model = builder.finalize(device="cpu")
    state = model.state()
    simulator.reset()
    tissue = ts.NewtonTissue(model, body="needle", tissue=simulator, scene=TOP)
    force = tissue.apply(state, 1e-3).force[2]
    simulator.reset()
    assert force == pytest.approx(simulator.step(3e-3, 0.0).force, rel=1e-5)
    assert state.body_f.numpy()[0] == pytest.approx(np.array([0.0, 0.0, force, 0.0, 0.02 * force, 0.0]), rel=1e-5)
    tissue.restore(tissue.save())
    assert tissue.apply(state, 1e-3).force[2] == pytest.approx(force, rel=1e-3)


def test_a_body_without_mass_that_moves_is_refused(simulator):
    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_body(label="frame", mass=0.0)
    with pytest.raises(ts.InputError, match="body: must have a mass, or be kinematic; 'frame' has no mass"):
        ts.NewtonTissue(builder.finalize(device="cpu"), body="frame", tissue=simulator)


@pytest.mark.parametrize(("body", "message"), [("needel", "0 bodies have the label 'needel'. Labels: needle"),
                                               (1, "body: must be 0 to 0; got 1")])
def test_an_unknown_body_is_refused(simulator, body, message):
    with pytest.raises(ts.InputError, match=message):
        ts.NewtonTissue(make_needle(0.1, 100.0), body=body, tissue=simulator)
