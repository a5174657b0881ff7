"""A motion that drills: down along an oblique line, turning about it."""

import math

from haptics.devices.contracts import Motion
from haptics.devices.settings import parse_number_settings
from tissue_sim.pose import Pose

#: Unit vector of the line and of the turning.
AXIS = (0.48, -0.36, -0.8)


class SpiralMotion(Motion):
    """Goes in and out along `AXIS` as a cosine, and turns by an angle that grows with the way."""

    def __init__(self, reach: float, frequency: float = 2.0, turns_per_metre: float = 40.0):
        self._reach, self._rate, self._turn_rate = reach, 2 * math.pi * frequency, 2 * math.pi * turns_per_metre

    def pose(self, time):
        way = 0.5 * self._reach * (1.0 - math.cos(self._rate * time))
        half = 0.5 * self._turn_rate * way
        return Pose(tuple(part * way for part in AXIS),
                    (math.cos(half), *(part * math.sin(half) for part in AXIS)))


def open_spiral(text):
    """``spiral:reach_mm=5``."""
    return SpiralMotion(parse_number_settings(text, reach_mm=5.0)["reach_mm"] * 1e-3)


def tissue_that_needs_the_name(stiffness=300.0):
    """A tissue whose making asks for the motion by name: in the process of a loop, it must be known there."""
    from haptics.devices.back_ends import make_motion
    from tissue_sim.tool_force import ForceStatus, ToolForce

    deepest = -make_motion("spiral:reach_mm=3").pose(0.25).position[2]

    class Spring:
        def step(self, pose, dt):
            return ToolForce.from_axial_force(stiffness * pose.depth / deepest, stiffness / deepest,
                                              ForceStatus.CONVERGED)

    return Spring()
