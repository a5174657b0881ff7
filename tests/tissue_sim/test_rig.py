"""Rig effects, each by the signature that tells it from the others."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import brentq

import tissue_sim as ts
from tissue_sim.recording.recording import Recording
from tissue_sim.rig.rig import Rig, compute_nut_positions_and_screw_samples

#: Radius, m.
RADIUS = 0.040
#: Height, m.
HEIGHT = 0.070
#: Parameter of the law, Pa.
C10 = 1404.9
#: Parameter of the law, Pa.
C20 = 699.4
#: Speed, m/s.
SPEED = 0.25e-3
#: Depth, m.
DEPTH = 10e-3
PEAK = 40
TIME = np.concatenate([np.arange(41) * 1.0, 40 + np.arange(1, 11) * 2.0, 60 + np.arange(1, 41) * 1.0])
WAY = np.concatenate([np.linspace(0, DEPTH, 41), np.full(10, DEPTH), np.linspace(DEPTH, 0, 41)[1:]])
RAMP = slice(1, 41)
#: Duration of the hold, s.
HOLD = slice(41, 51)
UNLOAD = slice(51, 91)
SEGMENT = np.array(["ramp"] * 41 + ["hold"] * 10 + ["unload"] * 40)


def lubricated(depth):
    """Closed form of the study's lubricated compression, N: incompressible, reduced polynomial N = 2; 0 above it."""
    l = 1 - np.maximum(depth, 0.0) / HEIGHT
    i1 = l**2 + 2 / l
    return -2 * (C10 + 2 * C20 * (i1 - 3)) * (l - l**-2) * np.pi * RADIUS**2


def test_closed_form_is_the_reference():
    assert lubricated(np.array([2e-3, 5e-3, 10e-3])) == pytest.approx([1.24965, 3.31757, 7.59995], abs=1e-5)


def compression(force=lubricated, displacement=WAY, time=TIME, labels=None) -> Recording:
    return Recording({"time": time, "displacement": displacement, "force": force(displacement)}, labels=labels or {})


ELASTIC = compression()


class TestIdeal:
    @pytest.mark.parametrize("rig", [Rig(), Rig(seed=3), Rig(step_loss_depth=5e-3), Rig(noise_correlation_time=1.0)])
    def test_returns_the_recording_itself(self, rig):
        assert rig.is_ideal
        for effect in (rig.measure, rig.apply_motion_effects, rig.read):
            assert effect(ELASTIC) is ELASTIC

    @pytest.mark.parametrize("field", ["contact_offset", "displacement_gain", "backlash", "step_loss", "compliance",
                                       "guide_friction", "rate_damping", "latency", "sensor_gain", "zero_offset",
                                       "sensor_drift", "sampling_rate", "force_noise", "force_resolution",
                                       "displacement_resolution"])
    def test_every_effect_alone_changes_the_recording(self, field):
        rig = Rig(**{field: 0.7 if field == "sampling_rate" else 1e-3})
        assert not rig.is_ideal
        measured = rig.measure(ELASTIC)
        assert len(measured) != len(ELASTIC) or any(
            (measured.channel(name) != ELASTIC.channel(name)).any() for name in ("force", "displacement"))

    def test_empty_recording(self):
        empty = Recording({"time": [], "displacement": [], "force": []})
        assert len(Rig(contact_offset=1e-4, sampling_rate=10.0, zero_offset=0.1).measure(empty)) == 0


def test_motion_only():
    """Effects on the motion of the tool are kept; effects on the readings are removed."""
    stated = {"contact_offset": 1e-3, "displacement_gain": 0.1, "backlash": 1e-4, "step_loss": 1e-4,
              "step_loss_depth": 1e-3, "compliance": 1e-4, "guide_friction": 0.1, "rate_damping": 10.0,
              "latency": 0.1, "sensor_gain": 0.1, "zero_offset": 0.1, "sensor_drift": 0.1, "sampling_rate": 10.0,
              "force_noise": 0.1, "noise_correlation_time": 1.0, "force_resolution": 0.1,
              "displacement_resolution": 1e-4, "seed": 3}
    assert {*stated, "faults"} == {entry.name for entry in dataclasses.fields(Rig)}
    rig, moving = Rig(**stated), Rig(**stated).with_motion_effects_only
    np.testing.assert_array_equal(moving.compute_unloaded_tool_displacement(WAY),
                                  rig.compute_unloaded_tool_displacement(WAY))
    np.testing.assert_array_equal(moving.apply_motion_effects(ELASTIC).force, rig.apply_motion_effects(ELASTIC).force)
    read = moving.read(ELASTIC)
    np.testing.assert_array_equal(read.force, ELASTIC.force)
    np.testing.assert_array_equal(read.displacement, WAY)


class TestCompliance:
    @pytest.mark.parametrize("stiffness", [1.0, 760.0, 1e6])
    def test_linear_spring(self, stiffness):
        """F = k x / (1 + c k), on the ramp, in the hold and during unloading."""
        c = 0.05e-3
        soft = Rig(compliance=c).apply_motion_effects(compression(lambda d: stiffness * d))
        np.testing.assert_allclose(soft.force, stiffness * WAY / (1 + c * stiffness), rtol=1e-9, atol=1e-12)
        np.testing.assert_array_equal(soft.displacement, WAY)

    @pytest.mark.parametrize("compliance", [0.02e-3, 0.2e-3])
    @pytest.mark.parametrize("offset", [0.0, 0.3e-3])
    def test_lubricated_compression_against_a_root_finder(self, compliance, offset):
        force = Rig(compliance=compliance, contact_offset=offset).apply_motion_effects(ELASTIC).force
        expected = [lubricated(brentq(lambda d, D=D: d + compliance * lubricated(d) - (D - offset), -1e-3, DEPTH,
                                      xtol=1e-15)) for D in WAY]
        np.testing.assert_allclose(force, expected, atol=3e-5)

    def test_displacement_error_is_proportional_to_force(self):
        force = Rig(compliance=0.05e-3).apply_motion_effects(ELASTIC).force[RAMP]
        depth = np.interp(force, lubricated(np.linspace(0, DEPTH, 100_001)), np.linspace(0, DEPTH, 100_001))
        np.testing.assert_allclose((WAY[RAMP] - depth) / force, 0.05e-3, rtol=1e-3)

    def test_force_that_drops_stays_in_equilibrium(self):
        """A puncture: the curve falls faster than the load train gives way."""
        def needle(depth):
            return 400 * depth * np.where(depth > 5e-3, 0.5, 1.0)

        punctured = compression(needle)
        c = 2e-3
        force = Rig(compliance=c).apply_motion_effects(punctured).force
        depth = WAY - c * force
        assert depth.min() > -1e-12
        before, after = depth < 5e-3 - 1e-9, depth > 5.3e-3
        assert before[RAMP].any() and after[RAMP].any()
        np.testing.assert_allclose(force[before], 400 * depth[before], rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(force[after], 200 * depth[after], rtol=1e-6)

    def test_bonded_plate_that_pulls(self):
        way = np.concatenate([np.linspace(0, -2e-3, 21), np.linspace(-2e-3, 0, 21)[1:]])
        soft = Rig(compliance=0.1e-3).apply_motion_effects(compression(lambda d: 700 * d, way, np.arange(41.0)))
        np.testing.assert_allclose(soft.force, 700 * way / 1.07, rtol=1e-9, atol=1e-12)


def closed_form_with_history(motion, time, compliance, prony_g, softening):
    """Force of a quasi-linear viscoelastic, softening specimen: every step solved with the load train in it."""
    tau, memory, before, deepest, forces = 2.0, 0.0, 0.0, 0.0, []
    for sample, target in enumerate(motion):
        dt = time[sample] - time[sample - 1] if sample else 0.0
        decay = np.exp(-dt / tau)
        gain = prony_g * (tau * (1 - decay) / dt if dt else 1.0)

        def force(depth, decay=decay, gain=gain, memory=memory, before=before, deepest=deepest):
            elastic = softened(depth, max(deepest, depth), softening)
            return max((1 - prony_g) * elastic + decay * memory + gain * (elastic - before), 0.0)

        depth = brentq(lambda d, target=target, force=force: d + compliance * force(d) - target,
                       target - 100 * compliance - 1e-9, target + 1e-9, xtol=1e-15)
        deepest = max(deepest, depth)
        forces.append(force(depth))
        elastic = softened(depth, deepest, softening)
        memory, before = decay * memory + gain * (elastic - before), elastic
    return np.array(forces)


def softened(depth, deepest, softening):
    return lubricated(depth) * (1 - softening * np.tanh(1 - (max(depth, 0) / max(deepest, 1e-12)) ** 2))


class TestHistory:
    """Against full solves: how far the answer without a new solve may be off, as a part of the effect."""

    @pytest.mark.parametrize(("prony_g", "softening"), [(0.3, 0.0), (0.0, 0.4), (0.3, 0.4)])
    @pytest.mark.parametrize(("effect", "ramp", "hold", "unload", "last_mm"), [
        ({"compliance": 0.05e-3}, 0.03, 0.02, 0.09, 0.02),
        ({"displacement_gain": -0.01}, 0.025, 0.02, 0.015, 0.015),
        ({"contact_offset": 0.1e-3}, 0.03, 0.02, 0.2, 0.35),
        ({"backlash": 0.05e-3}, 0.0, 0.0, 0.02, 0.2),
    ])
    def test_effect_without_a_new_solve(self, prony_g, softening, effect, ramp, hold, unload, last_mm):
        rig = Rig(**effect)
        ideal = closed_form_with_history(WAY, TIME, 0.0, prony_g, softening)
        full = closed_form_with_history(rig.compute_unloaded_tool_displacement(WAY), TIME, rig.compliance, prony_g,
                                        softening)
        found = rig.apply_motion_effects(compression(lambda d: ideal)).force
        size = abs(full - ideal).max()
        assert size > 0.04
        for part, share in ((RAMP, ramp), (HOLD, hold), (slice(51, 87), unload), (slice(87, 91), last_mm)):
            assert abs(found - full)[part].max() <= share * size + 1e-9

    @pytest.mark.parametrize("labels", [{}, {"segment": SEGMENT}])
    def test_hold_that_trembles_is_no_new_depth(self, labels):
        """A specimen that relaxes by 30 % in the hold and stays there: the spring behind it does not notice."""
        relaxed = np.where(np.arange(91) < 41, 1.0, 0.7)
        way = WAY + np.where(SEGMENT == "hold", 2e-6 * (np.arange(91) % 3), 0.0)
        c, k = 0.05e-3, 760.0
        found = Rig(compliance=c).apply_motion_effects(compression(lambda d: relaxed * k * d, way, labels=labels)).force
        np.testing.assert_allclose(found, relaxed * k * way / (1 + c * relaxed * k), rtol=1e-6, atol=1e-12)


class TestMotion:
    def test_contact_offset_shifts_both_ways_alike(self):
        measured = Rig(contact_offset=0.2e-3).measure(ELASTIC)
        np.testing.assert_array_equal(measured.displacement, WAY)
        np.testing.assert_allclose(measured.force, lubricated(WAY - 0.2e-3), atol=1e-4)
        assert measured.force[0] == measured.force[-1] == 0.0

    def test_negative_contact_offset_goes_deeper_than_the_curve(self):
        force = Rig(contact_offset=-0.2e-3).apply_motion_effects(ELASTIC).force
        np.testing.assert_allclose(force, lubricated(WAY + 0.2e-3), rtol=2e-4)

    def test_contact_offset_after_an_approach_in_air(self):
        way = np.linspace(-2e-3, 8e-3, 41)
        recording = compression(displacement=way, time=np.arange(41.0))
        force = Rig(contact_offset=0.1e-3).apply_motion_effects(recording).force
        np.testing.assert_allclose(force, lubricated(way - 0.1e-3), atol=2e-4)
        assert (force[way <= 0.1e-3] == 0).all()

    def test_displacement_gain_scales_the_axis_about_the_touch(self):
        rig = Rig(displacement_gain=0.01, contact_offset=0.2e-3)
        np.testing.assert_allclose(rig.compute_unloaded_tool_displacement(WAY), 1.01 * (WAY - 0.2e-3), rtol=1e-12,
                                   atol=1e-18)
        np.testing.assert_allclose(rig.apply_motion_effects(ELASTIC).force, lubricated(1.01 * (WAY - 0.2e-3)),
                                   atol=5e-4)

    def test_backlash_shifts_after_every_reversal(self):
        way = np.concatenate([np.linspace(0, 8e-3, 33), np.linspace(8e-3, 4e-3, 17)[1:],
                              np.linspace(4e-3, 9e-3, 21)[1:]])
        b = 0.6e-3
        motion = Rig(backlash=b).compute_unloaded_tool_displacement(way)
        np.testing.assert_array_equal(motion[:33], way[:33])
        np.testing.assert_allclose(motion[33:49], np.minimum(way[33:49] + b, 8e-3))
        np.testing.assert_allclose(motion[49:], np.maximum(way[49:], 4e-3 + b))
        recording = compression(displacement=way, time=np.arange(way.size) * 1.0)
        force = Rig(backlash=b).apply_motion_effects(recording).force
        np.testing.assert_allclose(force, lubricated(motion), atol=2e-5)

    def test_backlash_holds_what_the_specimen_remembers(self):
        """While the play is taken up the tool rests at the peak and the force of a lossy specimen stays there."""
        loss = np.where(np.arange(91) < 51, 1.0, 0.6)
        force = Rig(backlash=0.5e-3).apply_motion_effects(compression(lambda d: loss * lubricated(d))).force
        assert force[52] == pytest.approx(force[50], rel=1e-9)      # two samples of 0.25 mm: just taken up
        np.testing.assert_allclose(force[53:], 0.6 * lubricated(WAY[53:] + 0.5e-3), atol=1e-4)

    def test_step_loss_is_a_jump_that_stays(self):
        rig = Rig(step_loss=0.1e-3, step_loss_depth=5e-3)
        reached = np.arange(91) > 20                                 # sample 20 is at 5 mm
        np.testing.assert_allclose(rig.compute_unloaded_tool_displacement(WAY), WAY - 0.1e-3 * reached, atol=1e-18)
        np.testing.assert_allclose(rig.apply_motion_effects(ELASTIC).force, lubricated(WAY - 0.1e-3 * reached),
                                   atol=1e-4)

    @given(st.lists(st.integers(-20, 20), min_size=1, max_size=40), st.integers(1, 10))
    def test_play_is_never_exceeded_and_the_history_is_one_that_was(self, steps, play):
        screw = np.cumsum(steps).astype(float)
        nut, since = compute_nut_positions_and_screw_samples(screw, float(play))
        assert (nut >= screw).all() and (nut <= screw + play).all()
        assert (since <= np.arange(screw.size)).all() and (np.diff(since) >= 0).all()
        np.testing.assert_allclose(np.interp(since, np.arange(screw.size), screw), nut, atol=1e-9)


class TestSensor:
    def test_zero_offset_also_in_air(self):
        air = compression(displacement=WAY - 20e-3)
        np.testing.assert_array_equal(Rig(zero_offset=0.3).measure(air).force, np.full(91, 0.3))

    def test_gain_is_proportional_to_the_force_and_not_to_the_zero(self):
        force = Rig(sensor_gain=0.02, zero_offset=0.3).measure(ELASTIC).force
        np.testing.assert_allclose(force, 1.02 * lubricated(WAY) + 0.3, rtol=1e-14)

    def test_drift_goes_with_time_since_the_first_sample(self):
        late = compression(time=TIME + 1000)
        drift = Rig(sensor_drift=1e-3).measure(late).force - lubricated(WAY)
        np.testing.assert_allclose(drift, 1e-3 * TIME, atol=1e-12)
        assert drift[HOLD][-1] - drift[HOLD][0] == pytest.approx(18e-3)

    def test_latency_shifts_with_speed_and_oppositely_on_the_way_back(self):
        def spring(depth):
            return 700 * depth

        for speed in (1.0, 10.0):
            shift = Rig(latency=0.05).measure(compression(spring, time=TIME / speed)).force - spring(WAY)
            np.testing.assert_allclose(shift[RAMP], -700 * SPEED * speed * 0.05, rtol=1e-9)
            np.testing.assert_allclose(shift[UNLOAD], 700 * SPEED * speed * 0.05, rtol=1e-9)
            np.testing.assert_allclose(shift[HOLD][1:], 0.0, atol=1e-12)

    def test_guide_friction_has_the_sign_of_the_velocity_in_air_too(self):
        for way in (WAY, WAY - 20e-3):
            added = Rig(guide_friction=0.04).measure(compression(displacement=way)).force - lubricated(way)
            np.testing.assert_allclose(added[RAMP], 0.04)
            np.testing.assert_allclose(added[HOLD], 0.0, atol=1e-12)
            np.testing.assert_allclose(added[UNLOAD], -0.04)
            assert added[0] == 0.0

    def test_friction_of_a_hold_that_trembles(self):
        way = WAY + np.where(SEGMENT == "hold", 1e-7 * (-1.0) ** np.arange(91), 0.0)
        rig = Rig(guide_friction=0.04, rate_damping=100.0)
        still = compression(displacement=way, labels={"segment": SEGMENT})
        np.testing.assert_array_equal(rig.read(still).force[HOLD], still.force[HOLD])

    def test_late_friction_jumps_and_is_not_interpolated(self):
        added = Rig(guide_friction=0.04, latency=0.5).measure(compression(displacement=WAY - 20e-3)).force
        assert set(np.round(added, 12)) == {0.0, 0.04, -0.04}
        assert added[41] == 0.0 and added[51] == -0.04

    def test_rate_damping_is_proportional_to_speed(self):
        for speed in (1.0, 10.0):
            added = Rig(rate_damping=50.0).measure(compression(time=TIME / speed)).force - lubricated(WAY)
            np.testing.assert_allclose(added[RAMP], 50 * SPEED * speed, rtol=1e-9)
            np.testing.assert_allclose(added[UNLOAD], -50 * SPEED * speed, rtol=1e-9)

    def test_resolution(self):
        measured = Rig(force_resolution=0.02, displacement_resolution=1e-5).measure(ELASTIC)
        for values, exact, unit in ((measured.force, ELASTIC.force, 0.02), (measured.displacement, WAY, 1e-5)):
            assert abs(values / unit - np.round(values / unit)).max() < 1e-9
            assert abs(values - exact).max() <= unit / 2 * (1 + 1e-9)
        assert abs(measured.force - ELASTIC.force).max() > 0.005

    def test_sampling(self):
        labels = {"segment": SEGMENT, "cycle": np.arange(91)}
        ideal = compression(labels=labels).with_channels(temperature=300 + TIME).with_metadata(name="x")
        dense = Rig(sampling_rate=10.0).measure(ideal)
        assert len(dense) == 1001
        np.testing.assert_allclose(dense.time, np.arange(1001) / 10)
        np.testing.assert_allclose(dense.displacement, np.interp(dense.time, TIME, WAY), atol=1e-15)
        np.testing.assert_allclose(dense.force, np.interp(dense.time, TIME, lubricated(WAY)), atol=1e-12)
        np.testing.assert_allclose(dense.channel("temperature"), 300 + dense.time)
        assert dense.name == "x" and dense.fields is None
        # Of the last sample before, also where 0.1 s is no binary number.
        before = np.searchsorted(TIME, np.arange(1001) * 0.1 + 1e-9, "right") - 1
        np.testing.assert_array_equal(dense.labels["cycle"], before)
        np.testing.assert_array_equal(dense.labels["segment"], SEGMENT[before])
        friction = Rig(sampling_rate=10.0, guide_friction=0.04).measure(ideal).force - dense.force
        np.testing.assert_allclose(friction[np.arange(0, 1001, 10)][[0, 1, 40, 41, 60, 61]],
                                   [0, 0.04, 0.04, 0, 0, -0.04], atol=1e-12)
        assert Rig(sampling_rate=10.0).count_readings(TIME) == 1001 and Rig().count_readings(TIME) == 91
        sparse = Rig(sampling_rate=0.3).measure(ideal)
        np.testing.assert_allclose(sparse.time, np.arange(31) / 0.3)

    def test_too_many_samples_are_refused(self):
        with pytest.raises(ts.InputError, match="more than 10000000 samples") as caught:
            Rig(sampling_rate=1e9).measure(ELASTIC)
        assert caught.value.field == "rig.sampling_rate"

    def test_effects_of_time_need_a_time(self):
        without = Recording({"displacement": WAY, "force": lubricated(WAY)})
        np.testing.assert_array_equal(Rig(zero_offset=1.0).measure(without).force, lubricated(WAY) + 1.0)
        with pytest.raises(ts.InputError, match="no 'time'"):
            Rig(latency=0.1).measure(without)


class TestInertia:
    def test_mass_times_acceleration_of_the_report(self):
        """The inertia force of the tool is right for a motion with a gentle start, in air and in tissue."""
        time = np.linspace(0.0, 0.5, 201)
        way = 5e-3 * (1 - np.cos(2 * np.pi * time / 0.5))
        true = Recording({"time": time, "displacement": way, "force": 100.0 * way})
        read = Rig(faults=[ts.FAULTS["inertia"](0.3)]).read(true)
        expected = 0.3 * 5e-3 * (2 * np.pi / 0.5)**2 * np.cos(2 * np.pi * time / 0.5)
        np.testing.assert_allclose((read.force - true.force)[2:-2], expected[2:-2], rtol=0, atol=1e-3 * expected.max())

    def test_none_of_an_even_motion(self):
        true = Recording({"time": TIME[RAMP], "displacement": WAY[RAMP], "force": WAY[RAMP]})
        rig = Rig(faults=[ts.FAULTS["inertia"](0.3)])
        np.testing.assert_allclose(rig.read(true).force, true.force, atol=1e-12)
        assert rig.needs_time and not rig.with_motion_effects_only.faults

    def test_no_mass(self):
        with pytest.raises(ts.InputError, match=r"must be finite and 0 or more; got -0\.1 kg"):
            ts.FAULTS["inertia"](-0.1)


class TestNoise:
    TIMES = np.cumsum(np.random.default_rng(5).uniform(0.01, 0.09, 40_000))

    def noise(self, **rig):
        still = Recording({"time": self.TIMES, "displacement": np.zeros(40_000), "force": np.zeros(40_000)})
        return Rig(force_noise=0.02, **rig).measure(still).force

    def test_white(self):
        noise = self.noise(seed=1)
        assert noise.std() == pytest.approx(0.02, rel=0.02)
        assert abs(np.corrcoef(noise[1:], noise[:-1])[0, 1]) < 0.02

    def test_coloured_has_the_stated_autocorrelation_at_uneven_times(self):
        noise, correlation_time = self.noise(seed=1, noise_correlation_time=0.2), 0.2
        assert noise.std() == pytest.approx(0.02, rel=0.05)
        for lag in (1, 4, 10):
            gap = self.TIMES[lag:] - self.TIMES[:-lag]
            expected = np.mean(np.exp(-gap / correlation_time))
            assert np.mean(noise[lag:] * noise[:-lag]) / 0.02**2 == pytest.approx(expected, abs=0.05)

    def test_seed(self):
        np.testing.assert_array_equal(self.noise(seed=4), self.noise(seed=4))
        assert abs(np.corrcoef(self.noise(seed=4), self.noise(seed=5))[0, 1]) < 0.02


class TestBadValues:
    @pytest.mark.parametrize(("field", "value"), [
        ("compliance", -1e-5), ("backlash", -1e-5), ("latency", -0.1), ("guide_friction", -1.0), ("rate_damping", -1.0),
        ("force_noise", -0.1), ("noise_correlation_time", -1.0), ("force_resolution", -1.0),
        ("displacement_resolution", -1e-6), ("sampling_rate", 0.0), ("sampling_rate", -5.0), ("sensor_gain", -1.0),
        ("displacement_gain", -1.5), ("contact_offset", float("nan")), ("zero_offset", float("inf")),
        ("sensor_drift", "fast"), ("step_loss", None), ("step_loss_depth", True), ("seed", -1), ("seed", 1.5),
        ("compliance", 10**400),
    ])
    def test_names_the_field(self, field, value):
        with pytest.raises(ts.InputError) as caught:
            Rig(**{field: value})
        assert caught.value.field == f"rig.{field}"
        assert f"got {value:g}" if isinstance(value, float) else f"got {value!r}." in caught.value.problem
