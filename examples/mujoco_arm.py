"""A robot arm in MuJoCo presses a needle into tissue, and measures the force by its joint torques.

At rest the servo torques tau of the three hinges balance the force F on the tip, `tau + J^T F = 0`, with the Jacobian J
of the tip, without gravity. The force from the torques equals the quasi-static force of `simulate` at this depth within
the stated error of the mesh (2.7 %). Needs `tissue_sim[mujoco]`.
"""

import sys

import numpy as np
from matplotlib.figure import Figure

import tissue_sim as ts
from tissue_sim.realtime.engines.mujoco import MujocoTissue

MJCF = """<mujoco><option timestep="0.002" integrator="implicitfast" gravity="0 0 0"/><default>
<joint axis="0 1 0" damping="1" armature=".1"/><geom contype="0" conaffinity="0"/><position kp="5e3" kv="60"/></default>
<worldbody><site name="tissue"/><body pos="-.311127 0 .1"><joint name="a"/><geom type="capsule" fromto="0 0 0 .22 0 0"
size=".02" mass="0.8"/><body pos=".22 0 0"><joint name="b"/><geom type="capsule" fromto="0 0 0 .22 0 0" size=".016"
mass="0.5"/><body name="needle" pos=".22 0 0"><joint name="c"/><geom type="cylinder" fromto="0 0 0 0 0 -.1" size=".008"
mass="0.2"/><site name="tip" pos="0 0 -.1"/></body></body></body></worldbody>
<actuator><position joint="a"/><position joint="b"/><position joint="c"/></actuator></mujoco>"""


def solve_inverse_kinematics(height: float) -> np.ndarray:
    """Return the joint angles with an upright tip on the axis of the tissue at a height, m."""
    elevation, bend = np.arctan2(height, 0.311127), np.arccos(np.hypot(0.311127, height) / 0.44)
    return np.array([-elevation - bend, 2.0 * bend, elevation - bend])


def run() -> Figure:
    import mujoco

    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
    model = ts.Model(ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(0.012, points=13),
                                   ts.Tool("flat", radius=8e-3), friction="bonded"), material)
    arm = mujoco.MjModel.from_xml_string(MJCF)
    data, wrenches = mujoco.MjData(arm), []
    data.qpos[:] = solve_inverse_kinematics(0.002)
    tissue = MujocoTissue(arm, data, body="needle", tissue=ts.Simulator(model, resolution="realtime_20"))
    for height in np.interp(np.arange(1500) * 0.002, [0, 2], [0.002, -0.010]):
        data.ctrl[:] = solve_inverse_kinematics(height)
        wrenches.append(tissue.step())
    jacobian = np.zeros((3, arm.nv))
    mujoco.mj_jacSite(arm, data, jacobian, None, arm.site("tip").id)
    force = -np.linalg.lstsq(jacobian.T, data.qfrc_actuator, rcond=None)[0][2]
    quasi_static, depths = ts.simulate(model, resolution="accurate"), [wrench.pose.depth for wrench in wrenches]
    expected = np.interp(depths[-1], quasi_static.displacement, quasi_static.force)
    assert abs(force / expected - 1.0) < 0.027
    axes = (figure := Figure(figsize=(5, 3.4), layout="constrained")).subplots()
    axes.plot(1e3 * np.array(depths), [wrench.force[2] for wrench in wrenches], label="force on the arm")
    axes.plot(1e3 * depths[-1], force, "s", label="from the joint torques at rest")
    axes.plot(quasi_static.displacement * 1e3, quasi_static.force, "o", label="quasi-static, accurate", zorder=0)
    axes.set(xlabel="depth [mm]", ylabel="force [N]", title="Arm of three joints in MuJoCo")
    axes.legend(frameon=False)
    return figure


if __name__ == "__main__":
    run().savefig(sys.argv[1] if len(sys.argv) > 1 else "mujoco_arm.png")
