"""Tools on slides in MuJoCo and Newton, coupled with a tissue: stability while held, and work of closed cycles."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product

import numpy as np

import tissue_sim as ts
from tissue_sim.realtime.engines.mujoco import MujocoTissue
from tissue_sim.realtime.engines.newton import NewtonTissue

MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
#: Needle of the reference study.
NEEDLE = ts.Model(ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(0.010, 2), friction="bonded",
                                tool=ts.Tool("flat", radius=8e-3)), MATERIAL)
#: Needle off the axis of a small cylinder, in three dimensions.
OFF_AXIS = ts.Model(ts.Experiment(ts.Specimen(0.030, 0.030), ts.Protocol.ramp(1.5e-3, 2), friction="bonded",
                                  tool=ts.Tool("flat", radius=6e-3), approach=ts.Approach(offset=8e-3, angle=0.0)),
                    ts.Material("neo_hooke", {"C10": 1400.0}, ts.Bulk("bulk_ratio", 1e3)))
#: Resolution of the needle on the axis.
RESOLUTION = "realtime_20"
#: Masses of the tools, kg.
MASSES = (0.002, 0.02, 0.2, 1.0)
#: Masses of the tools of closed cycles, kg; the lightest are lighter than the tissue that moves with them.
CYCLE_MASSES = (0.001, 0.002, 0.004, 0.006, 0.02, 0.2)
#: Stiffness of the servos, N/m.
SERVOS = (100.0, 500.0, 2000.0)
#: Steps of the engine, s.
STEPS = (0.5e-3, 1e-3, 2e-3)
#: Height of the tool above the tissue at the start of a hold, m.
CLEARANCE = 1e-3
#: Speed of the target of the servo before a hold, m/s.
SPEED = 0.05
#: Depth of the target of the servo, m.
DEPTH = 5e-3
#: Time of the hold before the force is evaluated, s.
HOLD = 0.5
#: Time of the evaluation, s.
EVALUATION = 0.2
#: Step of the target in the air, m.
AIR_STEP = 1e-3
#: Largest variation of a held force.
STABLE = 0.01

_MJCF = """<mujoco><option timestep="{dt}" integrator="implicitfast" gravity="0 0 0"/><worldbody>
<body name="needle" pos="{x} 0 {z}"><joint name="x" type="slide" axis="1 0 0"/>
<joint name="z" type="slide" axis="0 0 1"/>
<geom type="cylinder" size=".008 .03" pos="0 0 .03" mass="{mass}" contype="0" conaffinity="0"/><site name="tip"/></body>
</worldbody><actuator><position joint="x" kp="{kp}" kv="{kv}"/><position joint="z" kp="{kp}" kv="{kv}"/></actuator>
</mujoco>"""


@dataclass
class Motion:
    """Motion of a tool and forces on it, one entry per step of the engine.

    Attributes:
        positions: of the tip along x and z at the start of each step, m; one more entry for the end.
        applied: force that the engine applied, N.
        tissue: force of the tissue at the pose at the start of each step, N.
        statuses: names of the statuses that occurred.
    """

    positions: list[tuple[float, float]] = field(default_factory=list)
    applied: list[tuple[float, float]] = field(default_factory=list)
    tissue: list[tuple[float, float]] = field(default_factory=list)
    statuses: set[str] = field(default_factory=set)

    def add(self, position: tuple[float, float], wrench) -> None:
        self.positions.append(position)
        self.statuses.add(wrench.status.name)
        self.applied.append((wrench.force[0], wrench.force[2]))
        self.tissue.append((wrench.answer.wrench[0], wrench.answer.wrench[2]))


def run_mujoco(simulator, mass: float, stiffness: float, dt: float, seconds: float,
               target: Callable[[float], tuple[float, float]], start: tuple[float, float] = (0.0, 0.0)) -> Motion:
    """Move a tool on slides along x and z by critically damped servos; without a simulator it moves in the air."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(_MJCF.format(
        dt=dt, x=start[0], z=start[1], mass=mass, kp=stiffness, kv=2.0 * math.sqrt(stiffness * mass)))
    data, motion, tissue = mujoco.MjData(model), Motion(), None
    if simulator is not None:
        simulator.reset()
        tissue = MujocoTissue(model, data, body="needle", tissue=simulator, scene=ts.Pose((0.0, 0.0, 0.0)))
    for number in range(round(seconds / dt)):
        data.ctrl[:] = np.subtract(target(number * dt), start)
        position = (start[0] + float(data.qpos[0]), start[1] + float(data.qpos[1]))
        if tissue is not None:
            motion.add(position, tissue.step())
        else:
            motion.positions.append(position)
            mujoco.mj_step(model, data)
    motion.positions.append((start[0] + float(data.qpos[0]), start[1] + float(data.qpos[1])))
    return motion


def run_newton(simulator, mass: float, stiffness: float, dt: float, seconds: float,
               target: Callable[[float], tuple[float, float]], start: tuple[float, float] = (0.0, 0.0)) -> Motion:
    """Move a tool on a slide along z in Newton's `SolverFeatherstone`; without a simulator it moves in the air."""
    import warp as wp

    wp.config.quiet = True  # before Newton is imported, which prints otherwise
    import newton

    builder, moment = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0)), 1e-4 * mass
    frame = wp.transform((start[0], 0.0, start[1]), wp.quat_identity())
    body = builder.add_link(mass=mass, inertia=wp.mat33(moment, 0, 0, 0, moment, 0, 0, 0, moment),
                            com=wp.vec3(0, 0, 0.03), label="needle", xform=frame, lock_inertia=True)
    builder.add_articulation([builder.add_joint_prismatic(
        -1, body, parent_xform=frame, axis=newton.Axis.Z, target_ke=stiffness, target_q=0.0, armature=0.0,
        target_kd=2.0 * math.sqrt(stiffness * mass))])
    model = builder.finalize(device="cpu")
    state, after, control = model.state(), model.state(), model.control()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    solver, motion, tissue = newton.solvers.SolverFeatherstone(model), Motion(), None
    if simulator is not None:
        simulator.reset()
        tissue = NewtonTissue(model, body="needle", tissue=simulator)

    def find_position() -> tuple[float, float]:
        x, _, z = state.body_q.numpy()[0][:3].astype(float)
        return float(x), float(z)

    for number in range(round(seconds / dt)):
        control.joint_target_q.assign([target(number * dt)[1] - start[1]])
        state.clear_forces()
        if tissue is None:
            motion.positions.append(find_position())
        else:
            motion.add(find_position(), tissue.apply(state, dt))
        solver.step(state, after, control, None, dt)
        state, after = after, state
    motion.positions.append(find_position())
    return motion


#: Functions that move a tool in an engine.
ENGINES = {"MuJoCo": run_mujoco, "Newton": run_newton}


def measure_variation(values: np.ndarray, scale: float) -> float:
    """Return the range of values over a scale; infinity if a value is not finite."""
    if not np.isfinite(values).all() or not scale:
        return math.inf
    return float(values.max() - values.min()) / abs(scale)


def measure_hold(engine: str, simulator, mass: float, stiffness: float, dt: float) -> dict:
    """Hold a tool in the tissue; an unstable servo is also tried in the air.

    Returns:
        ``variation`` of the applied force after `HOLD` over its mean, ``force``, N, ``statuses``, and ``air``: range of
        the position after `HOLD` over a step of the target in the air, None if the hold was stable.
    """
    run, held = ENGINES[engine], round(HOLD / dt)
    ramp = (CLEARANCE + DEPTH) / SPEED
    motion = run(simulator, mass, stiffness, dt, ramp + HOLD + EVALUATION,
                 lambda time: (0.0, max(CLEARANCE - SPEED * time, -DEPTH)), (0.0, CLEARANCE))
    forces = np.array(motion.applied)[-round(EVALUATION / dt):, 1]
    row = {"engine": engine, "mass": mass, "servo": stiffness, "step": dt, "force": float(forces.mean()),
           "variation": measure_variation(forces, float(forces.mean())), "statuses": sorted(motion.statuses),
           "air": None}
    if not row["variation"] <= STABLE:
        air = run(None, mass, stiffness, dt, HOLD + EVALUATION, lambda _: (0.0, AIR_STEP), (0.0, 0.0))
        row["air"] = measure_variation(np.array(air.positions)[held:, 1], AIR_STEP)
    return row


def measure_stability(engines=tuple(ENGINES), masses=MASSES, servos=SERVOS, steps=STEPS) -> list[dict]:
    """Return `measure_hold` for all engines, masses, servos and steps."""
    simulator = ts.Simulator(NEEDLE, resolution=RESOLUTION)
    simulator.warm_up()
    return [measure_hold(engine, simulator, mass, servo, step)
            for engine, mass, servo, step in product(engines, masses, servos, steps)]


def compute_net_work(motion: Motion, *, of_tissue: bool) -> float:
    """Return the work on the tool over its loading work (the work while the force opposes the motion).

    Args:
        motion: recorded motion.
        of_tissue: the force of the tissue, by the trapezoidal rule, instead of the force that the engine applied.
    """
    moved = np.diff(np.array(motion.positions), axis=0)
    forces = np.array(motion.applied)
    if of_tissue:
        tissue = np.array(motion.tissue)
        forces, moved = 0.5 * (tissue[:-1] + tissue[1:]), moved[:-1]
    work = (forces * moved).sum(axis=1)
    return float(work.sum() / -np.minimum(work, 0.0).sum())


def move_in_and_back(time: float) -> tuple[float, float]:
    """Return the target of the cycle on the axis: 10 mm in and back in 1 s."""
    return 0.0, -0.01 * (0.5 - 0.5 * math.cos(2.0 * math.pi * min(time, 1.0)))


def move_in_a_loop(time: float) -> tuple[float, float]:
    """Return the target of the cycle off the axis: 1.5 mm in and 1 mm to both sides in 1 s, from x = 8 mm."""
    angle = 2.0 * math.pi * min(time, 1.0)
    return 8e-3 + 1e-3 * math.sin(angle), -1.5e-3 * (0.5 - 0.5 * math.cos(angle))


def measure_cycle(name: str, simulator, mass: float, dt: float, target, seconds: float) -> dict:
    """Move a tool in MuJoCo along a closed path with a servo of 2000 N/m, and return the net work."""
    motion = run_mujoco(simulator, mass, 2000.0, dt, seconds, target, target(0.0))
    return {"tissue": name, "inertia": simulator.inertia, "mass": mass, "step": dt,
            "net_work": compute_net_work(motion, of_tissue=False),
            "net_work_of_tissue": compute_net_work(motion, of_tissue=True), "statuses": sorted(motion.statuses)}


def measure_cycles(masses=CYCLE_MASSES, steps=STEPS) -> list[dict]:
    """Return `measure_cycle` on the axis for all masses and steps, and off the axis for one."""
    rows = []
    for inertia in ("off", "auto"):
        simulator = ts.Simulator(NEEDLE, resolution=RESOLUTION, inertia=inertia)
        simulator.warm_up()
        rows += [measure_cycle("on the axis", simulator, mass, step, move_in_and_back, 1.5)
                 for mass, step in product(masses, steps)]
    solid = ts.Simulator(OFF_AXIS, solver="solid", resolution="realtime", inertia="off")
    solid.warm_up()
    return [*rows, measure_cycle("off the axis", solid, 0.2, STEPS[-1], move_in_a_loop, 1.3)]
