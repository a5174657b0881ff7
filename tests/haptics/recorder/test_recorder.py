"""`Recorder` on a virtual rig: the recordings of a run, and each fault that stops it."""

import json

import numpy as np
import pytest
from virtual_bench import STIFFNESS, SURFACE, Spring

from haptics.devices.contracts import DeviceError
from haptics.devices.virtual.faults import Faults
from haptics.recorder.guarded_motion import StoppedError
from haptics.recorder.plan import PollSettings
from haptics.safety.motion_guard import MotionGuardSettings
from tissue_sim import Rig, read_recording
from tissue_sim.errors import InputError


def state_of(bench):
    return json.loads((bench.folder / "run.json").read_text(encoding="utf-8"))


def stands_still(bench):
    """Return whether the tool does not move during the next 10 s."""
    before = bench.virtual.stage.compute_tool_position_with_stall(bench.clock())
    bench.clock.now += 10.0
    return bench.virtual.stage.compute_tool_position_with_stall(bench.clock()) == before


def test_settings_of_the_guard_act_on_the_run_and_are_recorded(bench):
    # The stage starts with a delay, which is a stall if there is no tolerance.
    changed = {"stall_time": 1e-9, "stall_distance": 1e-12}
    with pytest.raises(StoppedError, match="behind its commanded position"):
        bench.run(guard_settings=MotionGuardSettings(**changed), encoder=True)
    assert state_of(bench)["guard_settings"] == changed


def test_a_run_records_the_plan(bench):
    bench.run()
    state = state_of(bench)
    assert state["state"] == "waiting" and state["done"] == ["spring_1.csv", "spring_2.csv"] and not state["stops"]
    limits = {"force_N": 5.0, "lowest_mm": -5.0, "highest_mm": 10.0, "speed_mm_s": 5.0, "stiffness_N_per_mm": 1.0,
              "duration_s": 600.0}
    assert state["guard_settings"] == {}
    assert {name: state["limits"][name] for name in limits} == pytest.approx(limits)
    for number in (1, 2):
        recording = read_recording(bench.folder / f"spring_{number}.csv")
        metadata = recording.metadata
        assert "left_out" not in metadata
        touch = metadata["touch_mm"] * 1e-3
        assert touch == pytest.approx(SURFACE, abs=10e-6)
        assert recording.displacement.max() == pytest.approx(3e-3, abs=2e-6)
        depth = np.maximum(recording.displacement + touch - SURFACE, 0.0)
        # At a corner the interpolated position is up to 5 ms late, two polls: 4 mN at 2 mm/s and 400 N/m.
        np.testing.assert_allclose(recording.force, STIFFNESS * depth, atol=6e-3)
        assert set(recording.labels["segment"]) == {"ramp", "hold", "unload"}
        # The stated rate is changed by at most a thousandth; two or three samples arrive at each poll.
        assert np.median(np.diff(recording.time)) == pytest.approx(1 / 500, rel=1e-3)
        assert metadata["sensor"]["rate_Hz"] == 500.0 and metadata["clock"]["lag"] == "unknown"
        assert metadata["loadings_before"] == number - 1
    assert {moment.phase for moment in bench.moments} == {"home", "tare", "approach", "rest", "ramp", "hold", "unload",
                                                          "check"}


@pytest.mark.slow
def test_preconditioning_cycles_are_executed_and_not_recorded(bench):
    bench.run(plan=bench.plan(preconditioning=3, replicates=1))
    assert [entry["what"] for entry in state_of(bench)["history"]] == [
        "preconditioning 1 of 3", "preconditioning 2 of 3", "preconditioning 3 of 3", "recording 1 of 1"]
    assert read_recording(bench.folder / "spring_1.csv").metadata["loadings_before"] == 3


@pytest.mark.slow
@pytest.mark.parametrize("rig", [Rig(backlash=5e-5), Rig(zero_offset=0.3), Rig(force_noise=2e-3)])
def test_recordings_contain_the_errors_of_the_rig(bench, rig):
    bench.run(rig=bench.rig(rig=rig))
    recording = read_recording(bench.folder / "spring_1.csv")
    loading = recording.labels["segment"] == "ramp"
    unloading = (recording.labels["segment"] == "unload") & (recording.displacement > 1e-3)
    excess = recording.force - STIFFNESS * recording.displacement
    assert np.median(excess[loading]) == pytest.approx(0.0, abs=6e-3)
    assert np.median(excess[unloading]) == pytest.approx(STIFFNESS * rig.backlash, abs=6e-3)


@pytest.mark.slow
def test_a_sensor_with_negative_sign(bench):
    bench.run(plan=bench.plan(sign=-1), sign=-1, channels=("Fx", "Fy", "Fz", "Tx", "Ty", "Tz"))
    recording = read_recording(bench.folder / "spring_1.csv")
    assert recording.force.max() == pytest.approx(1.2, abs=0.02)
    assert recording.channel("Fz").min() == pytest.approx(-1.2, abs=0.02)


def test_contact_here_uses_the_position_after_homing(bench):
    bench.run(plan=bench.plan(contact="here"), surface=0.0)
    recording = read_recording(bench.folder / "spring_2.csv")
    assert recording.metadata["touch_mm"] == 0.0 and recording.force.max() == pytest.approx(1.2, abs=0.01)


class StickySpring(Spring):
    """Leaves a force of 0.2 N on the tool after a depth of more than 2 mm."""

    def __init__(self):
        super().__init__()
        self.residue = 0.0

    def advance_and_get_force(self, time, depth):
        if depth > 2e-3:
            self.residue = 0.2
        return super().advance_and_get_force(time, depth) + self.residue


STOPS = [
    ("force", {"limits": {"force": 0.8}}, "above the limit of 0.8 N", "ramp"),
    ("sensor saturated", {"reach": 0.9}, "end of its range", "ramp"),
    ("sensor saturated", {"faults": Faults(saturate_after=12.0)}, "end of its range", None),
    ("sensor lost", {"faults": Faults(disconnect_after=12.0)}, "was silent for 0.0", None),
    # In the middle of a slow ramp: the time before it depends on the duration of the search for contact.
    ("stage stalled", {"faults": Faults(stall_after=30.0), "plan": {"legs": "ramp 3mm @0.08mm/s; unload"}},
     "behind its commanded position", "ramp"),
    ("zero", {"rig": StickySpring}, "where it was zeroed", "check"),
    ("no contact", {"limits": {"highest": 1e-3}, "plan": {"legs": "ramp 1mm @1mm/s; unload"}}, "put the specimen "
     "nearer",
     "approach"),
    ("travel", {"limits": {"highest": 4.2e-3}}, "outside of its limits", "ramp"),
    ("duration", {"limits": {"duration": 15.0}}, "longer than its limit of 15 s", None),
]


@pytest.mark.slow
@pytest.mark.parametrize(("cause", "changes", "message", "phase"), STOPS, ids=lambda value: None)
def test_each_fault_stops_the_stage_and_records_the_reason(bench, cause, changes, message, phase):
    changes = dict(changes)
    limits = bench.limits(**changes.pop("limits", {}))
    plan = bench.plan(changes.pop("plan")["legs"]) if "plan" in changes else bench.plan()
    if "rig" in changes:
        changes["rig"] = bench.rig(changes.pop("rig")())
    with pytest.raises(StoppedError, match=message) as caught:
        bench.run(limits=limits, plan=plan, **changes)
    assert caught.value.reason.cause == cause
    stop, = state_of(bench)["stops"]
    assert stop["cause"] == cause and message in stop["message"] and phase in (None, stop["phase"])
    assert state_of(bench)["state"] == "stopped"
    assert stands_still(bench)
    if "rig" not in changes:
        # The guard halts the stage before the disconnection does.
        assert bench.halts and bench.halts[0] < bench.stops[0]
    partial = list(bench.folder.glob("*.partial.csv"))
    if stop["phase"] in ("ramp", "hold", "unload"):
        assert len(read_recording(partial[0])) > 5


@pytest.mark.slow
def test_a_stall_without_encoder_ends_without_contact(bench):
    with pytest.raises(StoppedError) as caught:
        bench.run(faults=Faults(stall_after=4.0), encoder=False)
    # The stalled tool does not touch the specimen, so the approach ends at the limit.
    assert caught.value.reason.cause == "no contact"
    assert state_of(bench)["stall"].startswith("not detectable")


def test_a_stop_request_stops_at_once(bench):
    requests = iter([None] * 900 + ["stopped at the keyboard"] * 100)
    with pytest.raises(StoppedError, match="stopped at the keyboard"):
        bench.run(stop_request=lambda: next(requests))
    assert stands_still(bench) and state_of(bench)["stops"][0]["cause"] == "asked"


@pytest.mark.parametrize(("retracts", "position"), [(True, SURFACE - 1e-3), (False, None)])
def test_the_tool_stays_or_retracts_after_a_stop(bench, retracts, position):
    with pytest.raises(StoppedError):
        bench.run(limits=bench.limits(force=0.8, retracts=retracts))
    tool = bench.virtual.stage.compute_tool_position_with_stall(bench.clock())
    assert tool == pytest.approx(position, abs=2e-5) if retracts else tool > SURFACE + 1e-3


def test_a_stalled_stage_does_not_retract(bench):
    rig = bench.rig()
    goals = bench.goals_of(rig)

    def stall(moment):
        if moment.phase == "ramp" and moment.depth > 1e-3:
            rig.stage._stalls = min(rig.stage._stalls, bench.clock())

    with pytest.raises(StoppedError) as caught:
        bench.run(rig=rig, limits=bench.limits(retracts=True), on_progress=stall)
    assert caught.value.reason.cause == "stage stalled"
    assert goals[-1] == pytest.approx(SURFACE + 3e-3, abs=2e-5)


class BilateralSpring(Spring):
    """Also pulls at negative depths, as a specimen that is glued to the tool."""

    def advance_and_get_force(self, time, depth):
        return self.stiffness * depth


def test_a_glued_specimen_is_not_pulled_after_a_stop(bench):
    with pytest.raises(StoppedError):
        bench.run(plan=bench.plan(contact="here"), limits=bench.limits(force=0.8, retracts=True),
                  rig=bench.rig(BilateralSpring(), surface=0.0, start_at=0.0))
    assert bench.virtual.stage.compute_tool_position_with_stall(bench.clock()) == pytest.approx(0.0, abs=3e-5)


class PullingSpring(Spring):
    """Pulls with a force that grows during the retraction."""

    def __init__(self):
        super().__init__()
        self.deepest = 0.0

    def advance_and_get_force(self, time, depth):
        self.deepest = max(self.deepest, depth)
        return super().advance_and_get_force(time,
                                             depth) - (2e4 * (self.deepest - depth) if self.deepest > 2e-3 else 0.0)


def test_the_force_is_checked_during_retraction(bench):
    with pytest.raises(StoppedError, match=r"the tool was not retracted \(the force grew to"):
        bench.run(limits=bench.limits(force=0.9, retracts=True), rig=bench.rig(PullingSpring()))
    assert stands_still(bench)


def test_with_a_wrong_axis_the_resultant_force_stops_the_motion(bench):
    with pytest.raises(StoppedError, match="in all directions was"):
        bench.run(plan=bench.plan(axis="Fx"), limits=bench.limits(force=1.0), channels=("Fx", "Fy", "Fz"))


def test_a_load_before_the_tare_is_detected(bench):
    """The specimen is so high that the tool touches it at the zero of the stage."""
    with pytest.raises(StoppedError, match="before it is zeroed") as caught:
        bench.run(surface=-1e-3)
    assert caught.value.reason.cause == "zero"


def test_no_recording_is_saved_after_lost_steps(bench):
    """The motor stalls undetected in the last ramp."""
    began = []

    def watch(moment):
        if moment.replicate == 2 and moment.phase == "ramp" and moment.depth > 1e-3 and not began:
            began.append(bench.clock())
            bench.virtual.stage._stalls = bench.clock()

    with pytest.raises(StoppedError, match="above the specimen, where it was zeroed"):
        bench.run(on_progress=watch, encoder=False)
    assert state_of(bench)["done"] == ["spring_1.csv"]


def test_no_recording_is_saved_without_sensor_signal(bench):
    class FadingSpring(Spring):
        def advance_and_get_force(self, time, depth):
            if bench.moments and bench.moments[-1].replicate == 2:
                return 0.0
            return super().advance_and_get_force(time, depth)

    with pytest.raises(StoppedError, match="does not feel the tool"):
        bench.run(plan=bench.plan(touch="once"), rig=bench.rig(FadingSpring()))
    assert state_of(bench)["done"] == ["spring_1.csv"]


def test_a_shifted_contact_point_is_detected(bench):
    class SinkingSpring(Spring):
        def advance_and_get_force(self, time, depth):
            return super().advance_and_get_force(time,
                                                 depth
                                                 - (8e-4 if bench.moments and bench.moments[-1].replicate == 2
                                                    else 0.0))

    with pytest.raises(StoppedError, match="the first contact was at"):
        bench.run(rig=bench.rig(SinkingSpring()))


def test_a_stage_that_ignores_the_halt_is_reported(bench):
    rig = bench.rig()
    stage, halts = rig.stage, []
    rig.stage.halt = lambda: halts.append(1)
    with pytest.raises(StoppedError, match=r"does not stop .*switch it off"):
        bench.run(rig=rig, limits=bench.limits(force=0.8))
    assert halts and stage is rig.stage


def test_a_full_disk_does_not_hide_the_reason_of_the_stop(bench, monkeypatch):
    from haptics.recorder import run_folder

    write = run_folder.write_text

    def full(path, text):
        if '"ramp' in text or "recording 1" in text:
            raise OSError(28, "No space left on device")
        return write(path, text)

    with pytest.raises(StoppedError, match=r"limit of 0.8 N|No space left"):
        monkeypatch.setattr(run_folder, "write_text", full)
        bench.run(limits=bench.limits(force=0.8))
    assert stands_still(bench)


def test_a_killed_run_is_recorded_by_the_next_one(bench):
    class Killed(BaseException):
        pass

    def die(moment):
        if moment.phase == "hold":
            raise Killed

    with pytest.raises(StoppedError):
        bench.run(plan=bench.plan(replicates=1), on_progress=die)
    # The state that a power failure leaves.
    state = {**state_of(bench), "state": "running", "stops": []}
    (bench.folder / "run.json").write_text(json.dumps(state), encoding="utf-8")
    bench.run(plan=bench.plan(replicates=1))
    metadata = read_recording(bench.folder / "spring_1.csv").metadata
    assert metadata["loadings_before"] == 1 and metadata["stops_before"][0]["cause"] == "died"


def test_a_program_error_stops_the_stage(bench):
    def fail(moment):
        if moment.phase == "ramp" and moment.depth > 1e-3:
            raise ZeroDivisionError("a bug")

    with pytest.raises(StoppedError, match="ZeroDivisionError: a bug"):
        bench.run(on_progress=fail)
    assert stands_still(bench)


class BrokenSensor:
    """Sensor that fails to start and to stop."""

    channels = ("Fz",)
    rate = 100.0

    def start(self):
        raise DeviceError("no sensor is there; plug it in")

    def stop(self):
        raise RuntimeError("stuck")


def test_a_broken_sensor_does_not_prevent_the_stage_from_stopping(bench):
    rig = bench.rig()
    stopped = []
    rig.stage.stop = lambda: stopped.append("stage")
    rig.sensor = BrokenSensor()
    with pytest.raises(DeviceError, match="no sensor is there"):
        bench.run(rig=rig)
    assert stopped == ["stage"]


def test_a_late_poll_is_detected_by_another_thread(bench, monkeypatch):
    """The watching thread waits in real time; the simulated clock jumps by 5 s in one poll."""
    import threading

    halted = threading.Event()
    monkeypatch.setattr("haptics.recorder.guarded_motion.POLLING", PollSettings(timeout=0.01))
    rig = bench.rig()
    halt = rig.stage.halt
    rig.stage.halt = lambda: (halt(), halted.set())

    def delay_poll(moment):
        if moment.phase == "ramp" and moment.depth > 1e-3:
            halted.clear()
            bench.clock.now += 5.0
            assert halted.wait(60.0)

    with pytest.raises(StoppedError, match="did not poll its devices for") as caught:
        bench.run(rig=rig, on_progress=delay_poll)
    assert caught.value.reason.cause == "program late"


@pytest.mark.slow
def test_a_stopped_run_continues_with_the_missing_recordings(bench):
    def stop_in_the_second(moment):
        if moment.replicate == 2 and moment.phase == "hold":
            raise KeyboardInterrupt

    with pytest.raises(StoppedError, match="Ctrl-C"):
        bench.run(plan=bench.plan(replicates=3), on_progress=stop_in_the_second)
    assert state_of(bench)["done"] == ["spring_1.csv"]
    first = (bench.folder / "spring_1.csv").read_bytes()
    bench.run(plan=bench.plan(replicates=3))
    state = state_of(bench)
    assert state["state"] == "waiting" and state["done"] == [f"spring_{number}.csv" for number in (1, 2, 3)]
    assert (bench.folder / "spring_1.csv").read_bytes() == first
    metadata = read_recording(bench.folder / "spring_2.csv").metadata
    assert metadata["stops_before"][0]["cause"] == "asked" and metadata["loadings_before"] >= 1
    # The interrupted recording is kept under another name and is not part of the run.
    assert [path.name for path in bench.folder.glob("*.stopped_1.csv")] == ["spring_2.stopped_1.csv"]


def test_a_folder_holds_one_run(bench):
    bench.run()
    with pytest.raises(InputError, match="belongs to a run with another protocol"):
        bench.run(digest="b")


def test_a_folder_with_other_files_is_refused(bench):
    bench.folder.mkdir()
    (bench.folder / "thesis.tex").write_text("x", encoding="utf-8")
    with pytest.raises(InputError, match="Choose an empty folder"):
        bench.run()
    assert [path.name for path in bench.folder.iterdir()] == ["thesis.tex"]


def test_two_programs_do_not_share_a_folder(bench):
    from haptics.recorder.run_folder import RunFolder

    bench.run()
    with RunFolder(bench.folder, "a"), pytest.raises(InputError, match="another program records into this folder"):
        bench.run()


@pytest.mark.parametrize(("limits", "plan", "field"), [
    ({"speed": 1e-3}, {}, "spring.protocol"), ({"highest": 2e-3, "lowest": -1e-3}, {}, "spring.protocol"),
    ({"force_margin": 0.01}, {}, "limits.force_margin"), ({"duration": 5.0}, {}, "limits.duration"),
    ({"highest": 0.5}, {}, "limits"), ({}, {"axis": "Fy"}, "record.axis"),
    ({}, {"approach_speed": 8e-3}, "record.approach_speed"),
])
def test_a_plan_beyond_the_limits_is_refused_before_any_motion(bench, limits, plan, field):
    with pytest.raises(InputError) as caught:
        bench.run(limits=bench.limits(**limits), plan=bench.plan(**plan))
    assert caught.value.field == field and not (bench.folder / "run.json").exists()


@pytest.mark.parametrize("name", ["force", "speed", "duration", "stiffness", "force_margin", "sensor_silence"])
def test_limits_cannot_be_switched_off(bench, name):
    for value in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(InputError) as caught:
            bench.limits(**{name: value})
        assert caught.value.field == f"limits.{name}"
