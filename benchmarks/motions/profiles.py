"""Random smooth motions of a tool: keys joined by minimum-jerk segments.

Source of the segments: Flash and Hogan, J. Neurosci. 5 (1985) 1688.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from benchmarks.motions.scenes import Scene
from tissue_sim.pose import Pose, rotate_pose_about_its_position

#: Largest speed of a minimum-jerk segment over its mean speed.
PEAK_OVER_MEAN = 1.875
#: Largest speed of motions in which the tissue has mass, m/s.
INERTIAL_TOP_SPEED = 0.05
#: The same under a plate, m/s. Each motion then takes several times as long as waves through the specimen: faster ones
#: have forces that consist of waves and that ticks of 1 ms do not resolve (up to 70 % of the peak off).
PLATE_INERTIAL_TOP_SPEED = 0.01
#: Largest speed of multirate motions, m/s.
MULTIRATE_TOP_SPEED = 0.02
#: Ticks of a motion, about, by solver.
TICKS = {"axisymmetric": 80, "solid": 24, "reduced": 60, "multirate": 300}
#: Length of a tick, s, where the tissue has mass or is multirate.
DT = 1e-3


@dataclass(frozen=True)
class Key:
    """A pose on the path of the tool.

    Attributes:
        z: height of the tool's deepest point over the undeformed surface, m.
        x, y: m.
        turn: rotation vector about x and y, rad.
        hold: ticks for which the tool rests there.
    """

    z: float
    x: float = 0.0
    y: float = 0.0
    turn: tuple[float, float] = (0.0, 0.0)
    hold: int = 0

    def array(self) -> np.ndarray:
        """x, y, z and both rotations."""
        return np.array([self.x, self.y, self.z, *self.turn])


def pose_at(values: Sequence[float] | np.ndarray) -> Pose:
    """Return the pose at x, y, z with rotations about x and y."""
    x, y, z, a, b = (float(value) for value in values)
    return rotate_pose_about_its_position(Pose((x, y, z)), (a, b, 0.0))


def smooth(keys: Sequence[Key], ticks: int, dt: float, top_speed: float | None) -> list[Pose]:
    """Return minimum-jerk poses along keys; the first key is the first pose.

    Args:
        keys: at least one.
        ticks: number of ticks, about; holds are added.
        dt: length of a tick, s.
        top_speed: largest speed of the tool along its path, m/s, which adds ticks; None: no limit.
    """
    arrays = [key.array() for key in keys]
    lengths = [max(1e-5, float(np.linalg.norm((end - start)[:3]))) for start, end in pairwise(arrays)]
    poses = [pose_at(arrays[0])] * (1 + keys[0].hold)
    for length, start, end, key in zip(lengths, arrays, arrays[1:], keys[1:], strict=False):
        count = max(4, round(ticks * length / sum(lengths)))
        if top_speed is not None:
            count = max(count, math.ceil(PEAK_OVER_MEAN * length / (top_speed * dt)))
        for number in range(1, count + 1):
            s = number / count
            poses.append(pose_at(start + (end - start) * (10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5)))
        poses += [pose_at(end)] * key.hold
    return poses


def top_speed(scene: Scene) -> float | None:
    """Return the largest speed of the motions of a scene, m/s."""
    if scene.solver == "multirate":
        return MULTIRATE_TOP_SPEED
    if scene.inertia == "off":
        return None
    return PLATE_INERTIAL_TOP_SPEED if scene.shape == "plate" else INERTIAL_TOP_SPEED


def tick_length(scene: Scene, chance: np.random.Generator) -> float:
    """Draw the length of a tick, s."""
    if scene.solver == "multirate" or scene.inertia != "off":
        return DT
    return float(chance.choice([0.5e-3, 1e-3, 2e-3, 5e-3]))


def _place(scene: Scene, chance: np.random.Generator, z: float, hold: int = 0) -> Key:
    """Return a key at a height, in spatial scenes also displaced laterally and rotated."""
    if scene.solver == "axisymmetric":
        return Key(z, hold=hold)
    aside = chance.uniform(-0.8e-3, 0.8e-3, 2)
    turn = chance.uniform(-0.03, 0.03, 2) if scene.is_bonded else np.zeros(2)
    return Key(z, float(aside[0]), float(aside[1]), (float(turn[0]), float(turn[1])), hold)


def press_keys(scene: Scene, chance: np.random.Generator, *, start: float | None = None, lifts: bool | None = None,
               origin: tuple[float, float] = (0.0, 0.0)) -> list[Key]:
    """Draw a press from the air with holds, partial unloading and, at random, lift-off and a second touch.

    Args:
        scene: whose depth and tool are used.
        chance: source of random numbers.
        start: height at the start, m; None: random.
        lifts: whether the tool lifts off; None: random where it can.
        origin: x and y at which the tool touches, m.
    """
    depth = scene.depth
    start = float(chance.choice([0.0, 0.1, 0.3])) * 1e-3 if start is None else start
    x, y = origin
    hold = int(chance.integers(0, 8))
    if scene.shape == "plate" and scene.inertia != "off":
        # Without the impact of a whole face, whose pressure waves ticks of 1 ms do not resolve.
        start, lifts = 0.0, False
    keys = [Key(start, x, y), Key(-0.15 * depth, x, y), _moved(_place(scene, chance, -depth * chance.uniform(0.5, 0.9),
                                                                      hold), x, y)]
    if lifts is None:
        lifts = not scene.is_bonded and chance.random() < 0.4
    if lifts:
        last = keys[-1]
        keys += [Key(0.4e-3, last.x, last.y, last.turn, int(chance.integers(0, 5))),
                 Key(-0.2 * depth, last.x, last.y, last.turn)]
    else:
        keys.append(_moved(_place(scene, chance, -depth * chance.uniform(0.2, 0.5)), x, y))
    keys.append(_moved(_place(scene, chance, -depth * chance.uniform(0.6, 1.0), int(chance.integers(0, 6))), x, y))
    return keys


def _moved(key: Key, x: float, y: float) -> Key:
    return Key(key.z, key.x + x, key.y + y, key.turn, key.hold)


def profile(scene: Scene, chance: np.random.Generator, dt: float, keys: Sequence[Key] | None = None) -> list[Pose]:
    """Return the poses of a random motion of a scene.

    Args:
        scene: what is pressed.
        chance: source of random numbers.
        dt: length of a tick, s.
        keys: of the motion; None: those of `press_keys`.
    """
    return smooth(press_keys(scene, chance) if keys is None else keys, TICKS[scene.solver], dt, top_speed(scene))
