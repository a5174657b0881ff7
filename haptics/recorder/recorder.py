"""Carrying out plans: contact, preconditioning, replicates, and their recordings."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from haptics.devices.contracts import Bench, ForceSample, StageSample
from haptics.recorder.guarded_motion import GuardedMotion, StoppedError
from haptics.recorder.plan import PERIOD, Plan, check_plans
from haptics.recorder.run_folder import PartialRecording, RunFolder
from haptics.recorder.taken import Taken, as_recording, refined_touch
from haptics.safety.motion_guard import MotionLimits, Stop

#: After a tare this share of the contact force may be left.
_ZERO_SHARE = 0.5
#: Contact counts when the mean over so long has reached the contact force, s.
_TOUCH_OVER = 0.02
#: The second way in is so much slower than the first.
_SLOWER = 0.2


@dataclass(frozen=True)
class Moment:
    """What a run shows of itself.

    Attributes:
        test, phase: what is done; ``"ramp"``, ``"hold"``, ``"approach"``, ...
        replicate: number of it, 0 outside of one.
        position: of the stage, m. depth: below the touch, m, NaN before it is known. force: N.
        share: of the run, 0 to 1, by time.
    """

    test: str
    phase: str
    replicate: int
    position: float
    depth: float
    force: float
    share: float


class Recorder:
    """Moves a stage by the plan of a test, within limits, and writes what its sensor measures.

    Args:
        bench: neither is started.
        plan: of the test.
        limits: of the motion.
        folder: of the run, entered.
        about: of the run, for each sidecar: who, where, what.
        asked: a sentence when somebody wants it to end; None while nobody does.
        watch: told of every look at the devices.
        clock, pause: s, that of the devices; and what lets it go on by so many s.

    Raises:
        InputError: a plan that passes the limits, before anything is started.
    """

    def __init__(self, bench: Bench, plan: Plan, limits: MotionLimits, folder: RunFolder, *,
                 about: dict[str, Any] | None = None, asked: Callable[[], str | None] = lambda: None,
                 watch: Callable[[Moment], None] = lambda moment: None,
                 clock: Callable[[], float] = time.monotonic, pause: Callable[[float], None] = time.sleep):
        self.seconds = check_plans([plan], limits, bench.stage, 1.0 / bench.sensor.rate)
        self._motion = GuardedMotion(bench, limits, plan.axis, plan.sign, looked=self._look, asked=asked, clock=clock,
                                     pause=pause)
        self._plan, self._limits, self._folder, self._about, self._watch = plan, limits, folder, about or {}, watch
        self._taken: Taken | None = None
        self._partial: PartialRecording | None = None
        self._phase, self._replicate = "start", 0
        self._touch: float | None = None
        #: Below the touch in the motion that goes on, m.
        self._deepest = 0.0
        self._touch_found: dict[str, Any] = {}

    def run(self) -> None:
        """All recordings that the folder does not have yet.

        Raises:
            StoppedError: the run was ended; the stage stands, or was taken back, and what was recorded is kept.
            DeviceError: a device does not start.
        """
        folder, plan, motion = self._folder, self._plan, self._motion
        folder.note(state="running", limits=_described(self._limits), about=self._about)
        try:
            with motion.running(self._way_back):
                stage = motion.stage
                folder.note(sensor=motion.sensor.describe(), stage=stage.describe(),
                            stall="seen by the encoder" if stage.measures_position else
                            "not detectable: the stage knows only where it was driven to")
                self._phase = "home"
                motion.home()
                self._carry_out(folder.missing(plan.name, plan.replicates))
        except StoppedError as error:
            folder.note(state="stopped", stops=[*folder.state["stops"], {
                "cause": error.stop.cause, "message": error.stop.message, "test": plan.name,
                "phase": self._phase, "replicate": self._replicate, "at": _clock_time()}])
            raise
        finally:
            if self._partial is not None:
                self._partial.close()
                self._partial = None
        folder.note(state="complete")

    def _way_back(self) -> tuple[float, float]:
        """Where the tool goes after a stop, m, and at what speed, m/s."""
        return (self._touch - self._plan.retract if self._touch is not None else 0.0), self._plan.approach_speed

    def _look(self, samples: Sequence[ForceSample], forces: Sequence[float], place: StageSample) -> None:
        """Keep and show what came."""
        motion = self._motion
        if self._taken is not None:
            places = self._taken.add(samples, place)
            if self._partial is not None:
                began, touch = self._taken.places[0][0], self._touch or 0.0
                self._partial.add([(sample.received - began, 1e3 * (at - touch), force, self._phase)
                                   for sample, at, force in zip(samples, places, forces, strict=True)])
                if self._partial.failure is not None:
                    raise StoppedError(Stop("disk", self._partial.failure))
        depth = place.position - self._touch if self._touch is not None else np.nan
        self._deepest = max(self._deepest, depth if self._touch is not None else 0.0)
        share = min((motion.now() - motion.began) / self.seconds, 1.0) if self.seconds else 1.0
        self._watch(Moment(self._plan.name, self._phase, self._replicate, place.position, depth, motion.force, share))

    def _carry_out(self, missing: Sequence[int]) -> None:
        plan, motion = self._plan, self._motion
        if not missing:
            return
        if plan.contact == "force":
            motion.go(min(0.0, self._limits.highest), plan.approach_speed)
        self._tare()
        if plan.contact == "force":
            self._find_touch()
            if plan.preconditioning or plan.touch == "once":
                self._refine_touch()
        else:
            self._touch = self._position
        for cycle in range(plan.preconditioning):
            self._follow(f"preconditioning {cycle + 1} of {plan.preconditioning}")
        for number in missing:
            self._replicate = number
            self._record(number)
        self._replicate = 0
        self._wait_above()

    @property
    def _position(self) -> float:
        """Of the stage at the last look, m."""
        assert self._motion.place is not None
        return self._motion.place.position

    def _tare(self) -> None:
        self._phase = "tare"
        self._motion.tare(_ZERO_SHARE * self._plan.contact_force)

    def _find_touch(self) -> None:
        """Go in until the force says so, and back to where the sensor is zeroed once more."""
        self._touch = self._go_in(self._plan.approach_speed)
        self._wait_above(2.0)
        self._tare()

    def _refine_touch(self) -> None:
        """Go in slowly: that way in shows where it touches."""
        plan, motion = self._plan, self._motion
        self._wait_above(2.0)
        taken = self._taken = Taken()
        try:
            halted = self._go_in(_SLOWER * plan.approach_speed)
        finally:
            self._taken = None
        self._touch, self._touch_found = refined_touch(taken, plan, halted, motion.sensor.channels,
                                                       1.0 / motion.sensor.rate)
        self._wait_above()

    def _go_in(self, speed: float) -> float:
        """Until the force says that the tool touches, at a speed, m/s; returns where the stage was halted, m."""
        plan, motion = self._plan, self._motion
        self._phase = "approach"
        if not motion.go(self._limits.highest, speed, lambda: motion.mean(_TOUCH_OVER) >= plan.contact_force):
            raise StoppedError(Stop(
                "no contact", f"no force of {plan.contact_force:g} N was felt on the whole way; put the specimen "
                              "nearer, or look at the sign and the axis of the sensor"))
        motion.forget()
        return self._position

    def _wait_above(self, times: float = 1.0) -> None:
        """Above the touch, by so many times the plan's height, where the plan finds it by force; elsewhere at it."""
        assert self._touch is not None
        above = times * self._plan.retract if self._plan.contact == "force" else 0.0
        self._motion.go(max(self._touch - above, self._limits.lowest), self._plan.approach_speed)

    def _follow(self, words: str) -> None:
        """The motion of the plan, once; how deep it went is noted however it ends."""
        assert self._touch is not None
        plan, motion, touch = self._plan, self._motion, self._touch
        self._deepest = 0.0
        try:
            motion.go(touch + plan.legs[0].start, plan.approach_speed)
            for leg in plan.legs:
                self._phase = leg.segment.kind
                if self._taken is not None:
                    self._taken.legs.append((motion.now(), leg.segment.kind, leg.cycle))
                if leg.speed:
                    motion.go(touch + leg.end, leg.speed)
                else:
                    motion.rest(leg.duration)
        finally:
            self._folder.note(history=[*self._folder.state["history"], {
                "test": plan.name, "what": words, "depth_mm": self._deepest * 1e3, "at": _clock_time()}])

    def _record(self, number: int) -> None:
        plan, motion, folder = self._plan, self._motion, self._folder
        self._phase = "rest"
        self._wait_above()
        motion.rest(plan.rest)
        if plan.contact == "force":
            motion.check_zero(plan.contact_force)
            if plan.touch == "each":
                self._refine_touch()
                self._phase = "rest"
        name, before, started = f"{plan.name}_{number}", len(folder.state["history"]), _clock_time()
        partial = self._partial = folder.partial(name, ["time [s]", "displacement [mm]", "force [N]", "segment"])
        taken = self._taken = Taken()
        try:
            self._follow(f"recording {number} of {plan.replicates}")
            motion.rest(2 * PERIOD)
        finally:
            self._taken = None
        self._partial = None
        partial.close()
        recording = as_recording(taken, plan, self._touch or 0.0, motion.zero, motion.sensor.channels,
                                 1.0 / motion.sensor.rate)
        folder.keep(name, recording.with_metadata(**plan.about, **self._about, **{
            "name": name, "test": plan.name, "replicate": number, "started": started, "ended": _clock_time(),
            "sensor": motion.sensor.describe(), "stage": motion.stage.describe(), "axis": plan.axis, "sign": plan.sign,
            "zeroed": "before this test, above the specimen" if plan.contact == "force" else "before this test",
            "zero_after_tare_N": motion.zero, "touch_mm": (self._touch or 0.0) * 1e3, **self._touch_found,
            "loadings_before": before, "stops_before": folder.state["stops"], "stopped_by": None,
            **recording.metadata}))


def _described(limits: MotionLimits) -> dict[str, Any]:
    return {"force_N": limits.force, "lowest_mm": limits.lowest * 1e3, "highest_mm": limits.highest * 1e3,
            "speed_mm_s": limits.speed * 1e3, "duration_s": limits.duration,
            "stiffness_N_per_mm": limits.stiffness * 1e-3, "force_margin_N": limits.force_margin,
            "sensor_silence_s": limits.sensor_silence, "on_stop": "retract" if limits.retracts else "stand"}


def _clock_time() -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%S%z")
