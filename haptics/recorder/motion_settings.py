"""Settings of supervised motions: tolerances and times of `haptics.recorder.guarded_motion`."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class GuardedMotionTolerancesAndTimes:
    """Settings of `GuardedMotion`.

    Attributes:
        force_window: time over which forces are kept for a mean, s. A longer window averages more noise and reacts
            later.
        position_tolerance: largest distance between the position at rest and the goal, m.
        start_delay: longest time from a command until the stage reports a motion, s.
        halt_margin: time that a halted stage has to come to rest in addition to `Stage.runs_on`, s.
        longest_halt: largest time that a halted stage has to come to rest, s.
        force_growth: increase of the force during retraction, as a fraction of the force limit, above which the
            retraction is abandoned, 1.
        homing_time: time that homing may take in addition to twice the travel at the largest speed, s.
    """

    force_window: float = 0.1
    position_tolerance: float = 20e-6
    start_delay: float = 0.5
    halt_margin: float = 0.5
    longest_halt: float = 5.0
    force_growth: float = 0.1
    homing_time: float = 60.0
