"""What is done with a specimen: how contact is found, what comes before, and the motion that is recorded."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from haptics.devices.contracts import Stage
from haptics.safety.motion_guard import MotionLimits, require_stoppable
from tissue_sim.errors import InputError
from tissue_sim.experiment.segments import Leg

#: Between two looks at the devices, s.
PERIOD = 5e-3


@dataclass(frozen=True)
class Plan:
    """One test on the bench.

    Attributes:
        name: of the test; its recordings are NAME_1.csv and so on.
        legs: the motion that is recorded, m below the touch.
        replicates: how often.
        contact: ``"force"``: the stage goes in from its zero until the force says so; ``"here"``: where it stands after
            homing, as with a plate that is glued on.
        touch: ``"each"``: where it touches is found before each recording, so that the recordings show how well that is
            known; ``"once"``: before the first.
        contact_force: from which on the tool touches, N.
        approach_speed: m/s.
        retract: how far above the touch the tool waits, m.
        preconditioning: how often the motion is done before it is recorded.
        rest: between two motions, s.
        sign: 1, or -1 where the sensor reads less when it is pushed. axis: its channel along the tool.
        lag: of the sensor behind the stage, as a sidecar says it; None: unknown.
        about: what the sidecar says of specimen, tool, lubricant, temperature, ...

    Raises:
        InputError: a number out of its range, or no motion.
    """

    name: str
    legs: tuple[Leg, ...]
    replicates: int = 3
    contact: Literal["force", "here"] = "force"
    touch: Literal["each", "once"] = "each"
    contact_force: float = 0.1
    approach_speed: float = 1e-3
    retract: float = 1e-3
    preconditioning: int = 0
    rest: float = 0.0
    sign: int = 1
    axis: str = "Fz"
    lag: dict[str, Any] | None = None
    about: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.legs:
            raise InputError("there is no motion to record; give a protocol, such as 'ramp 10mm @0.248mm/s; hold 60s; "
                             "unload'", field=f"{self.name}.protocol")
        for name in ("contact_force", "approach_speed", "retract"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{getattr(self, name):g}; give a number above zero", field=f"record.{name}")
        for name, least in (("replicates", 1), ("preconditioning", 0)):
            if getattr(self, name) < least:
                raise InputError(f"{getattr(self, name)}; give {least} or more", field=f"record.{name}")
        if self.sign not in (1, -1):
            raise InputError(f"{self.sign}; give 1, or -1 where the sensor reads less when it is pushed",
                             field="record.sign")
        if not 0 <= self.rest < math.inf:
            raise InputError(f"{self.rest:g} s; give zero or more", field="record.rest")

    @property
    def depth(self) -> float:
        """Deepest, m."""
        return max(max(leg.start, leg.end) for leg in self.legs)

    @property
    def highest(self) -> float:
        """How far above the touch it goes, m."""
        above = -min(min(leg.start, leg.end) for leg in self.legs)
        return max(above, self.retract if self.contact == "force" else 0.0)

    @property
    def speed(self) -> float:
        """Fastest in contact, m/s."""
        return max((leg.speed for leg in self.legs), default=0.0)

    @property
    def duration(self) -> float:
        """Of the motion, s."""
        return sum(leg.duration for leg in self.legs)

    @property
    def title(self) -> str:
        """The motion in one line: ``"ramp to 10 mm at 0.248 mm/s, hold 60 s"``."""
        return ", ".join(f"hold {leg.duration:g} s" if not leg.speed else
                         f"{leg.segment.kind} to {leg.end * 1e3:g} mm at {leg.speed * 1e3:g} mm/s" for leg in self.legs)


def check_plans(plans: Sequence[Plan], limits: MotionLimits, stage: Stage, period: float) -> float:
    """Refuse what would pass the limits, before anything moves.

    Args:
        plans: of one run. limits: of it. stage: that is to move. period: of the sensor, s.

    Returns:
        How long the plans take at least, s.

    Raises:
        InputError: a motion outside of the limits or of the stage's, or one that cannot be stopped in time.
    """
    seconds = max(limits.sensor_silence, 3 * period) + 2 * PERIOD + stage.runs_on
    total = 0.0
    if limits.lowest < stage.limits.lowest or limits.highest > stage.limits.highest:
        raise InputError(f"the limits go from {limits.lowest * 1e3:g} to {limits.highest * 1e3:g} mm, the stage only "
                         "from "
                         f"{stage.limits.lowest * 1e3:g} to {stage.limits.highest * 1e3:g} mm; give less",
                         field="limits")
    for plan in plans:
        way = plan.depth + plan.highest
        if way > limits.highest - limits.lowest:
            raise InputError(f"the motion takes {way * 1e3:.4g} mm, the limits leave "
                             f"{(limits.highest - limits.lowest) * 1e3:.4g} mm", field=f"{plan.name}.protocol")
        for speed, name in ((plan.speed, f"{plan.name}.protocol"), (plan.approach_speed, "record.approach_speed")):
            if speed > min(limits.speed, stage.limits.speed):
                raise InputError(f"{speed * 1e3:g} mm/s is above the limit of "
                                 f"{min(limits.speed, stage.limits.speed) * 1e3:g} mm/s", field=name)
            require_stoppable(limits, speed, seconds)
        motions = plan.replicates + plan.preconditioning
        total += motions * (plan.duration + plan.rest + 2 * plan.retract / plan.approach_speed)
    if total > limits.duration:
        raise InputError(f"the run takes at least {total:.4g} s, its limit is {limits.duration:g} s",
                         field="limits.duration")
    return total
