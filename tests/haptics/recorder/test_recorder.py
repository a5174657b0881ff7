"""Runs on a virtual rig: what is recorded, and every fault that ends one."""

import json

import numpy as np
import pytest
from virtual_bench import STIFFNESS, SURFACE, Spring

from haptics.devices.contracts import DeviceError
from haptics.devices.virtual.faults import Faults
from haptics.recorder.guarded_motion import StoppedError
from tissue_sim import Rig, read_recording
from tissue_sim.errors import InputError


def state_of(bench):
    return json.loads((bench.folder / "run.json").read_text(encoding="utf-8"))


def stands_still(bench):
    """Whether the tool stays where it is from now on."""
    before = bench.virtual.stage.tool_position(bench.clock())
    bench.clock.now += 10.0
    return bench.virtual.stage.tool_position(bench.clock()) == before


def test_a_run_records_what_was_planned(bench):
    bench.run()
    state = state_of(bench)
    assert state["state"] == "waiting" and state["done"] == ["spring_1.csv", "spring_2.csv"] and not state["stops"]
    for number in (1, 2):
        recording = read_recording(bench.folder / f"spring_{number}.csv")
        metadata = recording.metadata
        touch = metadata["touch_mm"] * 1e-3
        assert touch == pytest.approx(SURFACE, abs=10e-6)
        assert recording.displacement.max() == pytest.approx(3e-3, abs=2e-6)
        depth = np.maximum(recording.displacement + touch - SURFACE, 0.0)
        # At a corner the stage is up to 5 ms, two looks, behind or before: 2 mm/s and 400 N/m make 4 mN of it.
        np.testing.assert_allclose(recording.force, STIFFNESS * depth, atol=6e-3)
        assert set(recording.labels["segment"]) == {"ramp", "hold", "unload"}
        # A sensor's clock is believed to a thousandth; two or three samples come at each look.
        assert np.median(np.diff(recording.time)) == pytest.approx(1 / 500, rel=1e-3)
        assert metadata["sensor"]["rate_Hz"] == 500.0 and metadata["clock"]["lag"] == "unknown"
        assert metadata["loadings_before"] == number - 1
    assert {moment.phase for moment in bench.moments} == {"home", "tare", "approach", "rest", "ramp", "hold", "unload",
                                                          "check"}


def test_cycles_before_are_done_and_not_recorded(bench):
    bench.run(plan=bench.plan(preconditioning=3, replicates=1))
    assert [entry["what"] for entry in state_of(bench)["history"]] == [
        "preconditioning 1 of 3", "preconditioning 2 of 3", "preconditioning 3 of 3", "recording 1 of 1"]
    assert read_recording(bench.folder / "spring_1.csv").metadata["loadings_before"] == 3


@pytest.mark.parametrize("rig", [Rig(backlash=5e-5), Rig(zero_offset=0.3), Rig(force_noise=2e-3)])
def test_the_rig_is_in_the_numbers(bench, rig):
    bench.run(rig=bench.rig(rig=rig))
    recording = read_recording(bench.folder / "spring_1.csv")
    way_in = recording.labels["segment"] == "ramp"
    back = (recording.labels["segment"] == "unload") & (recording.displacement > 1e-3)
    excess = recording.force - STIFFNESS * recording.displacement
    assert np.median(excess[way_in]) == pytest.approx(0.0, abs=6e-3)
    assert np.median(excess[back]) == pytest.approx(STIFFNESS * rig.backlash, abs=6e-3)


def test_a_sensor_that_reads_less_when_pushed(bench):
    bench.run(plan=bench.plan(sign=-1), sign=-1, channels=("Fx", "Fy", "Fz", "Tx", "Ty", "Tz"))
    recording = read_recording(bench.folder / "spring_1.csv")
    assert recording.force.max() == pytest.approx(1.2, abs=0.02)
    assert recording.channel("Fz").min() == pytest.approx(-1.2, abs=0.02)


def test_a_glued_face_is_not_sought(bench):
    bench.run(plan=bench.plan(contact="here"), surface=0.0)
    recording = read_recording(bench.folder / "spring_2.csv")
    assert recording.metadata["touch_mm"] == 0.0 and recording.force.max() == pytest.approx(1.2, abs=0.01)


class Sticky(Spring):
    """Leaves something on the tool once it was deeper than 2 mm."""

    def __init__(self):
        super().__init__()
        self.left = 0.0

    def force(self, time, depth):
        if depth > 2e-3:
            self.left = 0.2
        return super().force(time, depth) + self.left


STOPS = [
    ("force", {"limits": {"force": 0.8}}, "above the limit of 0.8 N", "ramp"),
    ("sensor saturated", {"reach": 0.9}, "end of its range", "ramp"),
    ("sensor saturated", {"faults": Faults(saturate_after=12.0)}, "end of its range", None),
    ("sensor lost", {"faults": Faults(disconnect_after=12.0)}, "was silent for 0.0", None),
    # In the middle of a long way: the seconds before it depend on how long the contact is looked for.
    ("stage stalled", {"faults": Faults(stall_after=30.0), "plan": {"legs": "ramp 3mm @0.08mm/s; unload"}},
     "behind where it was driven", "ramp"),
    ("zero", {"rig": Sticky}, "where it was zeroed", "check"),
    ("no contact", {"limits": {"highest": 1e-3}, "plan": {"legs": "ramp 1mm @1mm/s; unload"}}, "put the specimen "
                                                                                               "nearer",
     "approach"),
    ("travel", {"limits": {"highest": 4.2e-3}}, "outside of its limits", "ramp"),
    ("duration", {"limits": {"duration": 15.0}}, "longer than its limit of 15 s", None),
]


@pytest.mark.parametrize(("cause", "changes", "said", "phase"), STOPS, ids=lambda value: None)
def test_every_fault_stands_the_stage_and_keeps_the_reason(bench, cause, changes, said, phase):
    changes = dict(changes)
    limits = bench.limits(**changes.pop("limits", {}))
    plan = bench.plan(changes.pop("plan")["legs"]) if "plan" in changes else bench.plan()
    if "rig" in changes:
        changes["rig"] = bench.rig(changes.pop("rig")())
    with pytest.raises(StoppedError, match=said) as caught:
        bench.run(limits=limits, plan=plan, **changes)
    assert caught.value.stop.cause == cause
    stop, = state_of(bench)["stops"]
    assert stop["cause"] == cause and said in stop["message"] and phase in (None, stop["phase"])
    assert state_of(bench)["state"] == "stopped"
    assert stands_still(bench)
    if "rig" not in changes:
        # Halted by the guard itself, before a disconnection halts it, too.
        assert bench.halts and bench.halts[0] < bench.stops[0]
    partial = list(bench.folder.glob("*.partial.csv"))
    if stop["phase"] in ("ramp", "hold", "unload"):
        assert len(read_recording(partial[0])) > 5


def test_a_tool_that_is_driven_and_stands_is_only_seen_by_an_encoder(bench):
    with pytest.raises(StoppedError) as caught:
        bench.run(faults=Faults(stall_after=4.0), encoder=False)
    # No force where there should be one: the way in ends at the limit.
    assert caught.value.stop.cause == "no contact"
    assert state_of(bench)["stall"].startswith("not detectable")


def test_who_asks_is_heard_at_once(bench):
    wishes = iter([None] * 900 + ["stopped at the keyboard"] * 100)
    with pytest.raises(StoppedError, match="stopped at the keyboard"):
        bench.run(asked=lambda: next(wishes))
    assert stands_still(bench) and state_of(bench)["stops"][0]["cause"] == "asked"


@pytest.mark.parametrize(("retracts", "place"), [(True, SURFACE - 1e-3), (False, None)])
def test_it_stands_or_goes_back_as_stated(bench, retracts, place):
    with pytest.raises(StoppedError):
        bench.run(limits=bench.limits(force=0.8, retracts=retracts))
    tool = bench.virtual.stage.tool_position(bench.clock())
    assert tool == pytest.approx(place, abs=2e-5) if retracts else tool > SURFACE + 1e-3


def test_a_stage_that_is_not_believed_does_not_go_back(bench):
    rig = bench.rig()
    goals = bench.goals_of(rig)

    def stall(moment):
        if moment.phase == "ramp" and moment.depth > 1e-3:
            rig.stage._stalls = min(rig.stage._stalls, bench.clock())

    with pytest.raises(StoppedError) as caught:
        bench.run(rig=rig, limits=bench.limits(retracts=True), watch=stall)
    assert caught.value.stop.cause == "stage stalled"
    assert goals[-1] == pytest.approx(SURFACE + 3e-3, abs=2e-5)


class Glued(Spring):
    def force(self, time, depth):
        return self.stiffness * depth


def test_what_is_glued_is_not_pulled_after_a_stop(bench):
    with pytest.raises(StoppedError):
        bench.run(plan=bench.plan(contact="here"), limits=bench.limits(force=0.8, retracts=True),
                  rig=bench.rig(Glued(), surface=0.0, start_at=0.0))
    assert bench.virtual.stage.tool_position(bench.clock()) == pytest.approx(0.0, abs=3e-5)


class Grows(Spring):
    """Pulls harder the further the tool goes back."""

    def __init__(self):
        super().__init__()
        self.deepest = 0.0

    def force(self, time, depth):
        self.deepest = max(self.deepest, depth)
        return super().force(time, depth) - (2e4 * (self.deepest - depth) if self.deepest > 2e-3 else 0.0)


def test_the_way_back_is_watched(bench):
    with pytest.raises(StoppedError, match=r"the tool did not go back \(the force grew to"):
        bench.run(limits=bench.limits(force=0.9, retracts=True), rig=bench.rig(Grows()))
    assert stands_still(bench)


def test_a_wrong_axis_stops_at_the_limit_of_all_forces(bench):
    with pytest.raises(StoppedError, match="in all directions was"):
        bench.run(plan=bench.plan(axis="Fx"), limits=bench.limits(force=1.0), channels=("Fx", "Fy", "Fz"))


def test_who_presses_before_the_tare_is_noticed(bench):
    """The specimen stands so high that the tool touches it at the stage's zero already."""
    with pytest.raises(StoppedError, match="before it is zeroed") as caught:
        bench.run(surface=-1e-3)
    assert caught.value.stop.cause == "zero"


def test_lost_steps_make_no_recording(bench):
    """A motor that stands in the last ramp, and does not know."""
    began = []

    def watch(moment):
        if moment.replicate == 2 and moment.phase == "ramp" and moment.depth > 1e-3 and not began:
            began.append(bench.clock())
            bench.virtual.stage._stalls = bench.clock()

    with pytest.raises(StoppedError, match="above the specimen, where it was zeroed"):
        bench.run(watch=watch, encoder=False)
    assert state_of(bench)["done"] == ["spring_1.csv"]


def test_a_sensor_that_falls_asleep_makes_no_recording(bench):
    class Sleeps(Spring):
        def force(self, time, depth):
            return 0.0 if bench.moments and bench.moments[-1].replicate == 2 else super().force(time, depth)

    with pytest.raises(StoppedError, match="does not feel the tool"):
        bench.run(plan=bench.plan(touch="once"), rig=bench.rig(Sleeps()))
    assert state_of(bench)["done"] == ["spring_1.csv"]


def test_a_touch_that_moves_is_noticed(bench):
    class Sinks(Spring):
        def force(self, time, depth):
            return super().force(time, depth - (8e-4 if bench.moments and bench.moments[-1].replicate == 2 else 0.0))

    with pytest.raises(StoppedError, match="where it touched at"):
        bench.run(rig=bench.rig(Sinks()))


def test_a_stage_that_does_not_take_the_halt_is_said(bench):
    rig = bench.rig()
    stage, halts = rig.stage, []
    rig.stage.halt = lambda: halts.append(1)
    with pytest.raises(StoppedError, match=r"does not stand .*switch it off"):
        bench.run(rig=rig, limits=bench.limits(force=0.8))
    assert halts and stage is rig.stage


def test_a_full_disk_does_not_hide_why_the_tool_stands(bench, monkeypatch):
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


def test_a_killed_run_is_told_in_what_comes_after(bench):
    class Killed(BaseException):
        pass

    def die(moment):
        if moment.phase == "hold":
            raise Killed

    with pytest.raises(StoppedError):
        bench.run(plan=bench.plan(replicates=1), watch=die)
    # As a power cut would have left it.
    state = {**state_of(bench), "state": "running", "stops": []}
    (bench.folder / "run.json").write_text(json.dumps(state), encoding="utf-8")
    bench.run(plan=bench.plan(replicates=1))
    metadata = read_recording(bench.folder / "spring_1.csv").metadata
    assert metadata["loadings_before"] == 1 and metadata["stops_before"][0]["cause"] == "died"


def test_an_error_of_the_program_stands_the_stage(bench):
    def fail(moment):
        if moment.phase == "ramp" and moment.depth > 1e-3:
            raise ZeroDivisionError("a bug")

    with pytest.raises(StoppedError, match="ZeroDivisionError: a bug"):
        bench.run(watch=fail)
    assert stands_still(bench)


class Deaf:
    """A sensor that neither starts nor stops."""

    channels, rate = ("Fz",), 100.0

    def start(self):
        raise DeviceError("no sensor is there; plug it in")

    def stop(self):
        raise RuntimeError("stuck")


def test_one_device_that_fails_does_not_keep_the_other_from_stopping(bench):
    rig = bench.rig()
    stopped = []
    rig.stage.stop = lambda: stopped.append("stage")
    rig.sensor = Deaf()
    with pytest.raises(DeviceError, match="no sensor is there"):
        bench.run(rig=rig)
    assert stopped == ["stage"]


def test_a_late_program_is_noticed_by_another_thread(bench, monkeypatch):
    """The dead man looks at the real clock here: the recorder's own stands still while it looks."""
    import threading

    halted = threading.Event()
    monkeypatch.setattr("haptics.recorder.guarded_motion.DEAD", 0.01)
    rig = bench.rig()
    halt = rig.stage.halt
    rig.stage.halt = lambda: (halt(), halted.set())

    def dawdle(moment):
        if moment.phase == "ramp" and moment.depth > 1e-3:
            halted.clear()
            bench.clock.now += 5.0
            assert halted.wait(60.0)

    with pytest.raises(StoppedError, match="did not look at its devices for") as caught:
        bench.run(rig=rig, watch=dawdle)
    assert caught.value.stop.cause == "program late"


def test_a_run_goes_on_where_it_was_stopped(bench):
    def stop_in_the_second(moment):
        if moment.replicate == 2 and moment.phase == "hold":
            raise KeyboardInterrupt

    with pytest.raises(StoppedError, match="Ctrl-C"):
        bench.run(plan=bench.plan(replicates=3), watch=stop_in_the_second)
    assert state_of(bench)["done"] == ["spring_1.csv"]
    first = (bench.folder / "spring_1.csv").read_bytes()
    bench.run(plan=bench.plan(replicates=3))
    state = state_of(bench)
    assert state["state"] == "waiting" and state["done"] == [f"spring_{number}.csv" for number in (1, 2, 3)]
    assert (bench.folder / "spring_1.csv").read_bytes() == first
    metadata = read_recording(bench.folder / "spring_2.csv").metadata
    assert metadata["stops_before"][0]["cause"] == "asked" and metadata["loadings_before"] >= 1
    # What the stop cut off is kept beside it, and is no recording of the run.
    assert [path.name for path in bench.folder.glob("*.stopped_1.csv")] == ["spring_2.stopped_1.csv"]


def test_a_folder_holds_one_run(bench):
    bench.run()
    with pytest.raises(InputError, match="belongs to a run with another protocol"):
        bench.run(digest="b")


def test_a_folder_with_other_files_is_left_alone(bench):
    bench.folder.mkdir()
    (bench.folder / "thesis.tex").write_text("x", encoding="utf-8")
    with pytest.raises(InputError, match="choose an empty folder"):
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
def test_what_would_pass_a_limit_is_refused_before_anything_moves(bench, limits, plan, field):
    with pytest.raises(InputError) as caught:
        bench.run(limits=bench.limits(**limits), plan=bench.plan(**plan))
    assert caught.value.field == field and not (bench.folder / "run.json").exists()


@pytest.mark.parametrize("name", ["force", "speed", "duration", "stiffness", "force_margin", "sensor_silence"])
def test_limits_cannot_be_switched_off(bench, name):
    for value in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(InputError) as caught:
            bench.limits(**{name: value})
        assert caught.value.field == f"limits.{name}"
