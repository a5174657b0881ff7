"""Which mesh a computer can step in real time: the finest of a ladder whose ticks fit into a budget."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Protocol

from tissue_sim.fem.solver import Rung
from tissue_sim.tool_force import ToolForce

#: A motion that is stepped to find out: ticks (s), how many, and in which period they go in and out (s).
TICK, _TICKS, _PERIOD = 1e-3, 300, 0.15
#: To which share of the largest depth, and how far out of the tissue.
_SHARE, _LIFT = 0.5, 0.05
#: Share of the ticks that have to be in time.
_IN_TIME = 0.99
#: A finer mesh takes at least so many times as long.
_DEARER = 1.5


class Stepped(Protocol):
    """What is measured."""

    def step(self, pose: float, dt: float) -> ToolForce:
        """The force at a depth, m, dt s after the last step."""


def measure_tick(simulator: Stepped, depth: float, *, lifts: bool, budget: float = math.inf) -> float:
    """CPU time of this thread, s, in which 99 % of the ticks of a swift motion end.

    Args:
        simulator: at the touch; it is left somewhere else.
        depth: largest one, m.
        lifts: whether the tool leaves the tissue on the way.
        budget: s; once more ticks than the hundredth took longer, the answer is infinity: a mesh that does not fit is
            known soon, however long its ticks.
    """
    away = _LIFT * depth if lifts else 0.0
    spent: list[float] = []
    slow, most = 0, _TICKS - math.ceil(_IN_TIME * _TICKS)
    for k in range(_TICKS):
        swing = 0.5 - 0.5 * math.cos(2.0 * math.pi * k * TICK / _PERIOD)
        began = time.thread_time()
        simulator.step((_SHARE * depth + away) * swing - away, TICK)
        spent.append(time.thread_time() - began)
        slow += spent[-1] > budget
        if slow > most:
            return math.inf
    return sorted(spent)[math.ceil(_IN_TIME * _TICKS) - 1]


def choose(rungs: Sequence[Rung], start: int, budget: float, tick_of: Callable[[Rung], float]) -> Rung:
    """The finest of the rungs, the finest first, whose tick (s) fits into the budget (s); the coarsest where none does.

    Args:
        start: number of the rung that is measured first.
        tick_of: measures one.
    """
    tick, at = tick_of(rungs[start]), start
    if tick > budget:
        while tick > budget and at + 1 < len(rungs):
            at += 1
            tick = tick_of(rungs[at])
        return rungs[at]
    while at > 0 and _DEARER * tick <= budget:
        tick = tick_of(rungs[at - 1])
        if tick > budget:
            break
        at -= 1
    return rungs[at]
