"""Random motions with traps for solids in space: coarse, reduced, and multirate."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmarks.motions.course import Motion, Move, Operation, Reset, Scale
from benchmarks.motions.profiles import Key, pose_at, press_keys, profile, tick_length
from benchmarks.motions.scenes import Scene, multirate_scene, spatial_scene
from benchmarks.motions.traps import (
    Trap,
    a_third,
    copies,
    foreign_state,
    material_changed,
    moves,
    not_finite,
    pose_with,
    quaternions,
    refused_parameters,
    save_restore,
    spun,
    wild,
)
from tissue_sim.pose import Pose

#: Largest distance from the axis at which a tool comes down, m.
LARGEST_ASIDE = 0.6e-3
#: Ticks of hovering before a multirate motion in which models of the air come, at most.
MOST_HOVERING = 300


def _somewhere(chance: np.random.Generator) -> tuple[float, float]:
    angle, distance = chance.uniform(0.0, 2.0 * math.pi), chance.uniform(0.2, 1.0) * LARGEST_ASIDE
    return float(distance * math.cos(angle)), float(distance * math.sin(angle))


def _air(chance: np.random.Generator, x: float, y: float, dt: float, count: int) -> list[Operation]:
    """Return poses in the air; the last one is above a point at which the tool comes down."""
    poses = [Pose((*chance.uniform(-5e-3, 5e-3, 2).tolist(), float(chance.uniform(5e-4, 5e-3)))) for _ in range(count)]
    return moves([*poses, Pose((x, y, 3e-4))], dt)


def aside_in_the_air(chance: np.random.Generator, scene: Scene) -> Motion:
    """The tool jumps in the air and comes down off the axis."""
    dt = tick_length(scene, chance)
    x, y = _somewhere(chance)
    keys = press_keys(scene, chance, start=3e-4, origin=(x, y))
    air = _air(chance, x, y, dt, int(chance.integers(0, 4)))
    return Motion("aside in the air", scene, (*air, *moves(profile(scene, chance, dt, keys), dt)))


def spin_in_the_air(chance: np.random.Generator, scene: Scene) -> Motion:
    """The tool is turned about its axis in the air, and stays turned: nothing changes."""
    dt = tick_length(scene, chance)
    limit = math.radians(4.5) if scene.solver == "reduced" and scene.is_bonded else math.pi
    angle = float(chance.uniform(-limit, limit))
    x, y = _somewhere(chance) if chance.random() < 0.5 else (0.0, 0.0)
    keys = [replace(key, turn=(0.0, 0.0)) for key in press_keys(scene, chance, start=3e-4, origin=(x, y))]
    poses = profile(scene, chance, dt, keys)
    may_refuse = scene.solver == "reduced" and not scene.is_bonded
    return Motion("spin in the air", scene, tuple(Move(spun(pose, angle), dt, pose, may_refuse=may_refuse)
                                                  for pose in poses))


def lean_in_the_air(chance: np.random.Generator, scene: Scene) -> Motion:
    """A ball leans in the air and touches in this orientation: the same as an upright ball with the same centre."""
    dt = tick_length(scene, chance)
    lean, direction = float(chance.uniform(0.02, 0.15)), float(chance.uniform(0.0, 2.0 * math.pi))
    turn = (lean * math.cos(direction), lean * math.sin(direction), 0.0)
    operations = []
    for pose in profile(scene, chance, dt, press_keys(scene, chance, start=3e-4, lifts=False)):
        leaned = pose_with(pose, turn=turn)
        axis = np.array(leaned.rotation_matrix)[:, 2]
        lowest = np.array(pose.position) + scene.radius * (axis - [0.0, 0.0, 1.0])
        operations.append(Move(leaned, dt, Pose(tuple(lowest.tolist())), may_refuse=scene.solver == "reduced"))
    return Motion("lean in the air", scene, tuple(operations))


def touch_again(chance: np.random.Generator, scene: Scene) -> Motion:
    """A tool lifts off, moves aside in the air and touches there."""
    dt = tick_length(scene, chance)
    x, y = _somewhere(chance)
    press = profile(scene, chance, dt, [*press_keys(scene, chance, lifts=False), Key(3e-4)])
    again = profile(scene, chance, dt, press_keys(scene, chance, start=3e-4, lifts=False, origin=(x, y)))
    air = _air(chance, x, y, dt, int(chance.integers(0, 3)))
    return Motion("lift off and touch aside", scene, (*moves(press, dt), *air, *moves(again, dt)))


def start_inside(chance: np.random.Generator, scene: Scene) -> Motion:
    """The first step finds the tool at rest in the tissue, off the axis."""
    dt = tick_length(scene, chance)
    return Motion("start inside", scene, tuple(moves(_from_inside(scene, chance, dt), dt)))


def _from_inside(scene: Scene, chance: np.random.Generator, dt: float) -> list[Pose]:
    x, y = _somewhere(chance)
    inside = Key(-float(chance.uniform(0.2, 0.8)) * scene.depth, x, y, hold=int(chance.integers(1, 6)))
    return profile(scene, chance, dt, [inside, *press_keys(scene, chance, lifts=False, origin=(x, y))[2:]])


def reset_inside(chance: np.random.Generator, scene: Scene) -> Motion:
    """`reset` in contact; at the next step the tool is at rest elsewhere in the tissue, or in the air."""
    dt = tick_length(scene, chance)
    poses = profile(scene, chance, dt)
    at = a_third(poses, chance)
    rest = profile(scene, chance, dt) if chance.random() < 0.4 else _from_inside(scene, chance, dt)
    return Motion("reset inside", scene, (*moves(poses[:at], dt), Reset(), *moves(rest, dt)))


def teleport(chance: np.random.Generator, scene: Scene) -> Motion:
    """The tool jumps up and down in one tick."""
    dt = tick_length(scene, chance)
    poses = profile(scene, chance, dt, press_keys(scene, chance, lifts=False))
    at = a_third(poses, chance)
    x, y, _ = poses[at - 1].position
    jumped = []
    for _ in range(3):
        z = float(chance.uniform(-0.9 * scene.depth, 0.0 if scene.is_bonded else 2e-3))
        jumped.append(replace(poses[at - 1], position=(x, y, z)))
    back = replace(poses[at], position=(x, y, poses[at].position[2]))
    return Motion("teleport", scene, tuple(moves([*poses[:at], *jumped, back, *poses[at:]], dt)))


def out_of_the_box(chance: np.random.Generator, scene: Scene) -> Motion:
    """The tool leaves the box of a reduced solid and comes back the same way."""
    dt = tick_length(scene, chance)
    poses = profile(scene, chance, dt, press_keys(scene, chance, lifts=False))
    at = a_third(poses, chance)
    x, y, z = poses[at].position
    away = [pose_at((x + (12e-3 if chance.random() < 0.5 else 0.0) * s, y, z - 3e-3 * s, 0.0, 0.0))
            for s in (0.5, 1.0, 0.5)]
    turned = [replace(pose, orientation=poses[at].orientation) for pose in away]
    return Motion("out of the box", scene, (*moves(poses[:at + 1], dt),
                                            *(Move(pose, dt, pose, is_unknown=True) for pose in turned),
                                            *moves(poses[at:], dt)))


def _in_space(trap: Callable[[np.random.Generator, Scene], Motion], *, elastic: bool = False, **options: object
              ) -> Trap:
    """Register a trap for a random 3D solid."""
    def drawn(chance: np.random.Generator) -> Motion:
        scene = spatial_scene(chance, **options)  # type: ignore[arg-type]  # keywords of spatial_scene
        return trap(chance, replace(scene, prony=()) if elastic else scene)
    return drawn


#: Traps of coarse and reduced solids in space: name, motion, weight.
SPATIAL: dict[str, tuple[Trap, float]] = {
    "aside in the air": (_in_space(aside_in_the_air), 3.0), "spin in the air": (_in_space(spin_in_the_air), 1.5),
    "lean in the air": (_in_space(lean_in_the_air, solver="solid", bonded=False), 1.0),
    "lift off and touch aside": (_in_space(touch_again, bonded=False), 2.0),
    "start inside": (_in_space(start_inside), 2.0), "reset inside": (_in_space(reset_inside), 2.0),
    "teleport": (_in_space(teleport), 1.0),
    "out of the box": (_in_space(out_of_the_box, solver="reduced", bonded=True), 1.0),
    "not finite": (_in_space(not_finite), 1.0), "wild input": (_in_space(wild), 1.0),
    "rounded quaternions": (_in_space(quaternions), 0.7), "deepcopy": (_in_space(copies("deepcopy")), 0.5),
    "pickle": (_in_space(copies("pickle")), 0.5), "clone": (_in_space(copies("clone")), 1.0),
    "save and restore": (_in_space(save_restore), 1.0),
    "state of another model": (_in_space(foreign_state, solver="solid"), 0.5),
    "material changed": (_in_space(material_changed, elastic=True), 1.0),
    "refused parameters": (_in_space(refused_parameters), 0.3)}


def _hovering(trap: Callable[[np.random.Generator, Scene], Motion], *, slow: bool | None = None,
              bonded: bool | None = None) -> Trap:
    """Register a trap for a random multirate scene, with time in the air in which models arrive.

    Args:
        trap: for any scene.
        slow: whether models are late; None: random.
        bonded: whether the tool holds the tissue; None: random.
    """
    def drawn(chance: np.random.Generator) -> Motion:
        late = bool(chance.random() < 0.4) if slow is None else slow
        motion = trap(chance, multirate_scene(chance, bonded=bonded, slow=late))
        first = motion.operations[0]
        assert isinstance(first, Move)
        if first.truth is None or first.truth.position[2] < 0.0:
            return motion
        above = Pose((*first.truth.position[:2], first.truth.position[2] + 5e-4))
        hover = moves([above] * int(chance.integers(0, MOST_HOVERING)), 1e-3)
        operations: list[Operation] = [*hover]
        for operation in motion.operations:
            like = getattr(operation, "like", None)
            operations.append(operation if like is None else replace(operation, like=like + len(hover)))
        return replace(motion, operations=tuple(operations))
    return drawn


def waits_in_the_air(chance: np.random.Generator, scene: Scene) -> Motion:
    """A tool waits at small heights above the tissue, which it has never touched, then presses."""
    operations: list[Operation] = []
    for _ in range(3):
        x, y = _somewhere(chance)
        operations += moves([Pose((x, y, float(chance.uniform(1e-5, 3e-3))))] * int(chance.integers(10, 60)), 1e-3)
    keys = press_keys(scene, chance, start=3e-4, lifts=False, origin=(x, y))
    return Motion("waits in the air", scene, (*operations, *moves(profile(scene, chance, 1e-3, keys), 1e-3)))


def pauses(chance: np.random.Generator, scene: Scene) -> Motion:
    """Irregular ticks, ticks of no time, and pauses."""
    operations: list[Operation] = []
    for pose in profile(scene, chance, 1e-3):
        kind = chance.random()
        dt = float(chance.uniform(0.5e-3, 2e-3)) if kind > 0.03 else 0.0 if kind > 0.015 else 0.3
        operations.append(Move(pose, dt, pose))
    return Motion("pauses and irregular ticks", scene, tuple(operations))


def material_under_load(chance: np.random.Generator, scene: Scene) -> Motion:
    """All moduli change under load, and the tool rests, then continues."""
    poses = profile(scene, chance, 1e-3, press_keys(scene, chance, lifts=False))
    at = a_third(poses, chance)
    rest = [poses[at - 1]] * int(chance.integers(30, 250))
    operations = (*moves(poses[:at], 1e-3), Scale(float(chance.choice([0.5, 0.8, 1.3, 2.0]))), *moves(rest, 1e-3),
                  *moves(poses[at:], 1e-3))
    return Motion("material changed", scene, operations)


def press(chance: np.random.Generator, scene: Scene) -> Motion:
    """A press; the models of the bulk come late."""
    return Motion("slow bulk", scene, tuple(moves(profile(scene, chance, 1e-3), 1e-3)))


#: Traps of multirate scenes: name, motion, weight.
MULTIRATE: dict[str, tuple[Trap, float]] = {
    "slow bulk": (_hovering(press, slow=True), 2.0), "material changed": (_hovering(material_under_load), 2.0),
    "waits in the air": (_hovering(waits_in_the_air), 2.0),
    "aside in the air": (_hovering(aside_in_the_air), 1.5), "spin in the air": (_hovering(spin_in_the_air), 1.0),
    "lift off and touch aside": (_hovering(touch_again, bonded=False), 1.5),
    "start inside": (_hovering(start_inside), 1.5), "reset inside": (_hovering(reset_inside), 1.5),
    "teleport": (_hovering(teleport), 1.0), "not finite": (_hovering(not_finite), 1.0),
    "wild input": (_hovering(wild), 1.0), "rounded quaternions": (_hovering(quaternions), 0.5),
    "deepcopy": (_hovering(copies("deepcopy")), 0.5), "pickle": (_hovering(copies("pickle")), 0.5),
    "clone": (_hovering(copies("clone")), 0.5), "pauses and irregular ticks": (_hovering(pauses), 1.0),
    "refused parameters": (_hovering(refused_parameters), 0.5)}
