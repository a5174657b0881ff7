"""Recordings with a prescribed force on the virtual rig: control, and every reason to stop."""

import math
import threading

import numpy as np
import pytest
from virtual_bench import STIFFNESS, SURFACE, Spring, VirtualBench

from haptics.devices.virtual.faults import Faults
from haptics.recorder.guarded_motion import StoppedError
from haptics.safety.force_control import FORCE_CONTROL, ForceControlGuard, ForceController, ForceControlLimits
from tissue_sim import Rig
from tissue_sim.errors import InputError
from tissue_sim.recording.file import read_recording

LIMITS = ForceControlLimits(depth=6e-3, speed=2e-3, force_error=0.2)
CREEP = "ramp 1N @0.5N/s; hold 6s; unload 0.3N; hold 2s"


class CreepingSpring(Spring):
    """Spring in series with a Kelvin element of the same stiffness, retardation time 1 s (a standard linear solid)."""

    def __init__(self, stiffness=STIFFNESS):
        super().__init__(stiffness)
        self._time, self._crept = None, 0.0

    def advance_and_get_force(self, time, depth):
        dt = 0.0 if self._time is None else max(time - self._time, 0.0)
        self._time = time
        # Implicit Euler of c' = (F / k - c) / tau with F = k (depth - c).
        self._crept = (self._crept + dt * max(depth, 0.0)) / (1.0 + 2.0 * dt) if depth > 0 else 0.0
        return self.stiffness * max(depth - self._crept, 0.0)


class RupturingSpring(Spring):
    """Spring that breaks at a time."""

    def __init__(self, clock, seconds):
        super().__init__()
        self._clock, self._seconds, self._loaded = clock, seconds, None

    def advance_and_get_force(self, time, depth):
        force = super().advance_and_get_force(time, depth)
        if force > 0.9 and self._loaded is None:
            self._loaded = time
        return 0.0 if self._loaded is not None and time - self._loaded > self._seconds else force


def run_creep(bench, specimen=None, protocol=CREEP, control=LIMITS, **options):
    """Record one replicate with a prescribed force."""
    plan = bench.plan(protocol, replicates=1, force_control=control, touch="once")
    rig = bench.rig(specimen or CreepingSpring(), **{"rate": 500.0, **options})
    return bench.run(plan=plan, rig=rig)


def run_until_stop(bench, *arguments, **options):
    """The error of a run that stops."""
    with pytest.raises(StoppedError) as error:
        run_creep(bench, *arguments, **options)
    return error.value.reason


@pytest.mark.parametrize("stiffness", [150.0, STIFFNESS, 1000.0])
def test_the_force_follows_the_protocol_while_the_specimen_creeps(bench, stiffness):
    """From a tenth to the whole of the largest stiffness: the force is held within 2 % and does not oscillate."""
    control = ForceControlLimits(depth=15e-3, speed=5e-3, force_error=0.5)
    limits = bench.limits(highest=19e-3, speed=5e-3, force_margin=5.0)
    plan = bench.plan(CREEP, replicates=1, force_control=control, touch="once")
    rig = bench.rig(CreepingSpring(stiffness))
    bench.run(plan=plan, rig=rig, limits=limits)
    found = read_recording(bench.folder / "spring_1.csv")
    hold = (found.time > 6.0) & (found.time < 8.0)
    np.testing.assert_allclose(found.force[hold], 1.0, atol=0.02)
    assert found.force.max() < 1.1
    # The displacement of the standard linear solid under 1 N tends to 2 F / k.
    assert np.interp(8.0, found.time, found.displacement) == pytest.approx(2.0 / stiffness, rel=0.03)
    assert list(dict.fromkeys(found.labels["segment"].tolist())) == ["ramp", "hold", "unload"]
    np.testing.assert_allclose(found.force[found.time > 10.5], 0.3, atol=0.03)


def test_noise_of_the_sensor_moves_the_stage_little(bench):
    run_creep(bench, rig=Rig(force_noise=0.02))
    found = read_recording(bench.folder / "spring_1.csv")
    late = (found.time > 7.0) & (found.time < 8.0)
    assert np.std(np.diff(found.displacement[late])) < 5e-6
    assert np.mean(found.force[late]) == pytest.approx(1.0, abs=0.02)


def test_lost_contact_stops_the_stage(bench):
    """The specimen ruptures: the stage stops within a tenth of a second and does not plunge to the limit."""
    specimen = RupturingSpring(bench.clock, 1.0)
    reason = run_until_stop(bench, specimen)
    assert reason.cause == "contact lost" and "the force fell to" in reason.message
    deepest = bench.virtual.stage.compute_tool_position_with_stall(bench.clock.now) - SURFACE
    assert deepest < 1.0 / STIFFNESS + 2 * FORCE_CONTROL.lost_time * LIMITS.speed


def seconds_to_hold(folder):
    """Time from the start of the devices to the hold of the force, s, in a run without faults."""
    bench, times = VirtualBench(folder), []
    plan = bench.plan(CREEP, replicates=1, force_control=LIMITS, touch="once")
    bench.run(plan=plan, rig=bench.rig(CreepingSpring()), on_progress=lambda moment: times.append(
        (moment.phase, bench.clock.now)))
    return next(now for phase, now in times if phase == "hold") - times[0][1]


@pytest.mark.parametrize(("cause", "fault", "stiffness", "control"), [
    ("travel", None, 300.0, ForceControlLimits(2.5e-3, 2e-3, 0.1)),
    ("force control", None, 150.0, ForceControlLimits(8e-3, 0.5e-3, 0.1)),
    ("sensor lost", "disconnect_after", STIFFNESS, LIMITS),
    ("sensor saturated", "saturate_after", STIFFNESS, LIMITS),
    ("stage stalled", "stall_after", STIFFNESS, LIMITS),
], ids=["depth", "too slow", "silent sensor", "saturated sensor", "stalled motor"])
def test_each_fault_stops_the_stage(bench, cause, fault, stiffness, control, tmp_path):
    """A fault during creep stops the run with its cause, and the stage is at rest."""
    faults = Faults() if fault is None else Faults(**{fault: seconds_to_hold(tmp_path / "faultless") + 0.2})
    reason = run_until_stop(bench, Spring(stiffness) if fault is None else CreepingSpring(), control=control,
                            faults=faults)
    assert reason.cause == cause, reason
    last = bench.virtual.stage._motions[-1]
    assert last.start == last.goal and last.goal < SURFACE + control.depth + 1e-4


def test_a_stage_without_commands_stops_after_the_horizon(bench):
    """Each command ends at most one horizon ahead, so that a stage whose program has died stops there."""
    ahead = []
    plan = bench.plan(CREEP, replicates=1, force_control=LIMITS, touch="once")
    rig = bench.rig(CreepingSpring())
    move = rig.stage.move
    rig.stage.move = lambda position, speed: (ahead.append((
        bench.moments[-1].phase if bench.moments else "", abs(
            position - rig.stage.compute_tool_position_with_stall(bench.clock.now)))), move(position, speed))[1]
    bench.run(plan=plan, rig=rig)
    controlled = [distance for phase, distance in ahead if phase in ("hold", "unload")]
    assert len(controlled) > 500
    # The motions back to the waiting position are longer.
    assert np.quantile(controlled, 0.99) <= LIMITS.speed * FORCE_CONTROL.horizon + 2e-6


def test_late_polls_halt_the_stage(bench, monkeypatch):
    """The thread that watches the polls halts a controlled stage whose program hangs."""
    hung, halted = threading.Event(), threading.Event()

    def hang(moment):
        if moment.phase == "hold" and moment.force > 0.9 and not hung.is_set():
            hung.set()
            bench.clock.now += 10.0
            halted.wait(20.0)

    plan = bench.plan(CREEP, replicates=1, force_control=LIMITS, touch="once")
    rig = bench.rig(CreepingSpring())
    halt = rig.stage.halt
    rig.stage.halt = lambda: (halt(), halted.set() if hung.is_set() else None)[0]
    with pytest.raises(StoppedError) as error:
        bench.run(plan=plan, rig=rig, on_progress=hang)
    assert halted.is_set() and error.value.reason.cause in ("program late", "sensor lost")


def test_plans_beyond_the_limits_are_refused(bench):
    with pytest.raises(InputError, match="force_control: is required, because the protocol prescribes a force"):
        bench.plan(CREEP)
    with pytest.raises(InputError, match=r"force_control.speed: must be positive and finite; got inf"):
        ForceControlLimits(1e-3, math.inf, 0.1)
    plan = bench.plan("ramp 4.9N @1N/s", force_control=LIMITS)
    with pytest.raises(InputError, match="the prescribed force plus force_error_N must be at most 5 N"):
        bench.run(plan=plan)
    with pytest.raises(InputError, match="the sensor must sample at 29 Hz or faster to control a force; got 25 Hz"):
        bench.run(plan=bench.plan(CREEP, force_control=LIMITS), rig=bench.rig(CreepingSpring(), rate=25.0))
    fast = ForceControlLimits(6e-3, 6e-3, 0.2)
    with pytest.raises(InputError, match="speed must be at most 5 mm/s; got 6 mm/s"):
        bench.run(plan=bench.plan(CREEP, force_control=fast))


def test_a_stage_without_support_is_refused_by_name(bench):
    rig = bench.rig(CreepingSpring())
    rig.stage.supports_force_control = False
    with pytest.raises(InputError, match="must prescribe displacements for a VirtualStage; got a prescribed force"):
        bench.run(plan=bench.plan(CREEP, force_control=LIMITS), rig=rig)


class TestController:
    def test_speed_and_integral_are_bounded(self):
        controller = ForceController(LIMITS, 1000.0)
        for _ in range(10_000):
            assert controller.compute_speed(100.0, 0.0, 0.0, 0.0, 0.01) == LIMITS.speed
        # Without windup the speed turns at once.
        assert controller.compute_speed(0.0, 0.0, 0.0, 0.0, 0.01) == 0.0
        assert controller.compute_speed(0.0, 0.0, 1.0, 1e-3, 0.01) == pytest.approx(-LIMITS.speed, rel=1e-9)

    def test_nan_readings_stop_the_stage(self):
        assert ForceController(LIMITS, 1000.0).compute_speed(1.0, 0.0, math.nan, 1e-3, 0.01) == 0.0
        assert ForceControlGuard(LIMITS, 0.05, True).find_stop_reason(0.0, 1.0, 1.0, math.nan, 0.0).cause == "travel"
        reason = ForceControlGuard(LIMITS, 0.05, True).find_stop_reason(0.0, 1.0, math.nan, 1e-3, 0.0)
        assert reason.cause == "sensor fault"
