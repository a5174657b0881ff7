"""Selection of the finest mesh that this computer steps within a time budget."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from tissue_sim.fem.solver import ResolutionLevel
from tissue_sim.tool_force import Tissue


@dataclass(frozen=True)
class TimingMotionSettings:
    """Test motion by which the time of a tick is measured: a cosine in depth.

    Attributes:
        ticks: number of time steps.
        tick: time step, s.
        period: of the motion, s.
        depth_fraction: largest depth of the motion over the largest depth of the protocol, 1.
        lift_fraction: largest height above the tissue over the largest depth of the protocol, 1.
        in_time: fraction of the ticks that must be in time, 1.
    """

    __test__ = False  # for pytest

    ticks: int = 300
    tick: float = 1e-3
    period: float = 0.15
    depth_fraction: float = 0.5
    lift_fraction: float = 0.05
    in_time: float = 0.99


#: Motion of every measurement.
MOTION = TimingMotionSettings()
#: Least ratio of the time of a tick of a finer mesh to that of the next coarser mesh.
_LEAST_COST_RATIO = 1.5


def measure_tick_time_or_infinity(simulator: Tissue, depth: float, *, lifts: bool,
                                  budget: float = math.inf) -> float:
    """Measure the CPU time of this thread, s, within which 99 % of the ticks of a fast motion end.

    Args:
        simulator: simulator with its tool at the touch; its state changes.
        depth: largest depth, m.
        lifts: whether the tool leaves the tissue during the motion.
        budget: s; the result is infinity as soon as more than 1 % of the ticks took longer, so that a mesh that is too
            fine is rejected early.
    """
    height = MOTION.lift_fraction * depth if lifts else 0.0
    spent: list[float] = []
    slow, most = 0, MOTION.ticks - math.ceil(MOTION.in_time * MOTION.ticks)
    for k in range(MOTION.ticks):
        swing = 0.5 - 0.5 * math.cos(2.0 * math.pi * k * MOTION.tick / MOTION.period)
        began = time.thread_time()
        simulator.step((MOTION.depth_fraction * depth + height) * swing - height, MOTION.tick)
        spent.append(time.thread_time() - began)
        slow += spent[-1] > budget
        if slow > most:
            return math.inf
    return sorted(spent)[math.ceil(MOTION.in_time * MOTION.ticks) - 1]


def choose_finest_level_in_budget(levels: Sequence[ResolutionLevel], start: int, budget: float,
                                  tick_of: Callable[[ResolutionLevel], float]) -> ResolutionLevel:
    """Return the finest level whose tick fits into the budget; the coarsest if none fits.

    Args:
        levels: the finest first.
        start: index of the level that is measured first.
        budget: wall time of a tick, s.
        tick_of: measures the time of a tick on a level, s.
    """
    tick, index = tick_of(levels[start]), start
    if tick > budget:
        while tick > budget and index + 1 < len(levels):
            index += 1
            tick = tick_of(levels[index])
        return levels[index]
    while index > 0 and _LEAST_COST_RATIO * tick <= budget:
        tick = tick_of(levels[index - 1])
        if tick > budget:
            break
        index -= 1
    return levels[index]
