"""A robot arm of five joints in MuJoCo presses a needle into a solid: coupled forces against the same path offline."""

from __future__ import annotations

import math
import time
import warnings
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

import tissue_sim as ts
from haptics.loop.multirate import MultiRateTissue
from tissue_sim.pose import Pose
from tissue_sim.realtime.engines.mujoco import MujocoTissue


@dataclass(frozen=True)
class ArmTest:
    """Test of an arm.

    Attributes:
        name: of the specimen.
        model: experiment and material.
        box: box of the reduced solid, larger than the motion.
        depth: of the tip, m.
        sideways: displacement of the tip to the side, m, along (0.8, 0.6).
        hold: time of each of the `HOLDS` holds, s.
    """

    name: str
    model: ts.Model
    box: ts.PoseBox
    depth: float
    sideways: float
    hold: float = 0.2

    @property
    def corners(self) -> np.ndarray:
        """Corners of the path of the tip, m, and times of the motion to each, s, shape (n, 4)."""
        x, y, z, hold = 0.8 * self.sideways, 0.6 * self.sideways, -self.depth, self.hold
        return np.array([(0.0, 0.0, self.depth / 6.0, 0.0), (0.0, 0.0, z, 1.2), (0.0, 0.0, z, hold), (x, y, z, 0.8),
                         (x, y, z, hold), (0.0, 0.0, 0.0, 1.2), (0.0, 0.0, 0.0, hold)])


def make_model(specimen: ts.Specimen, depth: float, bulk_ratio: float) -> ts.Model:
    """Make a test with a bonded flat needle of 8 mm radius in the silicone of the study."""
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", bulk_ratio))
    return ts.Model(ts.Experiment(specimen, ts.Protocol.ramp(depth, 2), friction="bonded",
                                  tool=ts.Tool("flat", radius=8e-3)), material)


#: A small cylinder and that of the study.
TESTS = (ArmTest("60 x 20 mm", make_model(ts.Specimen(0.030, 0.020), 3e-3, 1e3),
                 ts.PoseBox(sideways=2.5e-3, depth=4.5e-3, turn=math.radians(2.0)), 3e-3, 1.5e-3),
         ArmTest("80 x 70 mm", make_model(ts.Specimen(0.040, 0.070), 10e-3, 1e4),
                 ts.PoseBox(sideways=6.5e-3, depth=12e-3, turn=math.radians(2.0)), 10e-3, 5e-3))

#: Number of holds of a path.
HOLDS = 3
#: Time of the motions of a path without holds, s.
MOTION_TIME = 3.2
#: Simulated time of a run, s.
SECONDS = 3.8
#: Step of the engine, s.
STEP = 2e-3
#: Every how many poses of a run the quasi-static solid is solved offline.
SPARSE = 5

MJCF = f"""<mujoco><option timestep="{STEP}" integrator="implicitfast"/>
<default><joint type="hinge" axis="0 1 0" damping="1" armature="0.01"/><geom contype="0" conaffinity="0"/>
<position kp="2000" kv="40"/></default>
<worldbody><site name="tissue"/>
<body name="base" pos="-.311127 0 .1" gravcomp="1"><joint name="yaw" axis="0 0 1"/>
<geom type="cylinder" size=".03 .06" pos="0 0 -.06" mass="2"/>
<body name="upper" gravcomp="1"><joint name="shoulder"/>
<geom type="capsule" fromto="0 0 0 .22 0 0" size=".02" mass="0.8"/>
<body name="fore" pos=".22 0 0" gravcomp="1"><joint name="elbow"/>
<geom type="capsule" fromto="0 0 0 .22 0 0" size=".016" mass="0.5"/>
<body name="wrist" pos=".22 0 0" gravcomp="1"><joint name="pitch"/><geom type="sphere" size=".02" mass="0.2"/>
<body name="needle" gravcomp="1"><joint name="roll" axis="0 0 1"/>
<geom type="cylinder" fromto="0 0 0 0 0 -.1" size=".008" mass="0.1"/><site name="tip" pos="0 0 -.1"/>
</body></body></body></body></body></worldbody>
<actuator><position joint="yaw"/><position joint="shoulder"/><position joint="elbow"/><position joint="pitch"/>
<position joint="roll"/></actuator>
</mujoco>"""
#: Joint angles with the tip at the centre of the tissue, upright.
HOME = (0.0, -0.25 * math.pi, 0.5 * math.pi, -0.25 * math.pi, 0.0)


@dataclass
class ArmRun:
    """Poses of the tool in the scene, applied forces, N, stated errors, N, statuses, and wall time, s."""

    poses: list[Pose]
    forces: np.ndarray
    statuses: list[str]
    warnings: list[str]
    wall: float


def compute_path(test: ArmTest, step: float = STEP) -> np.ndarray:
    """Return the target of the tip at each step, m, shape (steps, 3), with half cosines between corners."""
    path = []
    for before, after in pairwise(test.corners):
        count = round(after[3] / step)
        part = 0.5 - 0.5 * np.cos(np.pi * np.arange(count) / count)
        path.append(before[:3] + part[:, None] * (after - before)[:3])
    return np.concatenate(path)


def solve_inverse_kinematics(model, path: np.ndarray) -> np.ndarray:
    """Return joint angles, rad, for each position of an upright tip, by damped least squares."""
    import mujoco

    data, site = mujoco.MjData(model), model.site("tip").id
    data.qpos[:] = HOME
    jacobian, angles = np.zeros((6, model.nv)), []
    for target in path:
        for _ in range(30):
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
            quaternion, turn = np.zeros(4), np.zeros(3)
            mujoco.mju_mat2Quat(quaternion, data.site_xmat[site])
            mujoco.mju_quat2Vel(turn, quaternion, 1.0)
            error = np.concatenate([target - data.site_xpos[site], -turn])
            if np.abs(error).max() < 1e-9:
                break
            data.qpos += jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-8 * np.eye(6), error)
        angles.append(data.qpos.copy())
    return np.array(angles)


def run_arm(test: ArmTest, tissue) -> ArmRun:
    """Move the arm along the path of a test with a tissue."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(MJCF)
    angles = solve_inverse_kinematics(model, compute_path(test))
    data = mujoco.MjData(model)
    data.qpos[:] = angles[0]
    mujoco.mj_forward(model, data)
    poses, forces, statuses = [], [], []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        coupled = MujocoTissue(model, data, body="needle", tissue=tissue)
        began = time.perf_counter()
        for target in angles:
            data.ctrl[:] = target
            wrench = coupled.step()
            poses.append(wrench.pose)
            forces.append(wrench.force)
            statuses.append(wrench.status.name)
    texts = [str(each.message) for each in caught if not issubclass(each.category, DeprecationWarning)]
    return ArmRun(poses, np.array(forces), statuses, texts, time.perf_counter() - began)


def make_whole_solid(model: ts.Model, inertia: str) -> ts.Simulator:
    """Make the whole solid, compiled."""
    solid = ts.Simulator(model, solver="solid", resolution="realtime", inertia=inertia)
    solid.warm_up()
    return solid


def compute_offline_forces(model: ts.Model, run: ArmRun, inertia: str, sparse: int) -> tuple[np.ndarray, np.ndarray]:
    """Step the whole solid along the poses of a run; return the numbers of the poses, and forces, N, shape (n, 3)."""
    solid, numbers, forces = make_whole_solid(model, inertia), [], []
    for number in range(0, len(run.poses), sparse):
        answer = solid.step(run.poses[number], 0.0 if not number else sparse * STEP)
        if answer.status is ts.ForceStatus.CONVERGED:
            numbers.append(number)
            forces.append(answer.wrench[:3])
    return np.array(numbers), np.array(forces)


def compare_with_offline(test: ArmTest, name: str, run: ArmRun, inertia: str, sparse: int) -> dict:
    """Return the errors of the applied force over the peak force, and the curves."""
    numbers, offline = compute_offline_forces(test.model, run, inertia, sparse)
    peak = float(np.linalg.norm(offline, axis=1).max())
    error = np.linalg.norm(run.forces[numbers] - offline, axis=1) / peak
    return {"specimen": test.name, "tissue": name, "steps": len(run.poses), "peak_force": peak,
            "rms_error": float(np.sqrt((error**2).mean())),
            "largest_error": float(error.max()), "step_wall_s": run.wall / len(run.poses),
            "not_converged": sum(status != "CONVERGED" for status in run.statuses), "compared": len(numbers),
            "depth": -min(pose.position[2] for pose in run.poses), "warnings": sorted(set(run.warnings)),
            "times": (STEP * np.arange(len(run.poses))).tolist(), "forces": run.forces.tolist(),
            "offline_times": (STEP * numbers).tolist(), "offline_forces": offline.tolist()}


def measure_test(test: ArmTest) -> list[dict]:
    """Return `compare_with_offline` of the whole, the reduced and the multirate solid of a test."""
    run = run_arm(test, make_whole_solid(test.model, "auto"))
    rows = [compare_with_offline(test, "whole solid", run, "auto", 1)]
    reduced = ts.reduce_solid(test.model, test.box)
    run = run_arm(test, ts.Simulator(reduced.model, solver="reduced", mesh=reduced))
    rows.append(compare_with_offline(test, "reduced solid", run, "off", SPARSE))
    tissue = MultiRateTissue(test.model, waits=True)
    try:
        run = run_arm(test, tissue)
    finally:
        tissue.close()
    return [*rows, compare_with_offline(test, "multirate", run, "off", SPARSE)]


def measure_arm(specimens: list[str] | None = None, seconds: float = SECONDS) -> list[dict]:
    """Return the comparisons of the tests.

    Args:
        specimens: names of the tests; None: all.
        seconds: simulated time of a run, s, more than `MOTION_TIME`; the holds last the rest in equal parts.
    """
    hold = (seconds - MOTION_TIME) / HOLDS
    return [row for test in TESTS if specimens is None or test.name in specimens
            for row in measure_test(replace(test, hold=hold))]
