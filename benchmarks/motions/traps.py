"""Random motions with traps for axisymmetric simulators, and traps for every kind of simulator."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.motions.course import (
    ForeignState,
    Fork,
    Handover,
    Inspect,
    Motion,
    Move,
    Operation,
    OtherSimulator,
    RefusedParameters,
    Reset,
    Restore,
    Save,
    Scale,
)
from benchmarks.motions.inputs import bad_poses, rounded, wild_poses
from benchmarks.motions.profiles import Key, press_keys, profile, tick_length
from benchmarks.motions.scenes import Scene, axisymmetric_scene
from tissue_sim.pose import Pose, rotate_pose_about_its_position

#: Makes a motion from a source of random numbers.
Trap = Callable[[np.random.Generator], Motion]
#: Not a number.
NAN = math.nan
#: Infinity.
INF = math.inf


def moves(poses: Sequence[Pose], dt: float, **options: Any) -> list[Operation]:
    """Return a move to each pose."""
    return [Move(pose, dt, pose, **options) for pose in poses]


def a_third(poses: Sequence[Pose], chance: np.random.Generator) -> int:
    """Draw an index in the middle third of a motion."""
    return int(chance.integers(len(poses) // 4, 3 * len(poses) // 4))


def pose_with(pose: Pose, *, aside: tuple[float, float] = (0.0, 0.0), turn: tuple[float, float, float] = (0.0,) * 3
              ) -> Pose:
    """Return the pose displaced laterally, m, and rotated by a rotation vector, rad."""
    x, y, z = pose.position
    return rotate_pose_about_its_position(replace(pose, position=(x + aside[0], y + aside[1], z)), turn)


def spun(pose: Pose, angle: float) -> Pose:
    """Return the pose of a tool rotated about its own axis, rad."""
    half = 0.5 * angle
    w, x, y, z = pose.orientation
    c, s = math.cos(half), math.sin(half)
    return replace(pose, orientation=(w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s))


def clean(chance: np.random.Generator, scene: Scene | None = None) -> Motion:
    """Return a motion without a trap; half of the axisymmetric ones have depths instead of poses."""
    scene = scene or axisymmetric_scene(chance)
    dt = tick_length(scene, chance)
    poses = profile(scene, chance, dt)
    if scene.solver == "axisymmetric" and chance.random() < 0.5:
        return Motion("clean", scene, tuple(Move(pose.depth, dt, pose) for pose in poses),
                      checks_stiffness=scene.is_bonded)
    return Motion("clean", scene, tuple(moves(poses, dt)), checks_stiffness=scene.is_bonded)


def aside_in_the_air(chance: np.random.Generator) -> Motion:
    """The tool goes aside, leans and spins in the air, comes back to the axis and touches there."""
    scene = axisymmetric_scene(chance)
    dt = tick_length(scene, chance)
    poses = profile(scene, chance, dt, press_keys(scene, chance, start=float(chance.uniform(1e-4, 3e-3))))
    operations: list[Operation] = []
    for _ in range(int(chance.integers(3, 15))):
        away = Pose((*chance.uniform(-0.02, 0.02, 2).tolist(), float(chance.uniform(1e-3, 2e-2))))
        truth = Pose((0.0, 0.0, away.position[2]))
        operations.append(Move(rotate_pose_about_its_position(away, tuple(chance.uniform(-1.0, 1.0, 3).tolist())), dt,
                               truth, off_axis=True))
    return Motion("aside in the air", scene, (*operations, *moves(poses, dt)))


def off_axis_in_contact(chance: np.random.Generator) -> Motion:
    """The tool moves off the axis, or leans, in contact: answers must be marked."""
    scene = axisymmetric_scene(chance, inertia="off")
    dt = tick_length(scene, chance)
    poses = profile(scene, chance, dt)
    first = a_third(poses, chance)
    aside = chance.uniform(3e-4, 1e-2), chance.uniform(0.0, 2.0 * math.pi)
    if chance.random() < 0.5:
        change = {"aside": (aside[0] * math.cos(aside[1]), aside[0] * math.sin(aside[1]))}
    else:
        lean = chance.uniform(0.03, 1.5)
        change = {"turn": (lean * math.cos(aside[1]), lean * math.sin(aside[1]), 0.0)}
    changed = [Move(pose_with(pose, **change), dt, pose, off_axis=True) for pose in poses[first:]]
    return Motion("off the axis in contact", scene, (*moves(poses[:first], dt), *changed))


def spin(chance: np.random.Generator) -> Motion:
    """The tool spins about its axis all the time, which changes nothing."""
    scene = axisymmetric_scene(chance)
    dt = tick_length(scene, chance)
    rate, poses = float(chance.uniform(-50.0, 50.0)), profile(scene, chance, dt)
    return Motion("spin", scene, tuple(Move(spun(pose, rate * k * dt), dt, pose) for k, pose in enumerate(poses)))


def teleport(chance: np.random.Generator) -> Motion:
    """The tool jumps up or down in one tick: in the air, in the tissue or between both."""
    scene = axisymmetric_scene(chance, inertia="off")
    dt = tick_length(scene, chance)
    poses = profile(scene, chance, dt)
    at = a_third(poses, chance)
    jumps = [float(chance.uniform(-0.9 * scene.depth, 0.0 if scene.is_bonded else 5e-3)) for _ in range(3)]
    jumped = [Pose((0.0, 0.0, z)) for z in jumps for _ in range(int(chance.integers(1, 5)))]
    return Motion("teleport", scene, tuple(moves([*poses[:at], *jumped, *poses[at:]], dt)))


def start_inside(chance: np.random.Generator) -> Motion:
    """The first step finds the tool at rest in the tissue; it rests for some ticks, then moves."""
    scene = slowly_relaxing(axisymmetric_scene(chance))
    dt = tick_length(scene, chance)
    return Motion("start inside", scene, tuple(moves(_from_inside(scene, chance, dt), dt)))


def slowly_relaxing(scene: Scene) -> Scene:
    """Return the scene with relaxation times of at least 0.1 s: the contact time before the first step is unknown."""
    return replace(scene, prony=tuple((g, max(tau, 0.1)) for g, tau in scene.prony))


def _from_inside(scene: Scene, chance: np.random.Generator, dt: float) -> list[Pose]:
    inside = Key(-float(chance.uniform(0.2, 0.9)) * scene.depth, hold=int(chance.integers(1, 12)))
    return profile(scene, chance, dt, [inside, *press_keys(scene, chance)[2:]])


def reset_inside(chance: np.random.Generator) -> Motion:
    """`reset` in contact; the tool stays in the tissue, or is elsewhere in it at the next step."""
    scene = slowly_relaxing(axisymmetric_scene(chance))
    dt = tick_length(scene, chance)
    poses = profile(scene, chance, dt)
    at = a_third(poses, chance)
    rest = [poses[at]] * int(chance.integers(1, 8)) + poses[at:] if chance.random() < 0.5 else _from_inside(
        scene, chance, dt)
    return Motion("reset inside", scene, (*moves(poses[:at], dt), Reset(), *moves(rest, dt)))


def touch_again(chance: np.random.Generator) -> Motion:
    """The tool lifts off, moves aside and spins in the air, comes back and touches again, twice."""
    scene = axisymmetric_scene(chance, lifts=True)
    dt = tick_length(scene, chance)
    operations: list[Operation] = []
    for _ in range(2):
        operations += moves(profile(scene, chance, dt, [*press_keys(scene, chance, start=1e-4, lifts=False),
                                                        Key(1e-3)]), dt)
        for _ in range(int(chance.integers(1, 10))):
            away = Pose((*chance.uniform(-0.01, 0.01, 2).tolist(), float(chance.uniform(1e-3, 1e-2))))
            truth = Pose((0.0, 0.0, away.position[2]))
            operations.append(Move(rotate_pose_about_its_position(away, (0.0, 0.0, float(chance.uniform(-3.0, 3.0)))),
                                   dt, truth, off_axis=True))
    return Motion("lift off and touch again", scene, tuple(operations))


def rest_in_the_air(chance: np.random.Generator) -> Motion:
    """After a long rest in the air tissue that relaxes answers the same press as in the beginning."""
    scene = replace(axisymmetric_scene(chance, lifts=True, inertia="off"),
                    prony=((float(chance.uniform(0.1, 0.4)), float(chance.uniform(0.01, 0.5))),))
    dt = tick_length(scene, chance)
    press = profile(scene, chance, dt, press_keys(scene, chance, start=1e-4, lifts=False))
    up = moves([Pose((0.0, 0.0, 1e-3))], dt)
    longest = 40.0 * max(tau for _, tau in scene.prony)
    count = int(chance.integers(1, 6))
    pause = [Move(pose, longest / count, pose) for pose in [Pose((0.0, 0.0, 2e-3))] * count]
    again = [Move(pose, dt, pose, like=k) for k, pose in enumerate(press)]
    return Motion("long rest in the air", scene, (*moves(press, dt), *up, *pause, *again))


def with_refused(name: str, inputs: Callable[[np.random.Generator, Pose], list[tuple[Any, Any]]]
                 ) -> Callable[[np.random.Generator, Scene], Motion]:
    """A trap that puts inputs which must be refused between the ticks of a motion."""
    def trap(chance: np.random.Generator, scene: Scene) -> Motion:
        dt = tick_length(scene, chance)
        operations: list[Operation] = []
        for pose in profile(scene, chance, dt):
            if chance.random() < 0.15:
                every = inputs(chance, pose)
                given, step = every[int(chance.integers(len(every)))]
                operations.append(Move(given, step, None))
            operations.append(Move(pose, dt, pose))
        return Motion(name, scene, tuple(operations))
    return trap


not_finite = with_refused("not finite", bad_poses)
wild = with_refused("wild input", wild_poses)


def quaternions(chance: np.random.Generator, scene: Scene) -> Motion:
    """Orientations of four or five decimals, and drifted ones, of a tool that spins about its axis."""
    dt = tick_length(scene, chance)
    rate = float(chance.uniform(1.0, 30.0)) if scene.solver == "axisymmetric" else 0.0
    operations = []
    for k, pose in enumerate(profile(scene, chance, dt)):
        seed = int(chance.integers(2**31))
        turned_pose = spun(pose, rate * k * dt)
        operations.append(Move(lambda pose=turned_pose, seed=seed: rounded(pose, np.random.default_rng(seed)), dt,
                               pose))
    return Motion("rounded quaternions", scene, tuple(operations))


def copies(how: str) -> Callable[[np.random.Generator, Scene], Motion]:
    """A trap that copies the simulator in a motion: the copy continues, the original moves elsewhere."""
    def trap(chance: np.random.Generator, scene: Scene) -> Motion:
        dt = tick_length(scene, chance)
        poses = profile(scene, chance, dt)
        at = a_third(poses, chance)
        other = [poses[at - 1]] * 3 + poses[at - 1:max(0, at - 12):-1]
        operations = [*moves(poses[:at], dt), Fork(how)]
        for number, pose in enumerate(poses[at:]):
            operations.append(Move(pose, dt, pose, copy=True))
            if number < len(other):
                operations.append(Move(other[number], dt, other[number]))
        return Motion(how, scene, tuple(operations))
    return trap


def save_restore(chance: np.random.Generator, scene: Scene) -> Motion:
    """An excursion that `restore` undoes, in the same simulator or in a new one of the same model."""
    dt = tick_length(scene, chance)
    poses = profile(scene, chance, dt)
    at = a_third(poses, chance)
    away = poses[at:at + 10] + poses[at::-3][:8]
    operations = (*moves(poses[:at], dt), Save(), *moves(away, dt), Restore(elsewhere=bool(chance.random() < 0.5)),
                  *moves(poses[at:], dt))
    return Motion("save and restore", scene, operations)


def foreign_state(chance: np.random.Generator, scene: Scene) -> Motion:
    """`restore` of a state of another tool, specimen, memory or interface."""
    dt = tick_length(scene, chance)
    poses = profile(scene, chance, dt)
    at = a_third(poses, chance)
    height = scene.specimen[1]
    others = [replace(scene, specimen=(scene.specimen[0], height * float(chance.choice([0.9, 1.05])))),
              replace(scene, prony=(*scene.prony, (0.2, 0.3)))]
    if scene.shape != "plate":
        others.append(replace(scene, radius=scene.radius * float(chance.choice([0.98, 1.03])),
                              tool_options=tuple((name, 0.9 * value) for name, value in scene.tool_options)))
    # Solids have one mesh. Specimens between frictionless plates deform homogeneously: their mesh is the same at every
    # resolution.
    is_homogeneous = scene.shape == "plate" and scene.friction == "frictionless"
    if scene.solver == "axisymmetric" and scene.resolution == "realtime_20" and not is_homogeneous:
        others.append(replace(scene, resolution="realtime_35"))
    other = others[int(chance.integers(len(others)))]
    operations = (*moves(poses[:at], dt), ForeignState(other, 0.5 * scene.depth), *moves(poses[at:], dt))
    return Motion("state of another model", scene, operations)


def material_changed(chance: np.random.Generator, scene: Scene) -> Motion:
    """All moduli change under load: all forces of elastic tissue change by the same factor."""
    dt = tick_length(scene, chance)
    poses = profile(scene, chance, dt)
    operations: list[Operation] = []
    changes = set(chance.integers(2, len(poses), 3).tolist())
    for number, pose in enumerate(poses):
        if number in changes:
            operations.append(Scale(float(chance.choice([0.5, 0.8, 1.5, 2.0]))))
            operations += moves([poses[number - 1]] * int(chance.integers(1, 4)), dt)
        operations.append(Move(pose, dt, pose))
    return Motion("material changed", scene, tuple(operations), checks_stiffness=scene.is_bonded)


def refused_parameters(chance: np.random.Generator, scene: Scene) -> Motion:
    """Parameters that are refused change nothing."""
    dt = tick_length(scene, chance)
    poses = profile(scene, chance, dt)
    at = a_third(poses, chance)
    name, value = scene.parameters[0]
    # A law with two moduli remains one of tissue if one of them is zero or slightly negative: only their sum counts.
    other = sum(each for _, each in scene.parameters[1:]) if scene.law == "mooney_rivlin" else 0.0
    wrong = [(name, NAN), (name, -value - other), (name, INF), ("C99", 1.0), (name, 1e30), (name, -other)]
    given = wrong[int(chance.integers(len(wrong)))]
    return Motion("refused parameters", scene,
                  (*moves(poses[:at], dt), RefusedParameters((given,)), *moves(poses[at:], dt)))


def budget(chance: np.random.Generator) -> Motion:
    """A steady push, and one that turns round, with few linear solutions a step: no stale stiffness is unmarked."""
    inertia = str(chance.choice(["on", "auto", "off"], p=[0.6, 0.2, 0.2]))
    scene = axisymmetric_scene(chance, inertia=inertia)
    while scene.shape == "plate" and inertia != "off":  # waves of a plate depend on the ticks that a LATE step merges
        scene = axisymmetric_scene(chance, inertia=inertia)
    scene = replace(scene, max_solves=int(chance.integers(3, 7)))
    speed = float(chance.uniform(0.005, 0.05))
    count = min(160, round(scene.depth / (speed * 1e-3)))
    poses = [Pose((0.0, 0.0, -speed * 1e-3 * k)) for k in range(count + 1)]
    poses += poses[:len(poses) // 2:-1]
    return Motion("few solutions a step", scene, tuple(moves(poses, 1e-3)), checks_stiffness=scene.is_bonded)


def pauses(chance: np.random.Generator) -> Motion:
    """Irregular ticks, ticks of no time, and pauses of 0.1 to 10 s at rest and in motion."""
    scene = axisymmetric_scene(chance, inertia=str(chance.choice(["off", "auto"])))
    poses = profile(scene, chance, 1e-3)
    has_mass = scene.inertia != "off"
    operations: list[Operation] = []
    for pose in poses:
        kind = chance.random()
        dt = float(chance.uniform(0.5e-3, 2e-3))
        if kind < 0.06:
            operations += [Move(pose, 1e-3, pose), Move(pose, float(chance.choice([0.1, 1.0, 10.0])), pose)]
            continue
        if kind < 0.12 and not has_mass:
            dt = 0.0
        elif kind < 0.18 and not has_mass:
            dt = float(chance.uniform(0.01, 0.5))
        operations.append(Move(pose, dt, pose))
    return Motion("pauses and irregular ticks", scene, tuple(operations))


def bystanders(chance: np.random.Generator) -> Motion:
    """Snapshots, other simulators and another thread between the ticks change nothing."""
    scene = axisymmetric_scene(chance)
    dt = tick_length(scene, chance)
    operations: list[Operation] = []
    for pose in profile(scene, chance, dt):
        kind = chance.random()
        if kind < 0.04:
            operations.append(Inspect())
        elif kind < 0.07:
            other = replace(scene, radius=0.95 * scene.radius) if chance.random() < 0.5 else scene
            operations.append(OtherSimulator(other, tuple(chance.uniform(0.0, scene.depth, 3).tolist())))
        elif kind < 0.08:
            operations.append(Handover())
        operations.append(Move(pose, dt, pose))
    return Motion("other simulators and threads", scene, tuple(operations))


def too_deep(chance: np.random.Generator) -> Motion:
    """The tool goes far beyond where an equilibrium exists, and comes back."""
    scene = axisymmetric_scene(chance, elastic=True, inertia="off")
    while scene.has_friction:
        scene = axisymmetric_scene(chance, elastic=True, inertia="off")
    poses = profile(scene, chance, 1e-3)
    at = a_third(poses, chance)
    deep = Pose((0.0, 0.0, -float(chance.uniform(0.6, 3.0)) * scene.specimen[1]))
    beyond = [Move(deep, 1e-3, deep, is_unknown=True)] * int(chance.integers(1, 3))
    return Motion("too deep", scene, (*moves(poses[:at], 1e-3), *beyond, *moves(poses[at:], 1e-3)))


def _on_axis(trap: Callable[[np.random.Generator, Scene], Motion], **options: Any) -> Trap:
    """Register a trap for any scene, on the axis of an axisymmetric one."""
    def drawn(chance: np.random.Generator) -> Motion:
        return trap(chance, axisymmetric_scene(chance, **options))
    return drawn


#: Traps of axisymmetric scenes: name, motion, weight.
AXISYMMETRIC: dict[str, tuple[Trap, float]] = {
    "aside in the air": (aside_in_the_air, 2.0), "off the axis in contact": (off_axis_in_contact, 1.5),
    "spin": (spin, 0.5), "teleport": (teleport, 1.5), "start inside": (start_inside, 2.0),
    "reset inside": (reset_inside, 2.0), "lift off and touch again": (touch_again, 2.0),
    "long rest in the air": (rest_in_the_air, 1.0), "not finite": (_on_axis(not_finite), 1.5),
    "wild input": (_on_axis(wild), 1.0), "rounded quaternions": (_on_axis(quaternions), 1.0),
    "deepcopy": (_on_axis(copies("deepcopy")), 0.7), "copy": (_on_axis(copies("copy")), 0.3),
    "pickle": (_on_axis(copies("pickle")), 0.5), "clone": (_on_axis(copies("clone")), 1.5),
    "save and restore": (_on_axis(save_restore), 1.5), "state of another model": (_on_axis(foreign_state), 1.0),
    "material changed": (_on_axis(material_changed, elastic=True, inertia="off"), 1.5),
    "refused parameters": (_on_axis(refused_parameters), 0.5), "few solutions a step": (budget, 2.0),
    "pauses and irregular ticks": (pauses, 1.5), "other simulators and threads": (bystanders, 0.7),
    "too deep": (too_deep, 0.5)}
