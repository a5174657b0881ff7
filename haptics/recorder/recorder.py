"""Carrying out a plan: contact, preconditioning, replicates; every look at the devices passes the guard."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from haptics.devices.contracts import Bench, DeviceError, StageSample
from haptics.recorder.plan import PERIOD, Plan, check_plans
from haptics.recorder.run_folder import PartialRecording, RunFolder
from haptics.recorder.taken import Taken, as_recording, refined_touch
from haptics.safety.motion_guard import Drive, MotionGuard, MotionLimits, Stop
from tissue_sim.errors import InputError

#: A tick that stays away so long while the tool moves ends the motion, s.
_DEAD = 0.25
#: After a tare the mean of so long, s, must read zero to this share of the contact force.
_ZERO_OVER, _ZERO_SHARE = 0.1, 0.5
#: Contact counts when the mean over so long has reached the contact force, s.
_TOUCH_OVER = 0.02
#: The tool is back within this of where it was sent, m.
_PLACED = 20e-6


class StoppedError(RuntimeError):
    """A run that was ended before its end.

    Attributes:
        stop: why.
    """

    def __init__(self, stop: Stop):
        super().__init__(stop.message)
        self.stop = stop


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
    """Moves a stage by plans, within limits, and writes what its sensor measures.

    Args:
        bench: neither is started.
        plans: one a test, in their order.
        limits: of the motion.
        folder: of the run, entered.
        about: of the run, for each sidecar: who, where, what.
        asked: a sentence when somebody wants it to end; None while nobody does.
        watch: told of every look at the devices.
        clock, pause: s, that of the devices; and what lets it go on by so many s.

    Raises:
        InputError: plans that pass the limits, before anything is started.
    """

    def __init__(self, bench: Bench, plans: Sequence[Plan], limits: MotionLimits, folder: RunFolder, *,
                 about: dict[str, Any] | None = None, asked: Callable[[], str | None] = lambda: None,
                 watch: Callable[[Moment], None] = lambda moment: None,
                 clock: Callable[[], float] = time.monotonic, pause: Callable[[float], None] = time.sleep):
        self._sensor, self._stage = bench.sensor, bench.stage
        self.seconds = check_plans(plans, limits, bench.stage, 1.0 / bench.sensor.rate)
        for plan in plans:
            if plan.axis not in bench.sensor.channels:
                raise InputError(f"the sensor has no channel {plan.axis!r}; it has {', '.join(bench.sensor.channels)}",
                                 field="record.axis")
        self._plans, self._limits, self._folder, self._about = plans, limits, folder, about or {}
        self._asked, self._watch, self._now, self._pause = asked, watch, clock, pause
        self._guard: MotionGuard | None = None
        self._drive: Drive | None = None
        self._taken: Taken | None = None
        self._partial: PartialRecording | None = None
        self._plan, self._phase, self._replicate = plans[0], "start", 0
        self._touch: float | None = None
        self._touch_found: dict[str, Any] = {}
        #: What is left of the sensor's zero after its tare, N.
        self._zero = 0.0
        self._recent: list[tuple[float, float]] = []
        self._ticked, self._began = 0.0, 0.0
        #: By how much a look came late, s, where that halted the stage.
        self._late: float | None = None
        self._place: StageSample | None = None

    def run(self) -> None:
        """All recordings that the folder does not have yet.

        Raises:
            StoppedError: the run was ended; the stage stands, or was taken back, and what was recorded is kept.
            DeviceError: a device does not start.
        """
        folder = self._folder
        folder.note(state="running", limits=_described(self._limits), about=self._about)
        try:
            with self._devices():
                self._home()
                for plan in self._plans:
                    self._carry_out(plan)
        except StoppedError as error:
            folder.note(state="stopped", stops=[*folder.state["stops"], {
                "cause": error.stop.cause, "message": error.stop.message, "test": self._plan.name,
                "phase": self._phase, "replicate": self._replicate, "at": _clock_time()}])
            raise
        folder.note(state="complete")

    @contextmanager
    def _devices(self) -> Iterator[None]:
        """Both devices, started; both are stopped, whatever becomes of the other."""
        try:
            self._sensor.start()
            self._stage.start()
            self._began = self._ticked = self._now()
            self._guard = MotionGuard(self._limits, self._sensor.rate, self._stage.measures_position, self._began)
            self._folder.note(sensor=self._sensor.describe(), stage=self._stage.describe(),
                              stall=("seen by the encoder" if self._stage.measures_position else
                                     "not detectable: the stage knows only where it was driven to"))
            with self._dead_man():
                try:
                    yield
                except BaseException as error:
                    stop = _stop_of(error)
                    self._end_motion(stop)
                    raise StoppedError(stop) from error
        finally:
            with contextlib.suppress(Exception):
                self._stage.stop()
            with contextlib.suppress(Exception):
                self._sensor.stop()

    @contextmanager
    def _dead_man(self) -> Iterator[None]:
        """Halts the stage from another thread when this one no longer looks."""
        ending = threading.Event()

        def watch() -> None:
            while not ending.wait(0.2 * _DEAD):
                late = self._now() - self._ticked
                if self._drive is not None and late > max(_DEAD, self._limits.sensor_silence):
                    self._stage.halt()
                    self._late = late

        thread = threading.Thread(target=watch, name="dead man", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ending.set()
            thread.join()

    def _end_motion(self, stop: Stop) -> None:
        """Stand still; then go back, where that is wanted and the stage is to be believed."""
        with contextlib.suppress(Exception):
            self._stage.halt()
        self._drive = self._taken = None
        if self._partial is not None:
            self._partial.close()
            self._partial = None
        if not (self._limits.retracts and stop.may_retract and self._place is not None and self._place.homed):
            return
        with contextlib.suppress(Exception):
            away = self._touch - self._plan.retract if self._touch is not None else 0.0
            self._stage.move(max(min(away, self._place.position), self._limits.lowest), self._plan.approach_speed)
            until = self._now() + 2 * abs(away - self._place.position) / self._plan.approach_speed + 1.0
            while self._stage.position().moving and self._now() < until:
                self._pause(PERIOD)
            self._stage.halt()

    def _tick(self) -> None:
        """Look at both devices once, and let the guard judge."""
        self._pause(max(0.0, self._ticked + PERIOD - self._now()))
        if self._late is not None:
            raise StoppedError(Stop("program late", f"the program did not look at its devices for {self._late:.2g} s "
                                                    "while "
                                                    "the stage moved, and the stage was halted; close what else "
                                                    "runs on this computer, or allow a longer sensor_silence_s"))
        if (words := self._asked()) is not None:
            raise StoppedError(Stop("asked", words))
        samples = self._sensor.read()
        place = self._place = self._stage.position()
        now = self._ticked = self._now()
        axis, sign = self._sensor.channels.index(self._plan.axis), self._plan.sign
        forces = [sign * sample.values[axis] - self._zero for sample in samples]
        if self._taken is not None:
            places = self._taken.add(samples, place)
            if self._partial is not None:
                began, touch = self._taken.places[0][0], self._touch or 0.0
                self._partial.add([(sample.received - began, 1e3 * (at - touch), force, self._phase)
                                   for sample, at, force in zip(samples, places, forces, strict=True)])
                if self._partial.failure is not None:
                    raise StoppedError(Stop("disk", self._partial.failure))
        assert self._guard is not None
        if (stop := self._guard.check(now, samples, forces, place, self._drive)) is not None:
            raise StoppedError(stop)
        self._recent += [(sample.received, force) for sample, force in zip(samples, forces, strict=True)]
        while self._recent and self._recent[-1][0] - self._recent[0][0] > _ZERO_OVER:
            self._recent.pop(0)
        depth = place.position - self._touch if self._touch is not None else np.nan
        self._watch(Moment(self._plan.name, self._phase, self._replicate, place.position, depth,
                           self._recent[-1][1] if self._recent else np.nan,
                           min((now - self._began) / self.seconds, 1.0) if self.seconds else 1.0))

    def _mean(self, seconds: float) -> float:
        """Of the last forces, N; NaN where there is none."""
        since = self._recent[-1][0] - seconds if self._recent else 0.0
        return float(np.mean([force for at, force in self._recent if at >= since])) if self._recent else np.nan

    def _go(self, position: float, speed: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Move, and look until the tool is there; True: something else ended it, and the tool stands."""
        start = self._place.position if self._place is not None else 0.0
        if not self._limits.lowest <= position <= self._limits.highest:
            raise StoppedError(Stop("travel", f"the motion would go to {position * 1e3:.4g} mm, outside of its limits "
                                              "of "
                                              f"{self._limits.lowest * 1e3:g} to {self._limits.highest * 1e3:g} mm; "
                                              "put the "
                                              "specimen nearer"))
        self._stage.move(position, speed)
        self._drive = Drive(start, position, speed, self._now())
        while True:
            self._tick()
            if until():
                self._stage.halt()
                self._drive = None
                return True
            assert self._place is not None
            if not self._place.moving:
                break
        self._drive = None
        if abs(self._place.position - position) > max(_PLACED, 1e-3 * abs(position - start)):
            raise StoppedError(Stop("stage stalled", f"the stage stands at {self._place.position * 1e3:.4g} mm, where "
                                                     f"{position * 1e3:.4g} mm were asked for; home it again"))
        return False

    def _rest(self, seconds: float) -> None:
        until = self._now() + seconds
        while self._now() < until:
            self._tick()

    def _home(self) -> None:
        self._phase = "home"
        self._tick()
        assert self._place is not None
        if not self._place.homed or self._folder.is_begun:
            self._stage.home()
            until = self._now() + 60.0 + 2 * (self._limits.highest - self._limits.lowest) / self._limits.speed
            while True:
                self._tick()
                if self._place.homed and not self._place.moving:
                    break
                if self._now() > until:
                    raise StoppedError(Stop("stage stalled", "the stage does not find its zero; look at its limit "
                                                             "switch"))

    def _tare(self) -> None:
        """Zero the sensor where it touches nothing, and see that it reads zero; the rest is taken off here."""
        self._phase = "tare"
        self._sensor.tare()
        self._zero = 0.0
        self._recent.clear()
        self._rest(_ZERO_OVER)
        self._zero = self._mean(_ZERO_OVER)
        left = abs(self._zero)
        if not left <= _ZERO_SHARE * self._plan.contact_force:
            raise StoppedError(Stop("zero", f"the sensor reads {left:.3g} N after its tare, with nothing on the tool; "
                                            "let it "
                                            "warm up, take what touches it away, or give a larger contact_force_N"))

    def _carry_out(self, plan: Plan) -> None:
        missing = self._folder.missing(plan.name, plan.replicates)
        if not missing:
            return
        self._plan, self._replicate, self._touch = plan, 0, None
        if plan.contact == "force":
            self._go(min(0.0, self._limits.highest), plan.approach_speed)
            self._tare()
            self._find_touch()
        else:
            self._tare()
            self._touch = self._place.position if self._place is not None else 0.0
        for cycle in range(plan.preconditioning):
            self._phase = "preconditioning"
            self._follow(plan, f"preconditioning {cycle + 1} of {plan.preconditioning}")
        for number in missing:
            self._replicate = number
            self._record(plan, number)
        self._replicate = 0
        self._wait_above()

    def _find_touch(self) -> None:
        """Go in until the force says so, back, and once more slowly: that place is the touch."""
        plan = self._plan
        self._phase = "approach"

        def touches() -> bool:
            return self._mean(_TOUCH_OVER) >= plan.contact_force

        for speed in (plan.approach_speed, 0.2 * plan.approach_speed):
            taken = self._taken = Taken()
            if not self._go(self._limits.highest, speed, touches):
                raise StoppedError(Stop("no contact", f"no force of {plan.contact_force:g} N was felt on the whole "
                                                      "way; put "
                                                      "the specimen nearer, or look at the sign and the axis of the "
                                                      "sensor"))
            assert self._place is not None
            halted = self._touch = self._place.position
            self._taken = None
            self._recent.clear()
            self._wait_above(2.0)
        self._touch, self._touch_found = refined_touch(taken, plan, halted, self._sensor.channels,
                                                       1.0 / self._sensor.rate)
        self._wait_above()
        self._tare()

    def _wait_above(self, times: float = 1.0) -> None:
        """Above the touch, by so many times the plan's height, where the plan finds it by force; elsewhere at it."""
        assert self._touch is not None
        above = times * self._plan.retract if self._plan.contact == "force" else 0.0
        self._go(max(self._touch - above, self._limits.lowest), self._plan.approach_speed)

    def _follow(self, plan: Plan, words: str) -> None:
        """The motion of a plan, once."""
        assert self._touch is not None
        self._go(self._touch + plan.legs[0].start, plan.approach_speed)
        for leg in plan.legs:
            self._phase = leg.segment.kind
            if self._taken is not None:
                self._taken.legs.append((self._now(), leg.segment.kind, leg.cycle))
            if leg.speed:
                self._go(self._touch + leg.end, leg.speed)
            else:
                self._rest(leg.duration)
        self._note_loading(plan, words)

    def _note_loading(self, plan: Plan, words: str) -> None:
        self._folder.note(history=[*self._folder.state["history"], {
            "test": plan.name, "what": words, "depth_mm": plan.depth * 1e3, "at": _clock_time()}])

    def _record(self, plan: Plan, number: int) -> None:
        self._phase = "rest"
        self._wait_above()
        self._rest(plan.rest)
        self._check_zero()
        name, channels = f"{plan.name}_{number}", self._sensor.channels
        self._partial = self._folder.partial(name, ["time [s]", "displacement [mm]", "force [N]", "segment"])
        self._taken = Taken()
        started = _clock_time()
        try:
            self._follow(plan, f"recording {number} of {plan.replicates}")
            self._rest(2 * PERIOD)
        finally:
            taken, self._taken = self._taken, None
        partial, self._partial = self._partial, None
        partial.close()
        recording = as_recording(taken, plan, self._touch or 0.0, self._zero, channels, 1.0 / self._sensor.rate)
        self._folder.keep(name, recording.with_metadata(**plan.about, **self._about, **{
            "name": name, "test": plan.name, "replicate": number, "started": started, "ended": _clock_time(),
            "sensor": self._sensor.describe(), "stage": self._stage.describe(), "axis": plan.axis, "sign": plan.sign,
            "zeroed": "before this test, above the specimen" if plan.contact == "force" else "before this test",
            "zero_after_tare_N": self._zero, "touch_mm": (self._touch or 0.0) * 1e3, **self._touch_found,
            "loadings_before": len(self._folder.state["history"]) - 1,
            "stops_before": self._folder.state["stops"], "stopped_by": None,
            **recording.metadata}))

    def _check_zero(self) -> None:
        """Above the specimen the sensor must still read zero: a zero that has moved, or lost steps, show here."""
        if self._plan.contact != "force":
            return
        self._recent.clear()
        self._rest(_ZERO_OVER)
        left = abs(self._mean(_ZERO_OVER))
        if not left <= self._plan.contact_force:
            raise StoppedError(Stop("zero", f"the sensor reads {left:.3g} N above the specimen, where it was zeroed; "
                                            "its zero "
                                            "has moved, something sticks to the tool, or the stage has lost steps"))


def _stop_of(error: BaseException) -> Stop:
    match error:
        case StoppedError():
            return error.stop
        case KeyboardInterrupt():
            return Stop("asked", "stopped by Ctrl-C")
        case DeviceError() | InputError():
            return Stop("device", str(error))
    return Stop("device", f"{type(error).__name__}: {error}")


def _described(limits: MotionLimits) -> dict[str, Any]:
    return {"force_N": limits.force, "lowest_mm": limits.lowest * 1e3, "highest_mm": limits.highest * 1e3,
            "speed_mm_s": limits.speed * 1e3, "duration_s": limits.duration,
            "stiffness_N_per_mm": limits.stiffness * 1e-3, "force_margin_N": limits.force_margin,
            "sensor_silence_s": limits.sensor_silence, "on_stop": "retract" if limits.retracts else "stand"}


def _clock_time() -> str:
    return time.strftime("%Y-%m-%dT%H:%M:%S%z")
