"""The virtual rig: a simulated specimen between a sensor and a stage, each with its contract."""

import numpy as np
import pytest
from device_contracts import ForceSensorContract, StageContract

import tissue_sim as ts
from haptics.devices.contracts import StageLimits
from haptics.devices.virtual.faults import Faults, parse_faults
from haptics.devices.virtual.rig import ElasticSpecimenForceModel, HistoryDependentForceModel, VirtualRig
from tissue_sim.errors import InputError

SURFACE = 2e-3
#: Stiffness, N/m.
STIFFNESS = 300.0


class Clock:
    """Clock in s, advanced by the test."""

    def __init__(self):
        self.now = 50.0

    def __call__(self):
        return self.now


class Spring:
    def advance_and_get_force(self, time, depth):
        return STIFFNESS * max(depth, 0.0)


def rig_of(clock, rig=None, **options):
    return VirtualRig(Spring(), rig, clock=clock, resolution=1e-6, rate=100.0, surface=SURFACE,
                      limits=StageLimits(-0.01, 0.02, 0.01), **options)


class TestItsSensor(ForceSensorContract):
    """The sensor above the specimen."""

    load = (0.0,) * 6
    tolerance = 1e-9

    @pytest.fixture
    def sensor(self):
        self.clock = Clock()
        return rig_of(self.clock, channels=("Fx", "Fy", "Fz", "Tx", "Ty", "Tz")).sensor

    def pass_time(self, seconds):
        self.clock.now += seconds

    def now(self):
        return self.clock.now


class TestItsStage(StageContract):
    tolerance = 1e-6

    @pytest.fixture
    def stage(self):
        self.clock = Clock()
        return rig_of(self.clock).stage

    def pass_time(self, seconds):
        self.clock.now += seconds


@pytest.fixture
def pressed():
    """Samples of a motion to 3 mm below the surface at 5 mm/s and back: time, position of the stage, forces."""
    def pressed(rig=None, **options):
        clock = Clock()
        virtual = rig_of(clock, rig, start_at=0.0, **options)
        sensor, stage = virtual.sensor, virtual.stage
        sensor.start()
        stage.start()
        stage.home()
        stage.position()
        rows = []
        for goal in (SURFACE + 3e-3, 0.0):
            stage.move(goal, 5e-3)
            while stage.position().moving:
                clock.now += 0.01
                for sample in sensor.read():
                    taken = 50.0 + (sample.sequence + 1) / 100.0
                    rows.append((taken, stage.compute_tool_position_with_stall(taken), sample.values[0]))
        return np.array(rows).T

    return pressed


@pytest.mark.parametrize("values", [
    {}, {"contact_offset": 2e-4}, {"displacement_gain": 0.05}, {"backlash": 1e-4},
    {"step_loss": 3e-4, "step_loss_depth": 1e-3}, {"sensor_gain": 0.02, "zero_offset": 0.3}, {"guide_friction": 0.05},
    {"rate_damping": 10.0}, {"sensor_drift": 0.01}, {"latency": 0.05},
])
def test_the_virtual_rig_reads_the_forces_of_a_simulated_rig(pressed, values):
    """Compared with the rig of a recording, which other tests compare with closed forms."""
    rig = ts.Rig(**values)
    time, place, force = pressed(rig)
    motion = place - SURFACE
    true = STIFFNESS * np.maximum(rig.compute_unloaded_tool_displacement(np.append(-SURFACE, motion))[1:], 0.0)
    reported = rig.read(ts.Recording({"time": time, "displacement": motion, "force": true})).force
    speed = np.diff(motion, prepend=motion[0])
    # Speeds at reversals and at the first samples depend on the difference scheme; latency is interpolated there.
    turns = np.convolve(np.abs(np.diff(np.sign(speed), prepend=0.0)), np.ones(21), "same") > 0
    inside = (time > time[0] + 0.1) & ~turns
    drift = rig.sensor_drift * 0.01  # the recording begins one sampling period after the sensor
    np.testing.assert_allclose(force[inside], reported[inside], atol=2e-5 + 2 * drift + 300.0 * 5e-3 * rig.latency / 40)


def test_noise_has_the_stated_deviation_and_correlation(pressed):
    rig = ts.Rig(force_noise=0.02, noise_correlation_time=0.05, seed=3)
    samples = []
    for seed in range(8):
        _, _, force = pressed(ts.Rig(force_noise=0.02, noise_correlation_time=0.05, seed=seed))
        _, _, plain = pressed()
        samples.append(force - plain)
    noise = np.array(samples)
    assert noise.std() == pytest.approx(rig.force_noise, rel=0.1)
    assert np.mean(noise[:, 1:] * noise[:, :-1]) / noise.var() == pytest.approx(np.exp(-0.01 / 0.05), abs=0.06)


def test_faults_of_sensor_and_motor(pressed):
    time, _, force = pressed(faults=Faults(saturate_after=1.0))
    late = time > time[0] + 1.01
    assert (force[late] == 120.0).all() and not (force[~late][:-3] == 120.0).any()
    _, _, drifting = pressed(faults=Faults(drift=0.1))
    _, _, plain = pressed()
    np.testing.assert_allclose(drifting - plain, 0.1 * (time - time[0] + 0.0), atol=2e-3)
    silent, _, _ = pressed(faults=Faults(disconnect_after=0.5))
    assert silent[-1] - silent[0] <= 0.5


@pytest.mark.parametrize(("text", "field"), [("loss=2", "loss"), ("delay_ms=-1", "delay"), ("drft=1", "drft")])
def test_invalid_faults_are_refused(text, field):
    with pytest.raises(InputError) as caught:
        parse_faults(text)
    assert caught.value.field == field


def needle(depth, **material):
    experiment = ts.KINDS["needle_indentation"].experiment(
        specimen=ts.Specimen(0.02, 0.03), protocol=ts.Protocol.ramp(depth, 9), tool=ts.Tool("flat", radius=4e-3),
        friction="bonded")
    return ts.Model(experiment, ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3), **material))


def test_the_force_of_an_elastic_specimen_equals_its_simulation():
    model = needle(2e-3)
    specimen = ElasticSpecimenForceModel(model, 2e-3, "fast")
    recording = ts.simulate(model)
    forces = [specimen.advance_and_get_force(0.0, depth) for depth in recording.displacement]
    np.testing.assert_allclose(forces, recording.force, atol=1e-5 * recording.force[-1])
    assert specimen.advance_and_get_force(0.0, -1e-3) == 0.0
    soft = ElasticSpecimenForceModel(ts.with_values(model, {"rig.compliance": 1e-3}), 2e-3, "fast")
    behind = soft.advance_and_get_force(0.0, 2e-3)
    assert behind == pytest.approx(specimen.advance_and_get_force(0.0, 2e-3 - 1e-3 * behind), rel=1e-4)


def test_a_history_dependent_specimen_relaxes():
    model = needle(2e-3, viscoelastic=ts.Prony((ts.PronyTerm(0.4, 0.5),)))
    with pytest.raises(InputError, match="make a HistoryDependentForceModel"):
        ElasticSpecimenForceModel(model, 2e-3)
    specimen = HistoryDependentForceModel(model)
    way_in = [specimen.advance_and_get_force(0.01 * step, 1e-4 * step) for step in range(11)]
    held = [specimen.advance_and_get_force(0.1 + 0.05 * step, 1e-3) for step in range(1, 60)]
    assert way_in[-1] > 0 and held[-1] < 0.75 * way_in[-1] and (np.diff(held) < 1e-9).all()
    with pytest.raises(InputError, match="compliance"):
        HistoryDependentForceModel(ts.with_values(model, {"rig.compliance": 1e-3}))


def test_unsupported_rigs_and_channels_are_refused():
    with pytest.raises(InputError, match="no sampling rate"):
        rig_of(Clock(), ts.Rig(sampling_rate=100.0))
    with pytest.raises(InputError, match="must contain Fz"):
        rig_of(Clock(), channels=("Fx",))
