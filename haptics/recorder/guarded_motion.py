"""Move a stage under supervision: each poll of sensor and stage passes the motion guard before the motion continues.

The error that ends a supervised motion states its reason.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from haptics.devices.contracts import Bench, DeviceError, ForceSample, StageSample
from haptics.recorder.plan import POLLING
from haptics.safety.force_control import FORCE_CONTROL, ForceControlGuard, ForceController
from haptics.safety.motion_guard import CommandedMotion, MotionGuard, MotionLimits, StopReason
from tissue_sim.errors import InputError


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
        slowest: smallest speed of a command that controls the force, m/s.
    """

    force_window: float = 0.1
    position_tolerance: float = 20e-6
    start_delay: float = 0.5
    halt_margin: float = 0.5
    longest_halt: float = 5.0
    force_growth: float = 0.1
    homing_time: float = 60.0
    slowest: float = 1e-6


class StoppedError(RuntimeError):
    """Error: a motion was stopped before its end.

    Attributes:
        reason: cause and message of the stop.
    """

    def __init__(self, reason: StopReason):
        super().__init__(reason.message)
        self.reason = reason


def get_stop_reason(error: BaseException) -> StopReason:
    """Convert an exception that was raised during a motion into the reason of the stop."""
    match error:
        case StoppedError():
            return error.reason
        case KeyboardInterrupt():
            return StopReason("asked", "stopped by Ctrl-C")
        case DeviceError() | InputError():
            return StopReason("device", str(error))
    return StopReason("device", f"{type(error).__name__}: {error}")


T = TypeVar("T")


#: Settings of every run.
_SETTINGS = GuardedMotionTolerancesAndTimes()


class GuardedMotion:
    """Move the stage of a bench within limits, and stop the stage when the guard reports a fault.

    Args:
        bench: force sensor and stage; neither is started.
        limits: limits of all motions.
        axis: channel of the sensor along the tool.
        sign: 1, or -1 if the reading of the sensor decreases when the tool is pushed into the specimen.
        on_poll: function called at each poll with the new force samples, their forces on the tool, N, and the stage
            sample.
        stop_request: function that returns a sentence when the user wants to stop, and None otherwise.
        clock: time on the clock of the devices, s.
        sleep: function that waits for a number of seconds on that clock.
        make_guard: `MotionGuard`, or a function with its arguments that gives a guard with other tolerances.

    Attributes:
        stage_sample: stage sample of the last poll; None before the first poll.
        zero: reading of the sensor that remains after its tare, N; this reading is subtracted from all forces.
        started: time at which the devices were started, s.
        tares: mean force before each tare, N: the first before the first tare of the run, the others show the drift.

    Raises:
        InputError: the sensor has no channel `axis`.
    """

    def __init__(self, bench: Bench, limits: MotionLimits, axis: str, sign: int, *,
                 on_poll: Callable[[Sequence[ForceSample], Sequence[float], StageSample], None],
                 stop_request: Callable[[], str | None], clock: Callable[[], float] = time.monotonic,
                 sleep: Callable[[float], None] = time.sleep, make_guard: Callable[..., MotionGuard] = MotionGuard):
        self.sensor, self.stage, self.limits = bench.sensor, bench.stage, limits
        if axis not in bench.sensor.channels:
            raise InputError(f"the axis must be a channel of the sensor: {', '.join(bench.sensor.channels)}; got "
                             f"{axis!r}",
                             field="record.axis")
        self._axis, self._sign = bench.sensor.channels.index(axis), sign
        self._on_poll, self._stop_request, self.now, self._sleep = on_poll, stop_request, clock, sleep
        self._make_guard = make_guard
        self.stage_sample: StageSample | None = None
        self.zero = self.started = self._polled = 0.0
        self._guard: MotionGuard | None = None
        self._command: CommandedMotion | None = None
        #: Whether a motion was commanded and the stage was not seen at rest since then.
        self._is_moving = False
        self.tares: list[float] = []
        #: Arrival times, s, and forces, N, of the last samples.
        self._recent: deque[tuple[float, float]] = deque()
        #: Delay of the poll after which the watching thread halted the stage, s; None: no poll was late.
        self._late_by: float | None = None

    @contextmanager
    def run_devices(self, retraction: Callable[[], tuple[float, float]]) -> Iterator[None]:
        """Start both devices for a ``with`` block, watch the polls inside it, and stop the devices at its end.

        After an error in the block the stage is halted first. Each device is stopped even if the other one fails.

        Args:
            retraction: function that returns the position, m, and the speed, m/s, of a retraction after a stop.

        Raises:
            StoppedError: an error or a fault stopped the motion.
            DeviceError: a device does not start.
        """
        try:
            self.sensor.start()
            self.stage.start()
            self.started = self._polled = self.now()
            self._guard = self._make_guard(self.limits, self.sensor.rate, self.sensor.channels,
                                           self.stage.measures_position, self.started)
            with self._watch_polls_in_thread():
                try:
                    yield
                except BaseException as error:
                    reason = self._halt_retract_and_get_reason(get_stop_reason(error), retraction)
                    raise StoppedError(reason) from error
        finally:
            try:
                with contextlib.suppress(Exception):
                    self.stage.stop()
            finally:
                with contextlib.suppress(Exception):
                    self.sensor.stop()

    @contextmanager
    def _watch_polls_in_thread(self) -> Iterator[None]:
        """Run a thread inside a ``with`` block that halts a moving stage if the polls are late (dead-man's switch)."""
        ending = threading.Event()

        def halt_when_polls_are_late() -> None:
            """Halt the moving stage whenever a poll is late, until `ending` is set; the body of the thread."""
            while not ending.wait(0.2 * POLLING.timeout):
                delay = self.now() - self._polled
                if self._is_moving and delay > max(POLLING.timeout, self.limits.sensor_silence):
                    with contextlib.suppress(Exception):
                        self.stage.halt()
                    self._late_by = delay

        thread = threading.Thread(target=halt_when_polls_are_late, name="dead man", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ending.set()
            thread.join()

    def _halt_retract_and_get_reason(self, reason: StopReason,
                                     retraction: Callable[[], tuple[float, float]]) -> StopReason:
        """After a stop, halt the stage; retract the tool if the limits ask for it and the stage still works.

        Args:
            reason: reason of the stop.
            retraction: as for `run_devices`.

        Returns:
            The reason; its message also states a failed halt or retraction.
        """
        self._is_moving, self._command = False, None
        if (trouble := self._halt_and_get_trouble_or_none()) is not None:
            return StopReason(reason.cause, f"{reason.message}; and the stage does not stop ({trouble}): switch it off")
        if (self.limits.retracts and reason.allows_retraction and self.stage_sample is not None
                and self.stage_sample.homed):
            try:
                trouble = self._retract_and_get_trouble_or_none(*retraction())
            except BaseException as error:
                trouble = str(error) or type(error).__name__
            if trouble is not None:
                self._halt_and_get_trouble_or_none()
                return StopReason(reason.cause, f"{reason.message}; and the tool was not retracted ({trouble})")
        return reason

    def _halt_and_get_trouble_or_none(self) -> str | None:
        """Halt the stage and wait until it reports that it is at rest; raises no error.

        Returns:
            None, or a description of the problem if the stage fails or keeps moving.
        """
        try:
            self.stage.halt()
            until = self.now() + min(self.stage.runs_on + _SETTINGS.halt_margin, _SETTINGS.longest_halt)
            while True:
                self.stage_sample = self.stage.position()
                if not self.stage_sample.moving:
                    return None
                if self.now() > until:
                    return f"it still reports a motion, at {self.stage_sample.position * 1e3:.4g} mm"
                self._sleep(POLLING.period)
        except BaseException as error:
            return str(error) or type(error).__name__

    def _retract_and_get_trouble_or_none(self, goal: float, speed: float) -> str | None:
        """Move the tool out after a stop, as long as the force does not grow.

        A silent or saturated sensor does not prevent the retraction.

        Args:
            goal: position, m; a goal that is deeper than the present position is replaced by the present position.
            speed: m/s.

        Returns:
            None, or the reason why the retraction was abandoned.
        """
        assert self.stage_sample is not None
        goal = max(min(goal, self.stage_sample.position), self.limits.lowest)
        until = self.now() + 2 * abs(goal - self.stage_sample.position) / speed + _SETTINGS.start_delay
        allowed = (max(abs(self.last_force) if self._recent else 0.0, self.limits.force)
                   + _SETTINGS.force_growth * self.limits.force)
        self.stage.move(goal, speed)
        while self.now() < until:
            self._sleep(POLLING.period)
            with contextlib.suppress(DeviceError):
                forces = [self._sign * sample.values[self._axis] - self.zero for sample in self.sensor.read()]
                if any(abs(force) > allowed for force in forces):
                    return f"the force grew to {max(map(abs, forces)):.3g} N"
            self.stage_sample = self.stage.position()
            at_goal = abs(self.stage_sample.position - goal) <= _SETTINGS.position_tolerance
            if not self.stage_sample.moving and at_goal:
                return None
        return f"it is at {self.stage_sample.position * 1e3:.4g} mm"

    def poll(self) -> None:
        """Wait until the next poll is due, read both devices once, pass the samples to `on_poll`, and check them.

        Raises:
            StoppedError: the guard or the user ended the motion; the stage was halted.
        """
        self._sleep(max(0.0, self._polled + POLLING.period - self.now()))
        self._require_polls_on_time()
        if (message := self._stop_request()) is not None:
            with contextlib.suppress(Exception):
                self.stage.halt()
            raise StoppedError(StopReason("asked", message))
        samples = self.sensor.read()
        stage = self.stage_sample = self.stage.position()
        now = self._polled = self.now()
        forces = [self._sign * sample.values[self._axis] - self.zero for sample in samples]
        self._recent.extend((sample.received, force) for sample, force in zip(samples, forces, strict=True))
        while self._recent and self._recent[-1][0] - self._recent[0][0] > _SETTINGS.force_window:
            self._recent.popleft()
        # Store the samples before the check, so that the recording contains the samples that end the motion.
        self._on_poll(samples, forces, stage)
        assert self._guard is not None
        if (reason := self._guard.find_stop_reason(now, samples, forces, stage, self._command)) is not None:
            # Halt here, before the slower handling of the error.
            with contextlib.suppress(Exception):
                self.stage.halt()
            raise StoppedError(reason)

    def _require_polls_on_time(self) -> None:
        """Raise StoppedError if the watching thread halted the stage because a poll was late."""
        if self._late_by is not None:
            raise StoppedError(StopReason(
                "program late", f"the program did not poll its devices for {self._late_by:.2g} s while the stage could "
                                "move, and the stage was halted; close other programs on this computer"))

    def compute_mean_of_recent_forces(self, seconds: float = _SETTINGS.force_window) -> float:
        """Return the mean of the forces stored by past polls in the last time window, N; NaN without a sample.

        Args:
            seconds: length of the window, s, at most `GuardedMotionTolerancesAndTimes.force_window`.
        """
        if not self._recent:
            return np.nan
        since = self._recent[-1][0] - seconds
        return float(np.mean([force for at, force in self._recent if at >= since]))

    @property
    def last_force(self) -> float:
        """Last measured force along the tool minus `zero`, N, with the sign of the plan; NaN without a sample."""
        return self._recent[-1][1] if self._recent else np.nan

    def move_until_arrival_or_condition(self, position: float, speed: float,
                                        until: Callable[[], bool] = lambda: False) -> bool:
        """Move to a position, and poll until the stage arrives or a condition is met, which halts the stage.

        Args:
            position: goal, m.
            speed: m/s.
            until: condition that is checked after each poll; if it returns True, the stage is halted.

        Returns:
            Whether `until` ended the motion.

        Raises:
            StoppedError: the goal is outside of the limits, the guard or the user ended the motion, or the tool did not
                reach the goal.
        """
        if not self.limits.lowest <= position <= self.limits.highest:
            raise StoppedError(StopReason(
                "travel", f"the motion would go to {position * 1e3:.4g} mm, outside of its limits of "
                          f"{self.limits.lowest * 1e3:g} to {self.limits.highest * 1e3:g} mm; put the specimen nearer"))
        self._require_polls_on_time()
        start = self.stage_sample.position if self.stage_sample is not None else position
        tolerance = max(_SETTINGS.position_tolerance, 1e-3 * abs(position - start))
        # The stage is at rest: time since the last poll, such as a computation, does not count as a late poll.
        self._polled = self.now()
        self._is_moving = True
        self.stage.move(position, speed)
        command, ended = CommandedMotion(start, position, speed, self.now()), False
        self._command = command
        while not ended:
            self.poll()
            if ended := until():
                if (trouble := self._halt_and_get_trouble_or_none()) is not None:
                    raise StoppedError(StopReason("stage fault",
                                                  f"the stage does not stop ({trouble}): switch it off"))
                break
            assert self.stage_sample is not None
            at_goal = abs(self.stage_sample.position - position) <= tolerance
            if not self.stage_sample.moving and (at_goal or self.now() - command.started > _SETTINGS.start_delay):
                break
        self._is_moving = False
        assert self.stage_sample is not None
        self._command = CommandedMotion(self.stage_sample.position, self.stage_sample.position, 0.0, self.now())
        if not ended and abs(self.stage_sample.position - position) > tolerance:
            raise StoppedError(StopReason(
                "stage stalled", f"the stage stands at {self.stage_sample.position * 1e3:.4g} mm instead of "
                                 f"{position * 1e3:.4g} mm; home it again"))
        return ended

    def control_force(self, start: float, end: float, duration: float, controller: ForceController,
                      guard: ForceControlGuard, contact_point: float, deepest: float) -> None:
        """Move the stage so that the force follows a line in time, and halt the stage at the end.

        Args:
            start: prescribed force at the start, N.
            end: prescribed force at the end, N.
            duration: s.
            controller: controller of the force.
            guard: guard of the control.
            contact_point: position of the stage at the contact point, m.
            deepest: largest depth of a command below the contact point, m.

        Raises:
            StoppedError: a guard or the user ended the motion, or the stage does not stop.
        """
        self._require_polls_on_time()
        self._polled = self.now()
        self.poll()
        started = last = self.now()
        rate = (end - start) / duration
        while (now := self.now()) - started < duration:
            assert self.stage_sample is not None
            goal, position = start + rate * (now - started), self.stage_sample.position
            force = self.compute_mean_of_recent_forces(FORCE_CONTROL.window)
            speed = controller.compute_speed(goal, rate, force, position - contact_point, now - last)
            speed = min(speed, 0.0) if guard.suspects_lost_contact else speed
            target = position + speed * FORCE_CONTROL.horizon
            target = min(max(target, self.limits.lowest), self.limits.highest, contact_point + deepest)
            self._is_moving, last = True, now
            self.stage.move(target, max(abs(speed), _SETTINGS.slowest))
            self._command = CommandedMotion(position, target, abs(speed), now)
            self.poll()
            travel = math.copysign(min(abs(speed) * (self.now() - now), abs(target - position)), speed)
            reason = guard.find_stop_reason(self.now(), goal, self.compute_mean_of_recent_forces(FORCE_CONTROL.window),
                                            self.stage_sample.position - contact_point, travel)
            if reason is not None:
                with contextlib.suppress(Exception):
                    self.stage.halt()
                raise StoppedError(reason)
        if (trouble := self._halt_and_get_trouble_or_none()) is not None:
            raise StoppedError(StopReason("stage fault", f"the stage does not stop ({trouble}): switch it off"))
        assert self.stage_sample is not None
        self._is_moving = False
        self._command = CommandedMotion(self.stage_sample.position, self.stage_sample.position, 0.0, self.now())

    def run_while_polling(self, task: Callable[[], T]) -> T:
        """Run a slow function in another thread, poll until it ends, and return its result or raise its error."""
        with ThreadPoolExecutor(1) as pool:
            future = pool.submit(task)
            # The real wait gives the processor to the task, also if the clock of the polls is simulated.
            while not wait([future], timeout=0.5 * POLLING.period).done:
                self.poll()
            return future.result()

    def poll_for_duration(self, seconds: float) -> None:
        """Poll the devices for this time, s, without a new command to the stage."""
        until = self.now() + seconds
        while self.now() < until:
            self.poll()

    def home(self) -> None:
        """Move the stage to its reference point and wait for the end of homing; the guard then checks the position.

        Raises:
            StoppedError: the guard or the user ended the motion, or homing took too long.
        """
        self.poll()
        self._polled = self.now()
        self._is_moving = True
        self.stage.home()
        until = self.now() + _SETTINGS.homing_time + 2 * (self.limits.highest - self.limits.lowest) / self.limits.speed
        while True:
            self.poll()
            assert self.stage_sample is not None
            if self.stage_sample.homed and not self.stage_sample.moving:
                break
            if self.now() > until:
                raise StoppedError(StopReason("stage stalled",
                                              "the stage does not find its zero; check its limit switch"))
        self._is_moving = False
        assert self._guard is not None
        self._guard.is_stage_homed = True

    def tare(self, first: float, change: float) -> None:
        """Check that the sensor is unloaded, tare it, and store the mean reading after the tare as `zero`.

        Args:
            first: largest magnitude of the force before the first tare of a run, N.
            change: largest magnitude of the force before each later tare, and of the reading after each tare, N.

        Raises:
            StoppedError: the force is larger: the tool is loaded, or the zero of the sensor drifts.
        """
        self.zero = 0.0
        self.discard_stored_forces()
        self.poll_for_duration(_SETTINGS.force_window)
        before, allowed = self.compute_mean_of_recent_forces(), change if self.tares else first
        if not abs(before) <= allowed:
            raise StoppedError(StopReason(
                "zero", f"the sensor reads {before:.3g} N before it is zeroed, more than the allowed {allowed:.3g} N; "
                        "check that nothing presses on the tool, let the sensor warm up, or increase "
                        f"{'contact_force_N' if self.tares else 'tare_N'}"))
        self.tares.append(before)
        self.sensor.tare()
        assert self._guard is not None
        self._guard.is_sensor_zeroed = True
        self.discard_stored_forces()
        self.poll_for_duration(_SETTINGS.force_window)
        self.zero = self.compute_mean_of_recent_forces()
        if not abs(self.zero) <= change:
            raise StoppedError(StopReason(
                "zero", f"the sensor reads {self.zero:.3g} N after its tare; let the sensor warm up"))

    def require_zero_force(self, allowed: float) -> None:
        """Poll for a window, and raise an error if the mean force differs from zero where the sensor was zeroed.

        The check detects a drift of the sensor, lost steps of the motor, and material that sticks to the tool.

        Args:
            allowed: largest magnitude of the mean force, N.

        Raises:
            StoppedError: the force is larger.
        """
        self.discard_stored_forces()
        self.poll_for_duration(_SETTINGS.force_window)
        offset = self.compute_mean_of_recent_forces()
        if not abs(offset) <= allowed:
            raise StoppedError(StopReason(
                "zero", f"the sensor reads {offset:.3g} N above the specimen, where it was zeroed; its zero has moved, "
                        "material sticks to the tool, or the stage has lost steps"))

    def discard_stored_forces(self) -> None:
        """Discard the forces stored by past polls, because the next mean belongs to another position."""
        self._recent.clear()
