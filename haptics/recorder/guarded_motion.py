"""Motions that somebody watches: every look at sensor and stage passes the guard, and nothing moves unlooked at."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import TypeVar

import numpy as np

from haptics.devices.contracts import Bench, DeviceError, ForceSample, StageSample
from haptics.recorder.plan import DEAD, PERIOD
from haptics.safety.motion_guard import Drive, MotionGuard, MotionLimits, Stop
from tissue_sim.errors import InputError

T = TypeVar("T")
#: Forces that are kept to take a mean of, s.
_RECENT = 0.1
#: The tool is where it was sent when it rests within this of it, m; and a stage that was told to move may take so long
#: to say that it does, s.
_PLACED, _SETTLES = 20e-6, 0.5
#: A stage that is halted may take so long, beside `Stage.runs_on`, to stand, s; and no longer than this is waited.
_STANDS, _LONGEST_STAND = 0.5, 5.0
#: While the tool goes back after a stop, the force may grow by this share of the limit before that is given up, too.
_GROWS = 0.1
#: A stage has so long to find its zero, s, beside twice the way at its largest speed.
_HOMING = 60.0


class StoppedError(RuntimeError):
    """A run that was ended before its end.

    Attributes:
        stop: why.
    """

    def __init__(self, stop: Stop):
        super().__init__(stop.message)
        self.stop = stop


class GuardedMotion:
    """A bench that moves within limits.

    Args:
        bench: neither of its devices is started.
        limits: of all motions.
        axis, sign: channel of the sensor along the tool, and 1, or -1 where it reads less when the tool is pushed.
        looked: told of every look: new samples, their forces on the tool, N, where the stage is.
        asked: a sentence when somebody wants it to end; None while nobody does.
        clock, pause: s, that of the devices; and what lets it go on by so many s.

    Attributes:
        place: of the stage at the last look; None before the first.
        zero: what is left of the sensor's zero after its tare, N; forces are less it.
        began: when the devices were started, s.

    Raises:
        InputError: the sensor has no such channel.
    """

    def __init__(self, bench: Bench, limits: MotionLimits, axis: str, sign: int, *,
                 looked: Callable[[Sequence[ForceSample], Sequence[float], StageSample], None],
                 asked: Callable[[], str | None], clock: Callable[[], float] = time.monotonic,
                 pause: Callable[[float], None] = time.sleep):
        self.sensor, self.stage, self.limits = bench.sensor, bench.stage, limits
        if axis not in bench.sensor.channels:
            raise InputError(f"the sensor has no channel {axis!r}; it has {', '.join(bench.sensor.channels)}",
                             field="record.axis")
        self._axis, self._sign = bench.sensor.channels.index(axis), sign
        self._looked, self._asked, self.now, self._pause = looked, asked, clock, pause
        self.place: StageSample | None = None
        self.zero = self.began = self._ticked = 0.0
        self._guard: MotionGuard | None = None
        self._drive: Drive | None = None
        #: Whether the stage was sent off and has not been seen to stand.
        self._moves = False
        #: What the sensor read before the first tare of this run, N, and by how much later ones changed that.
        self.tares: list[float] = []
        self._recent: deque[tuple[float, float]] = deque()
        #: By how much a look came late, s, where that halted the stage.
        self._late: float | None = None

    @contextmanager
    def running(self, away: Callable[[], tuple[float, float]]) -> Iterator[None]:
        """Both devices, started. Whatever happens, the stage stands first, and both are stopped, each whatever becomes
        of the other.

        Args:
            away: where the tool goes after a stop, where it goes back, m, and at what speed, m/s.

        Raises:
            StoppedError: something ended the motion.
            DeviceError: a device does not start.
        """
        try:
            self.sensor.start()
            self.stage.start()
            self.began = self._ticked = self.now()
            self._guard = MotionGuard(self.limits, self.sensor.rate, self.sensor.channels,
                                      self.stage.measures_position, self.began)
            with self._dead_man():
                try:
                    yield
                except BaseException as error:
                    stop = self._end(_stop_of(error), away)
                    raise StoppedError(stop) from error
        finally:
            try:
                with contextlib.suppress(Exception):
                    self.stage.stop()
            finally:
                with contextlib.suppress(Exception):
                    self.sensor.stop()

    @contextmanager
    def _dead_man(self) -> Iterator[None]:
        """Halts the stage from another thread when this one no longer looks."""
        ending = threading.Event()

        def watch() -> None:
            while not ending.wait(0.2 * DEAD):
                late = self.now() - self._ticked
                if self._moves and late > max(DEAD, self.limits.sensor_silence):
                    with contextlib.suppress(Exception):
                        self.stage.halt()
                    self._late = late

        thread = threading.Thread(target=watch, name="dead man", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ending.set()
            thread.join()

    def _end(self, stop: Stop, away: Callable[[], tuple[float, float]]) -> Stop:
        """Stand still, and see that it does; then go back, where that is wanted and the stage is to be believed."""
        self._moves, self._drive = False, None
        if (trouble := self._stand()) is not None:
            return Stop(stop.cause, f"{stop.message}; and the stage does not stand ({trouble}): switch it off")
        if self.limits.retracts and stop.may_retract and self.place is not None and self.place.homed:
            try:
                trouble = self._go_back(*away())
            except BaseException as error:
                trouble = str(error) or type(error).__name__
            if trouble is not None:
                self._stand()
                return Stop(stop.cause, f"{stop.message}; and the tool did not go back ({trouble})")
        return stop

    def _stand(self) -> str | None:
        """Halt, and wait until the stage says that it stands; what is wrong where it does not."""
        try:
            self.stage.halt()
            until = self.now() + min(self.stage.runs_on + _STANDS, _LONGEST_STAND)
            while True:
                self.place = self.stage.position()
                if not self.place.moving:
                    return None
                if self.now() > until:
                    return f"it still says that it moves, at {self.place.position * 1e3:.4g} mm"
                self._pause(PERIOD)
        except BaseException as error:
            return str(error) or type(error).__name__

    def _go_back(self, goal: float, speed: float) -> str | None:
        """The way out after a stop, as long as the force does not grow on it; why it was given up.

        A sensor that is silent, or at the end of its range, says nothing against the way out.
        """
        assert self.place is not None
        goal = max(min(goal, self.place.position), self.limits.lowest)
        until = self.now() + 2 * abs(goal - self.place.position) / speed + _SETTLES
        allowed = max(abs(self.force) if self._recent else 0.0, self.limits.force) + _GROWS * self.limits.force
        self.stage.move(goal, speed)
        while self.now() < until:
            self._pause(PERIOD)
            with contextlib.suppress(DeviceError):
                forces = [self._sign * sample.values[self._axis] - self.zero for sample in self.sensor.read()]
                if any(abs(force) > allowed for force in forces):
                    return f"the force grew to {max(map(abs, forces)):.3g} N"
            self.place = self.stage.position()
            if not self.place.moving and abs(self.place.position - goal) <= _PLACED:
                return None
        return f"it is at {self.place.position * 1e3:.4g} mm"

    def tick(self) -> None:
        """Look at both devices once, and let the guard judge.

        Raises:
            StoppedError: the motion has to end; the stage was halted.
        """
        self._pause(max(0.0, self._ticked + PERIOD - self.now()))
        self._require_on_time()
        if (words := self._asked()) is not None:
            with contextlib.suppress(Exception):
                self.stage.halt()
            raise StoppedError(Stop("asked", words))
        samples = self.sensor.read()
        place = self.place = self.stage.position()
        now = self._ticked = self.now()
        forces = [self._sign * sample.values[self._axis] - self.zero for sample in samples]
        self._recent.extend((sample.received, force) for sample, force in zip(samples, forces, strict=True))
        while self._recent and self._recent[-1][0] - self._recent[0][0] > _RECENT:
            self._recent.popleft()
        # Kept first: what ends a motion is in its recording.
        self._looked(samples, forces, place)
        assert self._guard is not None
        if (stop := self._guard.check(now, samples, forces, place, self._drive)) is not None:
            # Here, before anybody writes down why.
            with contextlib.suppress(Exception):
                self.stage.halt()
            raise StoppedError(stop)

    def _require_on_time(self) -> None:
        if self._late is not None:
            raise StoppedError(Stop(
                "program late", f"the program did not look at its devices for {self._late:.2g} s while the stage could "
                                "move, and the stage was halted; close what else runs on this computer"))

    def mean(self, seconds: float = _RECENT) -> float:
        """Of the last forces, N, of 0.1 s at most; NaN where there is none."""
        if not self._recent:
            return np.nan
        since = self._recent[-1][0] - seconds
        return float(np.mean([force for at, force in self._recent if at >= since]))

    @property
    def force(self) -> float:
        """The last one, N; NaN where there is none."""
        return self._recent[-1][1] if self._recent else np.nan

    def go(self, position: float, speed: float, until: Callable[[], bool] = lambda: False) -> bool:
        """Move, and look until the tool is there; True: `until` ended it, and the tool stands.

        Args:
            position: m. speed: m/s.

        Raises:
            StoppedError: something ended it, or the tool did not get there.
        """
        if not self.limits.lowest <= position <= self.limits.highest:
            raise StoppedError(Stop(
                "travel", f"the motion would go to {position * 1e3:.4g} mm, outside of its limits of "
                          f"{self.limits.lowest * 1e3:g} to {self.limits.highest * 1e3:g} mm; put the specimen nearer"))
        self._require_on_time()
        start = self.place.position if self.place is not None else position
        near = max(_PLACED, 1e-3 * abs(position - start))
        # What was computed since the last look is no reason to halt what has not been sent off yet.
        self._ticked = self.now()
        self._moves = True
        self.stage.move(position, speed)
        drive, ended = Drive(start, position, speed, self.now()), False
        self._drive = drive
        while not ended:
            self.tick()
            if ended := until():
                if (trouble := self._stand()) is not None:
                    raise StoppedError(Stop("stage fault", f"the stage does not stand ({trouble}): switch it off"))
                break
            assert self.place is not None
            there = abs(self.place.position - position) <= near
            if not self.place.moving and (there or self.now() - drive.began > _SETTLES):
                break
        self._moves = False
        assert self.place is not None
        self._drive = Drive(self.place.position, self.place.position, 0.0, self.now())
        if not ended and abs(self.place.position - position) > near:
            raise StoppedError(Stop(
                "stage stalled", f"the stage stands at {self.place.position * 1e3:.4g} mm, where "
                                 f"{position * 1e3:.4g} mm were asked for; home it again"))
        return ended

    def do_meanwhile(self, task: Callable[[], T]) -> T:
        """Do something that takes its time, in another thread, and look at the devices until it is done."""
        with ThreadPoolExecutor(1) as pool:
            done = pool.submit(task)
            # The wait leaves the processor to the task, also where the clock of the looks is not that of the computer.
            while not wait([done], timeout=0.5 * PERIOD).done:
                self.tick()
            return done.result()

    def rest(self, seconds: float) -> None:
        """Look for so long, s."""
        until = self.now() + seconds
        while self.now() < until:
            self.tick()

    def home(self) -> None:
        """Find the zero of the stage, and wait until it is there; from now on its place is judged."""
        self.tick()
        self._ticked = self.now()
        self._moves = True
        self.stage.home()
        until = self.now() + _HOMING + 2 * (self.limits.highest - self.limits.lowest) / self.limits.speed
        while True:
            self.tick()
            assert self.place is not None
            if self.place.homed and not self.place.moving:
                break
            if self.now() > until:
                raise StoppedError(Stop("stage stalled", "the stage does not find its zero; look at its limit switch"))
        self._moves = False
        assert self._guard is not None
        self._guard.knows_place = True

    def tare(self, first: float, change: float) -> None:
        """Zero the sensor where it touches nothing; what its own tare leaves is taken off here.

        Args:
            first: that it may read before the first tare of a run, N. change: by which later ones may differ, N.

        Raises:
            StoppedError: it read more than that: something presses, or its zero moves.
        """
        self.zero = 0.0
        self.forget()
        self.rest(_RECENT)
        before, allowed = self.mean(), change if self.tares else first
        if not abs(before) <= allowed:
            raise StoppedError(Stop(
                "zero", f"the sensor reads {before:.3g} N before it is zeroed, where {allowed:.3g} N are allowed; see "
                        "that nothing presses on the tool, let it warm up, or give a larger "
                        f"{'contact_force_N' if self.tares else 'tare_N'}"))
        self.tares.append(before)
        self.sensor.tare()
        assert self._guard is not None
        self._guard.knows_zero = True
        self.forget()
        self.rest(_RECENT)
        self.zero = self.mean()
        if not abs(self.zero) <= change:
            raise StoppedError(Stop("zero", f"the sensor reads {self.zero:.3g} N after its tare; let it warm up"))

    def check_zero(self, allowed: float) -> None:
        """See that the sensor still reads zero where it was zeroed: a zero that has moved, or lost steps, show here."""
        self.forget()
        self.rest(_RECENT)
        left = self.mean()
        if not abs(left) <= allowed:
            raise StoppedError(Stop(
                "zero", f"the sensor reads {left:.3g} N above the specimen, where it was zeroed; its zero has moved, "
                        "something sticks to the tool, or the stage has lost steps"))

    def forget(self) -> None:
        """The last forces: those to come are of another place."""
        self._recent.clear()


def _stop_of(error: BaseException) -> Stop:
    match error:
        case StoppedError():
            return error.stop
        case KeyboardInterrupt():
            return Stop("asked", "stopped by Ctrl-C")
        case DeviceError() | InputError():
            return Stop("device", str(error))
    return Stop("device", f"{type(error).__name__}: {error}")
