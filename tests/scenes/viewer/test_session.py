"""Session without a browser: commands change simulation and curves, or are refused with a message."""

import math
import multiprocessing
import os
import signal
import socket
import threading
from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from haptics.devices.back_ends import make_haptic_device
from haptics.devices.motions import TargetFollowingMotion
from haptics.devices.virtual.hand import VirtualHand
from haptics.loop.loop import LoopSettings
from haptics.loop.ring import PAUSED, RingReader
from scenes.viewer.calibration_run import CALIBRATION_COMMANDS
from scenes.viewer.frame import FRAMES, NullViewer, Phase
from scenes.viewer.measurement import (
    build_measurement_from_replicates,
    compute_force_residual,
    make_first_cycle_motion_protocol,
)
from scenes.viewer.scene import CLEARANCE
from scenes.viewer.session import COMMANDS, STEP_TIME, Session
from tissue_sim.errors import ConvergenceError
from tissue_sim.parameters import with_values

#: Slow enough for the mass of the tissue not to count.
SPEED = 4.9e-3
TEST = "ramp 2mm; hold 0.2s; unload"
NO_REPLY = object()
#: A tick each 4 ms: what is shown is the same as of one each millisecond, for a quarter of the work.
LOOP = LoopSettings(period=4e-3, snapshot_rate=30.0, real_time=False)
#: Of the loop, the curves, and what they are compared with, however fast the computer is.
MESH = "realtime_35"


@pytest.fixture(scope="module")
def measured(needle):
    """Needle scene with a measurement of a stiffer specimen."""
    model = replace(needle.model, material=with_values(needle.material, {"C10": 1700.0}),
                    experiment=replace(needle.experiment, protocol=ts.Protocol.parse(TEST, 21, SPEED)))
    recording = ts.simulate(model, resolution=MESH)
    return replace(needle, measurements={"needle_indentation": build_measurement_from_replicates([recording])})


@pytest.fixture(scope="module")
def opened(measured, until):
    before = set(multiprocessing.active_children())
    session = Session(measured, settings=LOOP, resolution=MESH, curve_resolution=MESH)
    try:
        until(session.update_and_make_frame,
              lambda frame: frame.readouts is not None and frame.curves.residual is not None)
        yield session
    finally:
        session.close()
    assert set(multiprocessing.active_children()) <= before, "no process is left behind"


@pytest.fixture
def session(opened, measured):
    """Session reset to the undeformed surface and the first material."""
    replies = [done(opened, "reset"), done(opened, "keep_curve"),
               done(opened, "set_parameters", values=dict(measured.material.parameters))]
    assert replies == [None, None, None]
    return opened


def done(session, command, **values):
    """Post a command, take one frame, and return the reply."""
    replies = [NO_REPLY]
    session.post(command, reply=lambda problem: replies.append(problem), **values)
    session.update_and_make_frame()
    assert len(replies) < 3
    return replies[-1]


def at_rest(depth):
    return lambda frame: (frame.readouts is not None and abs(frame.readouts.depth - depth) < 1e-8
                          and abs(frame.snapshot.depth - depth) < 1e-8)


def curve_of(material, measured):
    """Simulate the whole test with another material, for comparison with the plots."""
    model = ts.Model(replace(measured.experiment, protocol=make_first_cycle_motion_protocol(measured.measurement)),
                     material)
    return ts.simulate(model, resolution=MESH)


@pytest.mark.slow
def test_aim_moves_the_tool(session, needle, until):
    assert done(session, "aim", depth=2e-3) is None
    frame = until(session.update_and_make_frame, at_rest(2e-3))
    assert (frame.phase, frame.message, frame.motion, frame.target) == (Phase.RUNNING, "running", "hand", 2e-3)
    expected = ts.simulate(needle.model, resolution=MESH)
    assert frame.readouts.force == pytest.approx(np.interp(2e-3, expected.displacement, expected.force), rel=0.01)
    assert frame.curves.trace.depth[-1] == pytest.approx(2e-3, abs=2e-5), "and it was drawn"


@pytest.mark.slow
def test_aim_is_limited_to_the_range_of_the_scene(session):
    for wish, target in ((1.0, 4e-3), (-1.0, -CLEARANCE), (1e-3, 1e-3)):
        assert done(session, "aim", depth=wish) is None
        assert session.update_and_make_frame().target == target
    assert "depth: the target depth must be a finite number" in done(session, "aim", depth=math.nan)
    assert session.update_and_make_frame().target == 1e-3, "a refused command changes nothing"


@pytest.mark.slow
def test_a_played_protocol_gives_the_curve_of_the_test(session, needle, until):
    assert done(session, "play", text=TEST, speed=SPEED) is None
    assert session.update_and_make_frame().motion == "protocol"
    duration = 2 * 2e-3 / SPEED + 0.2

    def over(frame):
        trace = frame.curves.trace
        return len(trace) > 2 and trace.time[-1] - trace.time[0] > duration + 0.05

    trace = until(session.update_and_make_frame, over).curves.trace
    load, unload = trace.get_newest_loading_and_unloading()
    # A machine with much else to do misses ticks: a branch begins and ends as far off as the tool goes meanwhile.
    gap = np.diff(trace.time).max()
    missed = SPEED * gap
    assert (load.depth[0], load.depth[-1], unload.depth[-1]) == pytest.approx((0.0, 2e-3, 0.0), abs=3e-5 + missed)
    below = trace.time[trace.depth > 1.9e-3]
    # Samples at either end of the hold may be missing, none is there that was not made.
    holds = 0.2 + 2 * 0.1e-3 / SPEED
    assert holds - 2 * gap - 0.05 < np.ptp(below) < holds + 0.05, "it holds"
    model = replace(needle.model, experiment=replace(needle.experiment, protocol=ts.Protocol.parse(TEST, 41, SPEED)))
    expected = ts.simulate(model, resolution=MESH)
    way_in, top = slice(0, 41), expected.force.max()
    for branch in (load, unload):
        there = np.interp(branch.depth, expected.displacement[way_in], expected.force[way_in])
        assert np.abs(branch.force - there)[~branch.is_late].max() <= 0.01 * top
    assert top > 0.3


@pytest.mark.parametrize(("text", "expected"), [
    ("ramp 9mm", "protocol: must have a depth of at most 4 mm"),
    ("ramp 2", "protocol: column"),
    ("ramp 1N @1N/s", "protocol: must prescribe displacements for the viewer; got a prescribed force"),
    ("", "protocol"),
])
def test_an_invalid_protocol_is_refused(session, text, expected):
    problem = done(session, "play", text=text)
    assert problem.startswith(expected) and "\n" not in problem
    assert "it ends 2 mm from it" in done(session, "play", text="ramp 2mm", repeat=True)
    assert session.update_and_make_frame().motion == "hand"


def test_aim_during_a_protocol_starts_at_the_position_of_the_tool(session, until):
    """The session knows a position that is one frame old; starting there would be a jump of 0.4 mm in 1 ms."""
    assert done(session, "play", text="ramp 4mm", speed=8e-3) is None
    frame = until(session.update_and_make_frame, lambda frame: frame.readouts.depth > 0.5e-3)
    with RingReader(session.simulation.haptic_loop_process.ring_path) as ring:
        begin = ring.written_count
        # The tool moves before the next frame.
        until(ring.latest, lambda tick: tick["tool_depth"] > frame.readouts.depth + 0.1e-3)
        assert done(session, "aim", depth=4e-3) is None
        until(ring.latest, lambda tick: abs(tick["tool_depth"] - 4e-3) < 1e-6)
        depths = ring.read_ticks_after(begin).records["tool_depth"]
    assert frame.readouts.depth < depths[0] and np.diff(depths).min() >= -1e-9


def stands_below(depth):
    return lambda tick: tick["flags"] & PAUSED and tick["tool_depth"] > depth


def test_pause_stops_the_tool_and_step_advances_it(session, until):
    assert done(session, "play", text="ramp 4mm", speed=4e-3) is None
    until(session.update_and_make_frame, lambda frame: frame.readouts.depth > 0.2e-3 and len(frame.curves.trace))
    assert done(session, "pause") is None
    with RingReader(session.simulation.haptic_loop_process.ring_path) as ring:
        begin = ring.written_count
        before = until(ring.latest, lambda tick: tick["flags"] & PAUSED)
        assert session.update_and_make_frame().phase is Phase.PAUSED
        for _ in range(2):
            assert done(session, "step") is None
            after = until(ring.latest, stands_below(before["tool_depth"]))
            ticks = ring.read_ticks_after(begin).records
            passed = np.diff(ticks["time"])[ticks["flags"][1:] & PAUSED == 0]
            assert STEP_TIME - 1e-9 <= passed.sum() <= STEP_TIME + passed[-1]
            assert after["tool_depth"] - before["tool_depth"] == pytest.approx(4e-3 * STEP_TIME, rel=1e-4)
            before, begin = after, ring.written_count
        frame = until(session.update_and_make_frame, lambda frame: frame.readouts.time > after["time"] + 0.05)
        assert frame.phase is Phase.PAUSED and frame.readouts.depth == after["tool_depth"]
    assert done(session, "resume") is None
    frame = until(session.update_and_make_frame, lambda frame: frame.readouts.depth > after["tool_depth"] + 0.2e-3)
    assert frame.phase is Phase.RUNNING


def test_a_step_pauses_first(session, until):
    assert done(session, "play", text="ramp 4mm", speed=4e-3) is None
    assert done(session, "step") is None
    assert session.update_and_make_frame().phase is Phase.PAUSED
    assert done(session, "play", text="ramp 1mm", speed=20e-3) is None, "playing resumes a paused motion"
    assert session.update_and_make_frame().phase is Phase.RUNNING
    until(session.update_and_make_frame, at_rest(1e-3))


def test_reset_clears_trace_and_deformation(session, until):
    done(session, "aim", depth=3e-3)
    until(session.update_and_make_frame, lambda frame: frame.readouts.depth > 1e-3 and len(frame.curves.trace) > 3)
    number = session.update_and_make_frame().curves.number
    assert done(session, "reset") is None
    frame = until(session.update_and_make_frame,
                  lambda frame: frame.readouts.depth == 0.0 and frame.curves.number != number)
    assert (frame.motion, frame.target) == ("hand", 0.0)
    frame = until(session.update_and_make_frame, lambda frame: len(frame.curves.trace) and frame.snapshot.depth == 0.0)
    assert frame.curves.trace.depth.max() == 0.0 and frame.readouts.force == pytest.approx(0.0, abs=1e-9)


@pytest.mark.slow
def test_replay_repeats_the_measured_motion(session, measured, until):
    assert done(session, "replay") is None
    way = make_first_cycle_motion_protocol(measured.measurement)

    def over(frame):
        trace = frame.curves.trace
        return len(trace) > 2 and trace.time[-1] - trace.time[0] > way.time[-1] - way.time[0]

    frame = until(session.update_and_make_frame, over)
    trace = frame.curves.trace
    assert frame.motion == "recording" and trace.depth.max() == pytest.approx(2e-3, abs=2e-5)
    load, _ = trace.get_newest_loading_and_unloading()
    top = np.argmax(way.displacement) + 1
    # The first tick of the motion is not marked; on the loading each tick gives the time of the start.
    rising = (load.depth > 2e-4) & (load.depth < 1.8e-3)
    late = np.median(load.time[rising] - np.interp(load.depth[rising], way.displacement[:top], way.time[:top]))
    moments = trace.time - late
    # A busy computer leaves ticks out; those that there are must lie on the motion.
    inside = (moments >= way.time[0]) & (moments <= way.time[-1])
    assert np.count_nonzero(inside) >= 9
    np.testing.assert_allclose(trace.depth[inside], np.interp(moments[inside], way.time, way.displacement), atol=1e-4)
    expected = curve_of(measured.material, measured)
    there = np.interp(load.depth, *(each[: np.argmax(expected.displacement) + 1]
                                    for each in (expected.displacement, expected.force)))
    assert np.abs(load.force - there)[~load.is_late].max() <= 0.01 * expected.force.max()


def test_a_parameter_changes_force_curve_and_residual(session, measured, until):
    done(session, "aim", depth=2e-3)
    before = until(session.update_and_make_frame, lambda frame: at_rest(2e-3)(frame) and frame.message == "running")
    stiffer = with_values(measured.material, {"C10": 1700.0})
    assert done(session, "set_parameters", values={"C10": 1700.0}) is None
    expected = curve_of(stiffer, measured)
    frame = until(session.update_and_make_frame,
                  lambda frame: at_rest(2e-3)(frame) and frame.readouts.force > before.readouts.force
                  and frame.curves.model.force[-1] != before.curves.model.force[-1]
                  and frame.curves.model.force.max() == pytest.approx(expected.force.max(), rel=1e-9)
                  and frame.snapshot.fields.material == frame.scene.material)
    np.testing.assert_allclose(frame.curves.model.force, expected.force, rtol=1e-9, atol=1e-12)
    assert frame.curves.residual.rmse == pytest.approx(compute_force_residual(expected, measured.measurement).rmse,
                                                       rel=1e-6)
    assert frame.curves.residual.rmse < 0.1 * before.curves.residual.rmse, "the measurement is of this material"
    assert frame.scene.material.parameters["C10"] == 1700.0
    felt = np.interp(2e-3, *(each[: np.argmax(expected.displacement) + 1]
                             for each in (expected.displacement, expected.force)))
    assert frame.readouts.force == pytest.approx(felt, rel=0.01)


def test_a_refused_parameter_changes_nothing(session, until):
    done(session, "aim", depth=1e-3)
    before = until(session.update_and_make_frame, lambda frame: at_rest(1e-3)(frame) and not session._curve.is_busy
                   and frame.curves.model is session._curve.recording)
    for values, expected in (({"C10": -1.0}, "must give a positive shear modulus"), ({"C77": 1.0}, "C77"),
                             ({"C10": 1500.0, "C20": math.nan}, "C20")):
        assert expected in done(session, "set_parameters", values=values)
    time = before.readouts.time
    frame = until(session.update_and_make_frame, lambda frame: frame.readouts.time > time + 0.1)
    assert frame.scene is before.scene and frame.curves.model is before.curves.model
    assert frame.curves.residual is before.curves.residual and not session._curve.is_busy
    assert frame.readouts.force == pytest.approx(before.readouts.force, rel=1e-4)


@pytest.mark.slow
def test_an_unusable_material_is_refused_without_a_running_simulation(session, measured, until):
    os.kill(session.simulation.haptic_loop_process.pid, signal.SIGKILL)
    before = until(session.update_and_make_frame, lambda frame: frame.phase is Phase.DIED)
    assert "must be at most 1e+09 Pa" in done(session, "set_parameters", values={"C10": 1e41})
    stone = with_values(measured.material, {"C10": 1e12})
    assert "must be at most 1e+09 Pa" in done(session, "use_material", material=stone, source="stone.material.json")
    assert session.update_and_make_frame().scene is before.scene
    session.restart_simulation()
    until(session.update_and_make_frame, lambda frame: frame.phase is Phase.RUNNING)


def test_a_material_of_the_same_law_is_used_immediately(session, measured, until):
    done(session, "aim", depth=1e-3)
    before, simulation = until(session.update_and_make_frame, at_rest(1e-3)), session.simulation
    stiffer = replace(with_values(measured.material, {"C10": 1700.0}), name="stiffer")
    assert done(session, "use_material", material=stiffer, source="stiffer.material.json") is None
    frame = until(session.update_and_make_frame, lambda frame: frame.readouts.force > 1.1 * before.readouts.force)
    assert session.simulation is simulation and frame.phase is Phase.RUNNING
    assert (frame.scene.material, frame.scene.source) == (stiffer, "stiffer.material.json")


def test_the_present_material_is_saved(session, tmp_path):
    assert done(session, "set_parameters", values={"C10": 1500.0}) is None
    assert done(session, "save_material", folder=tmp_path, name="softer") is None
    path = tmp_path / "softer.material.json"
    assert ts.load_material(path).parameters["C10"] == 1500.0
    assert session.update_and_make_frame().scene.source == path.name
    assert "exists already" in done(session, "save_material", folder=tmp_path, name="softer")
    assert "must be a name of a material file" in done(session, "save_material", folder=tmp_path, name="../softer")
    assert [each.name for each in tmp_path.iterdir()] == [path.name]


def test_a_kept_curve_is_shown_with_the_next_one(session, until):
    until(session.update_and_make_frame, lambda _: not session._curve.is_busy)
    model = until(session.update_and_make_frame,
                  lambda frame: frame.curves.model is session._curve.recording).curves.model
    assert done(session, "keep_curve", name="before") is None
    assert session.update_and_make_frame().curves.compared == ("before", model)
    done(session, "set_parameters", values={"C10": 1600.0})
    frame = until(session.update_and_make_frame, lambda frame: frame.curves.model is not model)
    assert frame.curves.compared == ("before", model)
    assert done(session, "keep_curve") is None
    assert session.update_and_make_frame().curves.compared is None


def test_only_the_newest_aim_is_executed_and_all_are_answered(session, monkeypatch):
    asked, ask = [], session.simulation.send_command_and_wait
    monkeypatch.setattr(session.simulation, "send_command_and_wait",
                        lambda command, **values: (asked.append((command, values)), ask(command, **values)))
    replies = []
    for depth in (1e-3, 2e-3, 0.5e-3):
        session.post("aim", depth=depth, reply=replies.append)
    frame = session.update_and_make_frame()
    assert asked == [("aim", {"depth": 0.5e-3})] and frame.target == 0.5e-3
    assert replies == [None, None, None], "each request needs a reply"


def test_commands_from_many_threads_keep_their_order(session, until):
    replies = []

    def ask(thread):
        for n in range(20):
            session.post("keep_curve", name=f"{thread} {n}",
                         reply=lambda problem, n=n: replies.append((thread, n, problem)))

    threads = [threading.Thread(target=ask, args=(each,)) for each in range(8)]
    for thread in threads:
        thread.start()
    frame = until(session.update_and_make_frame, lambda _: len(replies) == 160)
    for thread in threads:
        thread.join()
    assert sorted(replies) == [(thread, n, None) for thread in range(8) for n in range(20)]
    for each in range(8):
        assert [n for thread, n, _ in replies if thread == each] == list(range(20)), "in the order in which it asked"
    assert frame.curves.compared[0] == "{} {}".format(*replies[-1][:2])


def test_an_unknown_command_raises_an_error(session):
    for name in ("close", "update_and_make_frame", "_begin", "fly"):
        with pytest.raises(ValueError, match=f"command must be one of .*; got '{name}'"):
            session.post(name)
    own = {name: command for name, command in COMMANDS.items() if name not in CALIBRATION_COMMANDS}
    assert {name: command.__name__ for name, command in own.items()} == {
        "aim": "set_hand_target", "play": "play_protocol_on_reset_tissue",
        "replay": "replay_measured_motion_on_reset_tissue",
        "follow": "move_with_device_on_reset_tissue", "pause": "pause_motion", "resume": "resume_motion",
        "step": "pause_and_advance_one_frame_time",
        "reset": "reset_tool_and_tissue", "set_parameters": "set_material_parameters",
        "use_material": "replace_material_restart_if_needed", "save_material": "save_new_material_file_in_folder",
        "use_scene": "change_test_and_tool",
        "keep_curve": "keep_or_remove_comparison_curve", "restart": "restart_simulation"}
    assert all(command is getattr(Session, command.__name__) for command in own.values())
    assert {name: COMMANDS[name] for name in CALIBRATION_COMMANDS} == CALIBRATION_COMMANDS


def test_unchanged_curves_are_the_same_objects(session, until):
    assert done(session, "pause") is None
    before = until(session.update_and_make_frame, lambda frame: (not session._curve.is_busy
                                                                 and frame.curves.model is session._curve.recording))
    ticks = before.readouts.time
    until(session.update_and_make_frame,
          lambda frame: frame.readouts.time > ticks + 0.1)  # what was felt before the pause is drawn
    for _ in range(FRAMES.frames_per_plot):
        settled = session.update_and_make_frame().curves
    seen = [session.update_and_make_frame().curves for _ in range(3 * FRAMES.frames_per_plot)]
    assert all(each is settled for each in seen)


@pytest.mark.slow
def test_run_shows_frames_until_it_is_stopped(session):
    stop = threading.Event()

    class Leaving(NullViewer):
        def show(self, frame):
            super().show(frame)
            if self.frames == 1:
                session.post("aim", depth=0.5e-3)
            if at_rest(0.5e-3)(frame):
                stop.set()

    viewer = Leaving()
    session.run(viewer, stop, seconds=600.0)
    assert stop.is_set() and viewer.frames > 1 and viewer.latest.target == 0.5e-3
    viewer = NullViewer()
    session.run(viewer, threading.Event(), seconds=0.5)
    assert viewer.frames >= 1 and viewer.latest.phase is Phase.RUNNING


@pytest.fixture
def springs(of_gel, pool, needle):
    """Session with a spring as tissue, whose model curves the test provides."""
    session = Session(needle, settings=LOOP)
    yield session
    session.close()


def newest_model(pool):
    (model, *_), _ = pool.tasks[-1]
    return model


def test_commands_before_the_start_are_refused(springs, pool):
    first = springs.simulation
    frame = springs.update_and_make_frame()
    assert (frame.phase, frame.readouts, frame.snapshot, frame.curves.model) == (Phase.STARTING, None, None, None)
    for command, values in (("aim", {"depth": 1e-3}), ("play", {"text": "ramp 1mm"}), ("pause", {}), ("step", {})):
        assert done(springs, command, **values) == "The simulation is not running (starting)."
    frame = springs.update_and_make_frame()
    assert (frame.target, frame.motion) == (0.0, "hand"), "a refused command changes nothing"
    assert "has no measurement" in done(springs, "replay")
    assert done(springs, "set_parameters", values={"C10": 1500.0}) is None, "it gets the new material when it runs"
    assert springs.update_and_make_frame().scene.material.parameters["C10"] == 1500.0
    assert springs.simulation is first and first.haptic_loop_process.alive
    pool.tasks[0][1].set_exception(ConvergenceError("stopped at 3 mm"))
    springs.update_and_make_frame()
    assert newest_model(pool).material.parameters["C10"] == 1500.0


def test_a_material_of_another_law_starts_a_new_simulation(springs, pool, needle):
    first = springs.simulation
    material = replace(with_values(needle.material, {"C10": 1500.0}), density=900.0)
    assert done(springs, "use_material", material=material, source="mine.material.json") is None
    frame = springs.update_and_make_frame()
    assert (frame.scene.material, frame.scene.source, frame.phase) == (material, "mine.material.json", Phase.STARTING)
    assert springs.simulation is not first and not first.haptic_loop_process.alive
    pool.tasks[0][1].set_result(None)
    springs.update_and_make_frame()
    assert newest_model(pool) == ts.Model(needle.experiment, material)


def test_another_scene_starts_a_new_simulation_without_curves(springs, pool, needle):
    springs.update_and_make_frame()
    first, curve = springs.simulation, ts.simulate(needle.model)
    pool.tasks[0][1].set_result(curve)
    for _ in range(FRAMES.frames_per_plot + 1):
        frame = springs.update_and_make_frame()
    assert frame.curves.model is curve
    assert done(springs, "keep_curve", name="needle") is None
    for name, values in (("needle", {}), ("bonded_compression", {"tool": needle.experiment.tool})):
        assert "scene" in done(springs, "use_scene", name=name, **values) or values
        assert springs.simulation is first and springs.update_and_make_frame().scene is frame.scene
    assert done(springs, "use_scene", name="bonded_compression") is None
    assert springs.simulation is not first and not first.haptic_loop_process.alive
    frames = [springs.update_and_make_frame() for _ in range(FRAMES.frames_per_plot)]
    assert frames[-1].scene.kind.name == "bonded_compression"
    assert (frames[-1].curves.model, frames[-1].curves.compared) == (None, None)
    assert newest_model(pool).experiment.tool.shape == "plate"


def test_a_failed_model_curve_gives_a_message(springs, pool, until):
    until(springs.update_and_make_frame, lambda frame: frame.phase is Phase.RUNNING)
    pool.tasks[0][1].set_exception(ConvergenceError("stopped at 3 mm"))
    assert springs.update_and_make_frame().message == "stopped at 3 mm"


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
def test_a_dead_simulation_can_be_restarted(springs, until):
    until(springs.update_and_make_frame, lambda frame: frame.readouts is not None)
    os.kill(springs.simulation.haptic_loop_process.pid, signal.SIGKILL)
    frame = until(springs.update_and_make_frame, lambda frame: frame.phase is Phase.DIED)
    assert frame.message == ("The simulation has stopped: the process of the loop was killed by signal 9; before that: "
                             "running. Press Restart to begin again.")
    for command, values in (("aim", {"depth": 1e-3}), ("play", {"text": "ramp 1mm"}), ("resume", {}), ("reset", {})):
        assert "is not running" in done(springs, command, **values)
    assert springs.update_and_make_frame().scene is frame.scene
    assert done(springs, "restart") is None
    until(springs.update_and_make_frame, lambda frame: frame.phase is Phase.RUNNING and frame.readouts is not None)
    assert done(springs, "aim", depth=1e-3) is None
    until(springs.update_and_make_frame, lambda frame: abs(frame.readouts.depth - 1e-3) < 1e-8)
    process = springs.simulation.haptic_loop_process
    springs.close()
    assert not process.alive and not process.ring_path.exists()


def test_the_force_of_a_device_and_the_force_of_the_tissue_are_recorded(of_gel, pool, needle, until):
    """The device holds a depth of 2 mm and limits its force to 0.1 N; the force of the tissue is larger."""
    hand = VirtualHand(TargetFollowingMotion(2e-3), grip=2000.0)
    hand.largest_force = 0.1
    session = Session(needle, settings=LOOP, device=hand)
    try:
        frame = until(session.update_and_make_frame,
                      lambda frame: frame.curves.has_hand_force and len(frame.curves.trace) > 5
                      and frame.curves.trace.rendered_force[-1] > 0.09)
        trace = frame.curves.trace
        assert frame.motion == "device" and trace.rendered_force.max() <= 0.1 + 1e-12
        assert trace.force[-1] > 0.2, "that of the tissue"
        session.post("aim", depth=1e-3)
        until(session.update_and_make_frame, lambda frame: frame.motion == "hand" and not frame.curves.has_hand_force)
    finally:
        session.close()


def test_a_missing_device_is_reported_and_the_session_continues(of_gel, pool, needle, until):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        device = make_haptic_device(f"haply:ws://127.0.0.1:{taken.getsockname()[1]}")
        session = Session(needle, settings=LOOP, device=device)
        try:
            frame = until(session.update_and_make_frame,
                          lambda frame: "no Haply Inverse service answers" in frame.message)
            assert frame.phase is Phase.RUNNING and not frame.curves.has_hand_force
            session.post("aim", depth=1e-3)
            until(session.update_and_make_frame, at_rest(1e-3))
        finally:
            session.close()
