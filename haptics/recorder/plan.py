"""Describe one test on the bench (contact, preconditioning, recorded motion), and check it against the limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from haptics.devices.contracts import Stage
from haptics.safety.force_control import FORCE_CONTROL, ForceControlLimits
from haptics.safety.motion_guard import MotionLimits, require_stop_within_force_margin
from tissue_sim.errors import InputError
from tissue_sim.experiment.protocol_legs import MotionLeg
from tissue_sim.experiment.protocol_text import DISPLACEMENT, FORCE
from tissue_sim.public_names import make_getattr_for_old_names

__getattr__ = make_getattr_for_old_names(__name__, {"IndentationPlan": "BenchTestPlan"})


@dataclass(frozen=True)
class PollSettings:
    """Intervals of the polls of sensor and stage.

    Attributes:
        period: time between two polls, s. A shorter period detects faults earlier and takes more computing time.
        timeout: longest time without a poll while the tool moves, s; after this time another thread halts the stage. A
            longer time tolerates longer delays of the program, in which the tool moves unsupervised.
    """

    period: float = 5e-3
    timeout: float = 0.25


#: Intervals of every recording.
POLLING = PollSettings()


@dataclass(frozen=True)
class BenchTestPlan:
    """One test on the bench: how contact is found, preconditioning, and the recorded motion.

    Attributes:
        name: name of the test; its recordings are NAME_1.csv, NAME_2.csv and so on.
        legs: segments of the recorded motion; positions in m, positive below the contact point, or forces in N.
        replicates: number of recordings.
        contact: ``"force"``: the tool moves down from the zero of the stage until the contact force is reached;
            ``"here"``: contact is the position after homing, for example of a plate that is glued to the specimen.
        touch: ``"each"``: the contact point is found before each recording, so that the recordings show the scatter of
            the contact point; ``"once"``: before the first recording only.
        contact_force: force at which contact is detected, N.
        approach_speed: speed of every motion outside of the recording, m/s.
        retract: height above the contact point at which the tool waits, m.
        preconditioning: number of unrecorded cycles of the motion before the first recording.
        rest: pause between two motions, s.
        sign: 1, or -1 if the reading of the sensor decreases when the tool is pushed into the specimen.
        axis: channel of the sensor along the tool, such as ``"Fz"``.
        lag: measured lag of the sensor behind the stage, for the metadata; None: unknown.
        about: metadata of the test: specimen, tool, lubricant, temperature, ...
        force_control: limits of the control of the force; required if a segment prescribes a force.

    Raises:
        InputError: a number is out of range, the plan has no motion, or it prescribes a force without limits.
    """

    name: str
    legs: tuple[MotionLeg, ...]
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
    force_control: ForceControlLimits | None = None

    def __post_init__(self) -> None:
        if not self.legs:
            raise InputError("protocol must contain a motion; got none. Give a protocol such as "
                             "'ramp 10mm @0.248mm/s; hold 60s; unload'", field=f"{self.name}.protocol")
        if self.uses_force_control and self.force_control is None:
            raise InputError("is required, because the protocol prescribes a force. Give depth_mm, speed_mm_s and "
                             "force_error_N, or prescribe displacements", field="force_control")
        for name in ("contact_force", "approach_speed", "retract"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError("contact force, speed and retraction must be positive and finite; got "
                                 f"{getattr(self, name):g}", field=f"record.{name}")
        for name, least in (("replicates", 1), ("preconditioning", 0)):
            if getattr(self, name) < least:
                raise InputError(f"the number of motions must be at least {least}; got {getattr(self, name)}",
                                 field=f"record.{name}")
        if self.sign not in (1, -1):
            raise InputError(f"the sign of the reading must be 1 or -1; got {self.sign}. Give -1 if the reading "
                             "decreases when the tool is pushed", field="record.sign")
        if not 0 <= self.rest < math.inf:
            raise InputError(f"the rest between motions must be zero or more and finite; got {self.rest:g} s",
                             field="record.rest")

    @property
    def uses_force_control(self) -> bool:
        """Whether a segment prescribes a force."""
        return any(leg.control == FORCE for leg in self.legs)

    @property
    def largest_prescribed_force(self) -> float:
        """Largest prescribed force, N; 0 without prescribed forces."""
        return max((max(leg.start, leg.end) for leg in self.legs if leg.control == FORCE), default=0.0)

    @property
    def start_depth(self) -> float:
        """Depth below the contact point at the start of the motion, m."""
        return self.legs[0].start if self.legs[0].control == DISPLACEMENT else 0.0

    @property
    def _depths(self) -> list[float]:
        """Depths at the ends of the segments with prescribed displacement, and the limit of the controlled depth, m."""
        depths = [depth for leg in self.legs if leg.control == DISPLACEMENT for depth in (leg.start, leg.end)]
        return [*depths, 0.0, self.force_control.depth] if self.force_control and self.uses_force_control else depths

    @property
    def largest_depth(self) -> float:
        """Largest depth of the motion below the contact point, m."""
        return max(self._depths)

    @property
    def largest_height(self) -> float:
        """Largest height of the tool above the contact point during the test, with the search for contact, m."""
        above = -min(self._depths)
        return max(above, 2 * self.retract if self.contact == "force" else 0.0)

    @property
    def largest_recorded_speed(self) -> float:
        """Largest speed of the recorded motion, m/s."""
        return max(map(self.get_largest_speed_of_leg, self.legs))

    def get_largest_speed_of_leg(self, leg: MotionLeg) -> float:
        """Return the largest speed of the stage in a segment, m/s; 0 at rest."""
        return self.force_control.speed if self.force_control and leg.control == FORCE else leg.speed

    @property
    def replicate_duration(self) -> float:
        """Duration of one recorded motion, one replicate without the search for contact, s."""
        return sum(leg.duration for leg in self.legs)

    @property
    def motion_summary(self) -> str:
        """The motion in one line, such as ``"ramp to 10 mm at 0.248 mm/s, hold 60 s"``."""
        return ", ".join(f"hold {leg.duration:g} s" if not leg.speed else
                         f"{leg.segment.kind} to {leg.end:g} N at {leg.speed:g} N/s" if leg.control == FORCE else
                         f"{leg.segment.kind} to {leg.end * 1e3:g} mm at {leg.speed * 1e3:g} mm/s" for leg in self.legs)


def check_plans_and_compute_duration(plans: Sequence[BenchTestPlan], limits: MotionLimits, stage: Stage,
                                     period: float) -> float:
    """Check the plans of a run against limits and stage before anything moves, and return their duration.

    Args:
        plans: plans of the run.
        limits: limits of the run.
        stage: stage that executes the plans.
        period: sampling period of the sensor, s.

    Returns:
        Shortest possible duration of all plans, s; the search for contact is not included.

    Raises:
        InputError: a motion exceeds the limits of the run or of the stage, or cannot be stopped in time.
    """
    # Time from a fault until the stage is halted. The watching thread detects a late program within 1.2 timeouts.
    reaction = max(limits.sensor_silence, 3 * period, 1.2 * POLLING.timeout) + 2 * POLLING.period + stage.runs_on
    total = 0.0
    for plan in plans:
        if plan.force_control is not None and plan.uses_force_control:
            _check_force_control(plan, plan.force_control, limits, stage, period)
    if limits.lowest < stage.limits.lowest or limits.highest > stage.limits.highest:
        raise InputError(f"the position limits must lie within the range of the stage, {stage.limits.lowest * 1e3:g} "
                         f"to {stage.limits.highest * 1e3:g} mm; got {limits.lowest * 1e3:g} to "
                         f"{limits.highest * 1e3:g} mm. Reduce lowest_mm or highest_mm", field="limits")
    for plan in plans:
        travel, allowed_travel = plan.largest_depth + plan.largest_height, limits.highest - limits.lowest
        if travel > allowed_travel:
            raise InputError(f"the protocol must need at most {allowed_travel * 1e3:.4g} mm of travel, the range of "
                             f"[limits]; got {travel * 1e3:.4g} mm", field=f"{plan.name}.protocol")
        for speed, name in ((plan.largest_recorded_speed, f"{plan.name}.protocol"),
                            (plan.approach_speed, "record.approach_speed")):
            fastest = min(limits.speed, stage.limits.speed)
            if speed > fastest:
                raise InputError(f"speed must be at most {fastest * 1e3:g} mm/s; got {speed * 1e3:g} mm/s", field=name)
            require_stop_within_force_margin(limits, speed, reaction)
        motions = plan.replicates + plan.preconditioning
        total += motions * (plan.replicate_duration + plan.rest + 2 * plan.retract / plan.approach_speed)
    if total > limits.duration:
        raise InputError(f"the time limit must be at least {total:.4g} s, the duration of the plan; got "
                         f"{limits.duration:g} s",
                         field="limits.duration")
    return total


def _check_force_control(plan: BenchTestPlan, control: ForceControlLimits, limits: MotionLimits, stage: Stage,
                         period: float) -> None:
    """Check that the stage may control a force, that the sensor is fast enough, and that the forces are within limits.

    Raises:
        InputError: a stage without support, a sensor whose delay would make the control oscillate, or a force above
            the limit.
    """
    if not stage.supports_force_control:
        raise InputError(f"must prescribe displacements for a {type(stage).__name__}; got a prescribed force, which "
                         "only the virtual rig controls. State lengths such as ramp 10mm",
                         field=f"{plan.name}.protocol")
    # The tangent stiffness may be four times the ratio of force and depth, see `ForceControlSettings.gain`.
    longest = 0.25 / FORCE_CONTROL.gain - 0.5 * FORCE_CONTROL.window - POLLING.period
    if period > longest:
        raise InputError(f"the sensor must sample at {math.ceil(1.0 / longest)} Hz or faster to control a force; got "
                         f"{1.0 / period:.4g} Hz. Use a faster rate, or prescribe displacements",
                         field=f"{plan.name}.protocol")
    largest = plan.largest_prescribed_force + control.force_error
    if largest > limits.force:
        raise InputError(f"the prescribed force plus force_error_N must be at most {limits.force:g} N, the limit of "
                         f"the force; got {largest:g} N. Prescribe a smaller force", field=f"{plan.name}.protocol")
