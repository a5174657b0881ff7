"""Execute the plan of a test: find contact, precondition, record the replicates, and write the recordings.

The progress of a run is published in ``live.json``, so that other programs can show it.
"""

from __future__ import annotations

import contextlib
import json
import math
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from haptics.devices.contracts import Bench, DeviceError, ForceSample, StageSample
from haptics.recorder.guarded_motion import GuardedMotion, StoppedError
from haptics.recorder.motion_record import MotionRecord, build_recording, estimate_contact_point_and_metadata
from haptics.recorder.plan import POLLING, BenchTestPlan, check_plans_and_compute_duration
from haptics.recorder.run_folder import PartialRecordingWriter, RunFolder
from haptics.safety.force_control import ForceControlGuard, ForceController
from haptics.safety.motion_guard import GUARD, MotionGuard, MotionGuardSettings, MotionLimits, StopReason
from tissue_sim.errors import InputError
from tissue_sim.experiment.protocol_legs import MotionLeg
from tissue_sim.experiment.protocol_text import FORCE
from tissue_sim.files import write_text
from tissue_sim.settings import get_changed_settings_by_name


@dataclass(frozen=True)
class ContactSearchAveragingAndSpeed:
    """Averaging time of the force, and relative speed of the second approach, in the search for contact.

    Attributes:
        window: time over which the force is averaged, s. A longer window averages more noise and detects contact later.
        slow_fraction: speed of the second approach as a fraction of the approach speed of the plan, 1. A slower
            approach indents less before contact is detected.
    """

    window: float = 0.02
    slow_fraction: float = 0.2


_CONTACT_SEARCH = ContactSearchAveragingAndSpeed()


@dataclass(frozen=True)
class RunProgress:
    """Progress of a run at one poll, for displays.

    Attributes:
        test: name of the test.
        phase: activity, such as ``"home"``, ``"approach"``, ``"ramp"`` or ``"hold"``.
        replicate: number of the replicate, from 1; 0 outside of a replicate.
        position: position of the stage, m.
        depth: depth below the contact point, m; NaN if the contact point is unknown.
        force: force on the tool, N.
        fraction: elapsed time divided by the planned duration, 0 to 1.
    """

    test: str
    phase: str
    replicate: int
    position: float
    depth: float
    force: float
    fraction: float


class Recorder:
    """Execute the plan of a test within limits, and write the samples of its sensor.

    Args:
        bench: force sensor and stage; neither is started.
        plan: plan of the test.
        limits: limits of all motions.
        folder: folder of the run, already entered with ``with``.
        about: metadata of the run for every recording: operator, place, program.
        stop_request: function that returns a sentence when the user wants to stop, and None otherwise.
        on_progress: function called at each poll of the devices.
        clock: time on the clock of the devices, s.
        sleep: function that waits for a number of seconds on that clock.
        guard_settings: tolerances of the guard; the state of the run names those that differ from the defaults.

    Attributes:
        seconds: shortest possible duration of the plan, s.

    Raises:
        InputError: the plan exceeds the limits; no device is started.
    """

    def __init__(self, bench: Bench, plan: BenchTestPlan, limits: MotionLimits, folder: RunFolder, *,
                 about: dict[str, Any] | None = None, stop_request: Callable[[], str | None] = lambda: None,
                 on_progress: Callable[[RunProgress], None] = lambda progress: None,
                 clock: Callable[[], float] = time.monotonic, sleep: Callable[[float], None] = time.sleep,
                 guard_settings: MotionGuardSettings = GUARD):
        self.seconds = check_plans_and_compute_duration([plan], limits, bench.stage, 1.0 / bench.sensor.rate)
        self._motion = GuardedMotion(bench, limits, plan.axis, plan.sign,
                                     on_poll=self._store_samples_and_report_progress,
                                     stop_request=stop_request, clock=clock, sleep=sleep,
                                     make_guard=partial(MotionGuard, settings=guard_settings))
        self._plan, self._limits, self._folder, self._about = plan, limits, folder, about or {}
        self._on_progress, self._guard_settings = on_progress, guard_settings
        self._record: MotionRecord | None = None
        self._partial: PartialRecordingWriter | None = None
        self._phase, self._replicate = "start", 0
        #: Position of the stage at the contact point, m; None: unknown.
        self._contact_point: float | None = None
        #: Largest depth below the contact point in the present motion, m.
        self._deepest = 0.0
        self._first_contact_point: float | None = None
        self._contact_metadata: dict[str, Any] = {}

    def run(self) -> None:
        """Execute the whole run: record and save all replicates that the folder does not contain yet.

        Raises:
            StoppedError: the run was stopped. The stage is at rest or retracted, and the recorded samples are kept.
            DeviceError: a device does not start.
        """
        folder, plan, motion = self._folder, self._plan, self._motion
        folder.update_state(state="running", limits=_convert_limits_to_json(self._limits),
                            guard_settings=get_changed_settings_by_name(self._guard_settings), about=self._about)
        try:
            with motion.run_devices(self._get_retraction_position_and_speed):
                stage = motion.stage
                # Some devices state their rate and their run-on time only after the start.
                check_plans_and_compute_duration([plan], self._limits, stage, 1.0 / motion.sensor.rate)
                folder.update_state(sensor=motion.sensor.describe(), stage=stage.describe(),
                                    stall="detected by the encoder" if stage.measures_position else
                                    "not detectable: the stage reports only the commanded position")
                self._tare_sensor_in_place()
                self._phase = "home"
                motion.home()
                self._execute_plan(folder.list_missing_replicate_numbers(plan.name, plan.replicates))
        except (StoppedError, DeviceError) as error:
            reason = error.reason if isinstance(error, StoppedError) else StopReason("device", str(error))
            # A full disk must not replace the error that stopped the tool.
            with contextlib.suppress(OSError, InputError):
                folder.record_stop(reason.cause, reason.message, plan.name, self._phase, self._replicate)
            raise
        finally:
            if self._partial is not None:
                self._partial.close()
                self._partial = None
        folder.update_state(state="waiting")

    def _get_retraction_position_and_speed(self) -> tuple[float, float]:
        """Return the position, m, and the speed, m/s, of a retraction after a stop."""
        plan, contact_point = self._plan, self._contact_point
        position = 0.0 if contact_point is None else contact_point - (plan.retract if plan.contact == "force" else 0.0)
        return position, plan.approach_speed

    def _store_samples_and_report_progress(self, samples: Sequence[ForceSample], forces: Sequence[float],
                                           stage: StageSample) -> None:
        """Store the samples of a poll in memory and in the partial file, and call `on_progress`.

        Args:
            samples: new force samples.
            forces: their forces on the tool, N.
            stage: new stage sample.

        Raises:
            StoppedError: the disk refused the samples.
        """
        motion = self._motion
        if self._record is not None:
            positions = self._record.append_poll_and_interpolate_positions(samples, stage)
            if self._partial is not None:
                started, contact_point = self._record.polls[0].middle_time, self._contact_point or 0.0
                self._partial.queue_rows([(sample.received - started, 1e3 * (position - contact_point), force,
                                           self._phase)
                                          for sample, position, force in zip(samples, positions, forces, strict=True)])
                if self._partial.failure is not None:
                    raise StoppedError(StopReason("disk", self._partial.failure))
        depth = stage.position - self._contact_point if self._contact_point is not None else np.nan
        self._deepest = max(self._deepest, depth if self._contact_point is not None else 0.0)
        elapsed = motion.now() - motion.started
        fraction = min(elapsed / self.seconds, 1.0) if self.seconds else 1.0
        self._on_progress(RunProgress(self._plan.name, self._phase, self._replicate, stage.position, depth,
                                      motion.last_force, fraction))

    def _execute_plan(self, missing: Sequence[int]) -> None:
        """Tare, find contact, precondition, and record and save the replicates with these numbers."""
        plan, motion = self._plan, self._motion
        if not missing:
            return
        if plan.contact == "force":
            motion.move_until_arrival_or_condition(min(0.0, self._limits.highest), plan.approach_speed)
        self._tare_sensor_in_place()
        if plan.contact == "force":
            self._approach_withdraw_and_tare()
            if plan.preconditioning or plan.touch == "once":
                self._approach_slowly_and_store_contact_point()
        else:
            self._contact_point = self._last_position
        for cycle in range(plan.preconditioning):
            self._execute_motion_and_log_loading(f"preconditioning {cycle + 1} of {plan.preconditioning}")
        for number in missing:
            self._replicate = number
            self._record_replicate(number)
        self._replicate = 0
        self._move_to_waiting_position()

    @property
    def _last_position(self) -> float:
        """Position of the stage at the last poll, m."""
        assert self._motion.stage_sample is not None
        return self._motion.stage_sample.position

    def _tare_sensor_in_place(self) -> None:
        """Check that the sensor is unloaded at the present position, and tare it."""
        self._phase = "tare"
        self._motion.tare(self._limits.tare, self._plan.contact_force)

    def _approach_withdraw_and_tare(self) -> None:
        """Approach until contact and store the contact point; withdraw, and tare the sensor in this position."""
        self._contact_point = self._lower_until_contact(self._plan.approach_speed)
        self._move_to_waiting_position(2.0)
        self._tare_sensor_in_place()

    def _approach_slowly_and_store_contact_point(self) -> None:
        """Approach slowly, estimate the contact point from the samples, store it, and withdraw.

        Raises:
            StoppedError: the contact point moved by more than half of the retraction height.
        """
        plan, motion = self._plan, self._motion
        self._move_to_waiting_position(2.0)
        record = self._record = MotionRecord()
        speed = _CONTACT_SEARCH.slow_fraction * plan.approach_speed
        try:
            halted = self._lower_until_contact(speed)
        finally:
            self._record = None
        self._contact_point, self._contact_metadata = motion.run_while_polling(
            lambda: estimate_contact_point_and_metadata(record, plan, halted, motion.sensor.channels, speed,
                                                        1.0 / motion.sensor.rate))
        if self._first_contact_point is None:
            self._first_contact_point = self._contact_point
        if abs(self._contact_point - self._first_contact_point) > 0.5 * plan.retract:
            raise StoppedError(StopReason(
                "zero", f"the tool touches the specimen at {self._contact_point * 1e3:.4g} mm; the first contact was "
                        f"at {self._first_contact_point * 1e3:.4g} mm: the stage has lost steps, or the specimen has "
                        "moved"))
        self._move_to_waiting_position()

    def _lower_until_contact(self, speed: float) -> float:
        """Move down at a speed, m/s, until the contact force is reached; return the position, m, after the halt."""
        plan, motion = self._plan, self._motion
        self._phase = "approach"
        if not motion.move_until_arrival_or_condition(self._limits.highest, speed,
                                                      lambda: motion.compute_mean_of_recent_forces(
                                                          _CONTACT_SEARCH.window) >= plan.contact_force):
            raise StoppedError(StopReason(
                "no contact", f"the force did not reach {plan.contact_force:g} N within the limits of the motion; put "
                              "the specimen nearer, or check the sign and the axis of the sensor"))
        motion.discard_stored_forces()
        return self._last_position

    def _move_to_waiting_position(self, factor: float = 1.0) -> None:
        """Move the tool to its waiting position above the contact point; at it for contact ``"here"``.

        Args:
            factor: height above the contact point divided by the retraction height of the plan, 1.
        """
        assert self._contact_point is not None
        # The tool must be free of the specimen here, because the sensor is zeroed in this position.
        above = factor * self._plan.retract if self._plan.contact == "force" else 0.0
        self._motion.move_until_arrival_or_condition(self._contact_point - above, self._plan.approach_speed)

    def _execute_motion_and_log_loading(self, description: str) -> None:
        """Execute the motion of the plan once, recorded or not, and write loading and largest depth into the run file.

        Args:
            description: text of the entry, such as ``"recording 1 of 3"``.
        """
        assert self._contact_point is not None
        plan, motion, contact_point = self._plan, self._motion, self._contact_point
        self._deepest = 0.0
        # Written before the motion: a program that dies during the motion has loaded the specimen.
        entry = self._folder.add_or_update_loading_entry(plan.name, description, plan.largest_depth)
        try:
            motion.move_until_arrival_or_condition(contact_point + plan.start_depth, plan.approach_speed)
            control_force = self._make_force_control()
            for leg in plan.legs:
                self._phase = leg.segment.kind
                if self._record is not None:
                    self._record.legs.append((motion.now(), leg.segment.kind, leg.cycle,
                                              plan.get_largest_speed_of_leg(leg)))
                if leg.control == FORCE:
                    control_force(leg)
                elif leg.speed:
                    motion.move_until_arrival_or_condition(contact_point + leg.end, leg.speed)
                else:
                    motion.poll_for_duration(leg.duration)
        finally:
            with contextlib.suppress(OSError, InputError):
                self._folder.add_or_update_loading_entry(plan.name, description, self._deepest, entry)

    def _make_force_control(self) -> Callable[[MotionLeg], None]:
        """Return a function that executes one segment with prescribed force; the control lasts over all segments."""
        plan, motion, limits, contact_point = self._plan, self._motion, self._plan.force_control, self._contact_point
        if limits is None or contact_point is None:
            return lambda leg: None
        controller = ForceController(limits, self._limits.stiffness)
        guard = ForceControlGuard(limits, plan.contact_force, motion.stage.measures_position)

        def execute_leg(leg: MotionLeg) -> None:
            """Control the force along a line in time."""
            motion.control_force(leg.start, leg.end, leg.duration, controller, guard, contact_point, limits.depth)

        return execute_leg

    def _record_replicate(self, number: int) -> None:
        """Record one replicate with the rest before it, check the zero of the sensor, and save the recording.

        Args:
            number: number of the replicate, from 1.
        """
        plan, motion, folder = self._plan, self._motion, self._folder
        self._phase = "rest"
        self._move_to_waiting_position()
        motion.poll_for_duration(plan.rest)
        self._require_zero_force_above_contact()
        if plan.contact == "force" and plan.touch == "each":
            self._approach_slowly_and_store_contact_point()
            self._phase = "rest"
        name, started = f"{plan.name}_{number}", _format_local_time()
        loadings, stops = folder.count_loadings_of_test(plan.name), folder.list_stops_for_test(plan.name)
        partial = self._partial = folder.create_partial_recording(name,
                                                                  ["time [s]", "displacement [mm]", "force [N]",
                                                                   "segment"])
        record = self._record = MotionRecord()
        try:
            self._execute_motion_and_log_loading(f"recording {number} of {plan.replicates}")
            motion.poll_for_duration(2 * POLLING.period)
        finally:
            self._record = None
        # Lost steps of the motor and a sensor without signal show here; the samples are then not saved as a recording.
        self._phase = "check"
        self._move_to_waiting_position()
        self._require_zero_force_above_contact()
        contact_point, zero, contact_metadata = self._contact_point or 0.0, motion.zero, self._contact_metadata

        def require_contact_and_save_recording() -> None:
            """Build the recording, check that the contact force was reached, and save it; closes the partial file."""
            recording = build_recording(record, plan, contact_point, zero, motion.sensor.channels,
                                        1.0 / motion.sensor.rate)
            if not recording.force.max() >= plan.contact_force:
                raise StoppedError(StopReason(
                    "no contact", f"the force stayed below {plan.contact_force:g} N in a motion to "
                                  f"{plan.largest_depth * 1e3:g} mm: the motor has lost steps, or the sensor "
                                  "does not feel the tool"))
            partial.close()
            folder.save_recording(name, recording.with_metadata(**plan.about, **self._about, **{
                "name": name, "test": plan.name, "replicate": number, "started": started, "ended": _format_local_time(),
                "sensor": motion.sensor.describe(), "stage": motion.stage.describe(), "axis": plan.axis,
                "sign": plan.sign, "zeroed": "above the specimen, before and after this recording"
                if plan.contact == "force" else "with the specimen on the tool, after homing",
                "tares_N": motion.tares, "zero_after_tare_N": zero, "touch_mm": contact_point * 1e3, **contact_metadata,
                "loadings_before": loadings, "stops_before": stops, **recording.metadata}))

        # Saving a long test takes seconds; the devices must be polled during this time.
        motion.run_while_polling(require_contact_and_save_recording)
        self._partial = None

    def _require_zero_force_above_contact(self) -> None:
        """Check the force above the contact point against the contact force; no check for contact ``"here"``."""
        if self._plan.contact == "force":
            self._motion.require_zero_force(self._plan.contact_force)


def _convert_limits_to_json(limits: MotionLimits) -> dict[str, Any]:
    """Return the limits as a JSON object with units in the keys."""
    return {"force_N": limits.force, "lowest_mm": limits.lowest * 1e3, "highest_mm": limits.highest * 1e3,
            "speed_mm_s": limits.speed * 1e3, "duration_s": limits.duration,
            "stiffness_N_per_mm": limits.stiffness * 1e-3, "force_margin_N": limits.force_margin,
            "sensor_silence_s": limits.sensor_silence, "tare_N": limits.tare,
            "on_stop": "retract" if limits.retracts else "stand"}


def _format_local_time() -> str:
    """Return the present local date and time with the offset of the time zone (ISO 8601)."""
    return time.strftime("%Y-%m-%dT%H:%M:%S%z")


#: Name of the file in the folder of the run.
LIVE_FILE = "live.json"
#: Time between two writes of the file, and between two updates of a page that shows the run, s.
UPDATE_INTERVAL = 0.2


class LiveProgressFile:
    """Write the newest progress of a run to ``live.json``, and delete the file at the end.

    A separate thread writes the file: the thread that controls the motor must not wait for a disk.

    Args:
        folder: folder of the run.
    """

    def __init__(self, folder: Path):
        self._path, self._progress = folder / LIVE_FILE, None
        self._ending = threading.Event()

    _progress: RunProgress | None

    def set_progress(self, progress: RunProgress) -> None:
        """Store the progress that the thread writes next, and return without waiting for the disk."""
        self._progress = progress

    @contextmanager
    def run_writing_thread(self) -> Iterator[None]:
        """Run the writing thread inside a ``with`` block; delete the file at the end of the block."""
        thread = threading.Thread(target=self._write_progress_until_end, name="live file", daemon=True)
        thread.start()
        try:
            yield
        finally:
            self._ending.set()
            thread.join()
            self._path.unlink(missing_ok=True)

    def _write_progress_until_end(self) -> None:
        """Write changed progress every `UPDATE_INTERVAL` s until the end of the block; the body of the thread."""
        written = None
        while not self._ending.wait(UPDATE_INTERVAL):
            progress = self._progress
            if progress is not None and progress is not written:
                # A failed display must not end a recording.
                with contextlib.suppress(InputError):
                    write_text(self._path, json.dumps(convert_progress_to_dict(progress)))
                written = progress


def convert_progress_to_dict(progress: RunProgress) -> dict[str, Any]:
    """Return a progress as a JSON object (dict): keys carry units, and unknown (NaN) numbers are omitted."""
    numbers = {"position_mm": 1e3 * progress.position, "depth_mm": 1e3 * progress.depth, "force_N": progress.force,
               "share": progress.fraction}
    return {"test": progress.test, "phase": progress.phase, "replicate": progress.replicate,
            **{key: value for key, value in numbers.items() if math.isfinite(value)}}
