"""Outliers, saturation, preload and control, found in the signals of a recording."""

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.errors import InputError
from tissue_sim.recording.cleaning import remove_outliers_and_saturation
from tissue_sim.recording.control import detect_controlled_quantity_and_creep, find_final_oscillation_or_none
from tissue_sim.recording.measures import MEASURES, convert_recording_to_stretch_and_nominal
from tissue_sim.recording.outliers import find_outliers_of_motion_and_load
from tissue_sim.recording.saturation import find_last_digit_step_or_zero
from tissue_sim.recording.screening import estimate_load_at_zero_displacement

TIME = np.arange(126) * 0.2
WAY = 1e-4 * TIME
NOISE = np.random.default_rng(4).normal(0.0, 0.01, TIME.size)


def force(way, height=12.5e-3, area=np.pi * 12.5e-3**2):
    stretch = 1 - np.clip(way, 0, None) / height
    return area * 20e3 * (stretch**-2 - stretch)


FORCE = force(WAY) + NOISE


def relax(elastic, time, fraction, constant):
    """Return the force of a material whose elastic force relaxes by a fraction with one time constant, s.

    Each increment of the elastic force relaxes from its own time on (Boltzmann's superposition)."""
    passed = np.clip(time[:, None] - time[None, :], 0.0, None)
    remaining = 1.0 - fraction * (1.0 - np.exp(-passed / constant))
    return np.sum(np.tril(remaining) * np.diff(elastic, prepend=0.0), axis=1)


def recording(way=WAY, load=FORCE, time=TIME):
    return ts.Recording({"time": time, "displacement": way, "force": load})


def changed(values, samples, value):
    values = values.copy()
    values[samples] = value
    return values


class TestOutliers:
    @pytest.mark.parametrize("samples", [[0], [0, 1], [1], [60], [59, 60, 61], [124], [125], [123, 124, 125]])
    @pytest.mark.parametrize("value", [-5.0, 50.0, 9999.0])
    def test_wrong_forces_are_left_out_wherever_they_are(self, samples, value):
        rest, found = remove_outliers_and_saturation(recording(load=changed(FORCE, samples, value)))
        assert found.left_out_sample_numbers == tuple(sample + 1 for sample in samples)
        assert len(rest) == TIME.size - len(samples)
        assert f"{value:.4g} N" in found.finding_sentences[0]

    @pytest.mark.parametrize("samples", [[0], [0, 1, 2], [60], [60, 61], [125], [124, 125]])
    @pytest.mark.parametrize("value", [-0.7e-3, 9e-3, 9.999])
    def test_wrong_displacements_are_left_out_wherever_they_are(self, samples, value):
        _, found = remove_outliers_and_saturation(recording(way=changed(WAY, samples, value)))
        assert found.left_out_sample_numbers == tuple(each + 1 for each in samples)

    def test_lost_values_of_several_places(self):
        load = FORCE.copy()
        load[[20, 60, 61, 62, 100]] = [9999.0, 0.0, 0.0, 0.0, -40.0]
        assert remove_outliers_and_saturation(recording(load=load))[1].left_out_sample_numbers == (21, 61, 62, 63, 101)

    def test_a_lost_row(self):
        assert remove_outliers_and_saturation(recording(changed(WAY, 60, 0.0),
                                                        changed(FORCE, 60, 0.0)))[1].left_out_sample_numbers == (61,)

    @pytest.mark.parametrize("seed", range(20))
    def test_clean_recordings_lose_no_sample(self, seed):
        rng = np.random.default_rng(seed)
        for way in (WAY, np.clip(WAY - 1e-3, 0, None), WAY.max() - np.abs(2 * WAY - WAY.max()),
                    np.minimum(np.floor(TIME / 5) * 5e-4, WAY.max())):
            for load in (force(way), force(way) + rng.normal(0, 0.1, TIME.size), np.round(force(way) / 0.3) * 0.3):
                assert remove_outliers_and_saturation(recording(way, load))[1].left_out_sample_numbers == ()

    def test_ruptures_punctures_and_starts_from_rest_are_none(self):
        torn = FORCE.copy()
        torn[80:] *= 0.1
        pierced = FORCE - np.where(np.arange(TIME.size) > 70, 2.0, 0.0)
        step = changed(np.full(TIME.size, 2e-3), 0, 0.0)
        relaxing = changed(4.0 + np.exp(-TIME), 0, 0.0) + 0.1 * NOISE
        for way, load in ((WAY, torn), (WAY, pierced), (step, relaxing)):
            assert remove_outliers_and_saturation(recording(way, load))[1].left_out_sample_numbers == ()

    def test_a_file_of_outliers_is_refused_with_their_numbers(self):
        load = FORCE.copy()
        load[5::8] = 100.0
        with pytest.raises(InputError, match=r"outliers \(samples 6, 14"):
            remove_outliers_and_saturation(recording(load=load))

    def test_samples_that_are_listed_are_left_out_and_others_are_named(self):
        rest, found = remove_outliers_and_saturation(recording(load=changed(FORCE, [60, 80], 50.0)), leave_out=[61, 3])
        assert found.left_out_sample_numbers == (3, 61) and len(rest) == TIME.size - 2
        assert found.suspected[0].samples == (81,)
        assert "sample 81 kept" in found.elastic_fit_contradictions[0]

    @pytest.mark.parametrize("way", [changed(WAY, 0, 5e-3) + 1e-3, changed(WAY, [0, 1], 9.999)])
    def test_a_channel_counts_from_its_value_at_a_wrong_first_sample(self, way):
        rest, found = remove_outliers_and_saturation(recording(way=way), zeroed=["displacement"])
        assert rest.displacement[0] == pytest.approx(WAY[len(found.left_out_sample_numbers)], abs=1e-7)

    def test_a_wrong_first_force_keeps_the_zero_of_the_displacement(self):
        rest, _ = remove_outliers_and_saturation(recording(load=changed(FORCE, 0, 9999.0)), zeroed=["displacement"])
        assert rest.displacement[0] == WAY[1]

    @pytest.mark.parametrize("late", [1, 5])
    def test_a_wrong_first_displacement_before_a_late_start(self, late):
        way = np.clip(WAY - WAY[late], 0.0, None)
        rest, _ = remove_outliers_and_saturation(
            recording(way=changed(way, 0, 5e-3) + 1e-3, load=force(way) + 0.1 * NOISE), zeroed=["displacement"])
        assert rest.displacement[0] == pytest.approx(0.0, abs=2e-6)


class TestSaturation:
    @pytest.mark.parametrize(("sign", "limit"), [(1, 5.0), (1, 6.5), (-1, 6.0)])
    def test_a_force_at_its_limit_is_cut_off(self, sign, limit):
        load = sign * np.minimum(FORCE, limit)
        rest, found = remove_outliers_and_saturation(recording(load=load))
        assert found.saturation[0].level == sign * limit
        assert found.left_out_sample_numbers[0] == int(np.argmax(limit <= FORCE)) + 1
        assert "a saturated sensor" in found.finding_sentences[0]
        assert np.abs(rest.force).max() < limit

    def test_a_displacement_at_its_limit_is_cut_off(self):
        _, found = remove_outliers_and_saturation(recording(way=np.minimum(WAY, 2e-3)))
        assert found.saturation[0].channel == "displacement" and found.left_out_sample_numbers[0] == 101

    def test_coarse_sensors_holds_and_air_are_none(self):
        hold = np.minimum(WAY, 2e-3)
        air = np.clip(WAY - 1e-3, 0, None)
        for way, load in ((WAY, np.round(FORCE / 0.3) * 0.3), (hold, force(hold)), (WAY, force(air))):
            assert remove_outliers_and_saturation(recording(way, load))[1].saturation == ()


STRETCH = 1 + 0.5 * TIME / TIME[-1]
NOMINAL = 2e4 * (STRETCH - STRETCH**-2) + np.random.default_rng(5).normal(0.0, 20.0, TIME.size)


def stress_recording(nominal, stress, strain=None, *, stretch=STRETCH, digits=4):
    """A recording whose file holds a measure of stress, with `digits` significant digits, in place of the nominal one.
    """
    values = MEASURES[stress].invert(nominal, stretch)
    motion = stretch if strain is None else MEASURES[strain].invert(stretch)
    scale = 10.0 ** (digits - 1 - np.floor(np.log10(np.abs(values).max())))
    printed = ts.Recording({"time": TIME, "stretch": np.round(motion, 5),
                            "nominal stress": np.round(values * scale) / scale})
    return convert_recording_to_stretch_and_nominal(printed, {"nominal stress": stress}
                                                    | ({"stretch": strain} if strain else {}))


class TestSaturationOfStress:
    @pytest.mark.parametrize("stress", ["true", "second_piola_kirchhoff"])
    @pytest.mark.parametrize("strain", [None, "logarithmic", "green_lagrange"])
    @pytest.mark.parametrize("digits", [4, 6])
    def test_a_force_at_its_limit_does_not_give_a_constant_stress_and_is_cut_off(self, stress, strain, digits):
        limit = 1.4e4
        rest, found = remove_outliers_and_saturation(
            stress_recording(np.minimum(NOMINAL, limit), stress, strain, digits=digits))
        first, last = found.left_out_sample_numbers[0], found.left_out_sample_numbers[-1]
        assert abs(first - (int(np.argmax(limit <= NOMINAL)) + 1)) <= 1 and last == TIME.size
        assert found.saturation[0].level == pytest.approx(limit, rel=2e-3)
        assert "nominal stress that follows from the" in found.finding_sentences[0]
        assert rest.channel("nominal stress").max() < limit * 1.001

    @pytest.mark.parametrize("stress", ["true", "second_piola_kirchhoff"])
    def test_a_constant_column_of_stress_is_cut_off(self, stress):
        limit = 0.7 * MEASURES[stress].invert(NOMINAL, STRETCH).max()
        stated = np.minimum(MEASURES[stress].invert(NOMINAL, STRETCH), limit)
        _, found = remove_outliers_and_saturation(stress_recording(MEASURES[stress].convert(stated, STRETCH), stress))
        assert found.left_out_sample_numbers[0] == int(np.argmax(stated >= limit * (1 - 1e-3))) + 1
        assert f"the {MEASURES[stress].title} stays at" in found.finding_sentences[0]

    @pytest.mark.parametrize("digits", [2, 3, 4, 6])
    @pytest.mark.parametrize("noise", [0.0, 20.0])
    def test_a_smooth_maximum_of_the_force_is_none(self, digits, noise):
        peak = 1.2e4 * (1 - (STRETCH - 1.35) ** 2 / 0.35**2) + noise / 20.0 * (NOMINAL - 2e4 * (STRETCH - STRETCH**-2))
        for nominal in (NOMINAL, peak):
            for stress in ("true", "second_piola_kirchhoff"):
                _, found = remove_outliers_and_saturation(stress_recording(nominal, stress, digits=digits))
                assert found.saturation == ()

    def test_the_last_digit_of_a_column_in_any_unit(self):
        column = np.round(np.random.default_rng(6).normal(0.0, 30.0, 100), 3)
        assert find_last_digit_step_or_zero(column) == pytest.approx(1e-3)
        assert find_last_digit_step_or_zero(4.4482216152605 * column) == pytest.approx(4.4482216152605e-3, rel=1e-4)
        assert find_last_digit_step_or_zero(np.random.default_rng(6).normal(0.0, 30.0, 100)) < 1e-4
        assert find_last_digit_step_or_zero(np.full(5, 3.0)) == 0.0


class TestControl:
    def test_creep_under_a_dead_weight(self):
        time = np.arange(0.0, 200.0)
        way = np.where(time > 0, 2.8e-3 * (1 + 0.6 * (1 - np.exp(-time / 20))), 0.0)
        load = np.where(time > 0, 0.3, 0.0) + 0.001 * np.random.default_rng(1).normal(size=time.size)
        found = detect_controlled_quantity_and_creep(way, load, time)
        assert (found.quantity, found.pattern, found.loading) == ("force", "creep", 2)
        assert found.creep == pytest.approx(0.56, abs=0.06)
        assert "viscoelastic.terms[0].g" in found.sentence

    def test_a_relaxing_staircase_is_not_elastic_and_an_elastic_one_is(self):
        time = np.arange(0.0, 240.0)
        way = 6e-4 * (np.floor(time / 60) + np.clip((time % 60) / 5, 0, 1))
        found = detect_controlled_quantity_and_creep(way, relax(force(way), time, 0.4, 15.0), time)
        assert found.pattern == "staircase" and found.relaxation == pytest.approx(0.35, abs=0.06)
        assert not found.can_elastic_law_describe_loading and "relaxes in holds by up to" in found.sentence
        assert detect_controlled_quantity_and_creep(way, force(way), time).can_elastic_law_describe_loading

    def test_relaxation_of_a_staircase_adds_up_over_the_holds(self):
        # In each hold only the last step of the force relaxes: 4 % of the force or less, but the force at the end is
        # 15 % below that of the elastic material.
        time = np.arange(0.0, 400.0, 0.5)
        way = 6e-4 * (np.floor(time / 40) + np.clip((time % 40) / 2, 0, 1))
        elastic = 1500.0 * way
        load = relax(elastic, time, 0.15, 8.0)
        found = detect_controlled_quantity_and_creep(way, load, time)
        assert found.relaxation == pytest.approx(1 - load[-1] / elastic[-1], abs=0.02)
        assert not found.can_elastic_law_describe_loading

    def test_relaxation_begins_again_after_an_unloading(self):
        """Eight cycles of a ramp, a hold, an unloading and a rest: in each, 4 % of the force relaxes and recovers."""
        cycle = np.interp(np.arange(0.0, 48.0, 0.5), [0.0, 4.0, 24.0, 28.0, 48.0], [0.0, 2e-3, 2e-3, 0.0, 0.0])
        way = np.tile(cycle, 8)
        time = 0.5 * np.arange(way.size)
        found = detect_controlled_quantity_and_creep(way, relax(1500.0 * way, time, 0.04, 5.0), time)
        assert found.relaxation == pytest.approx(0.04, abs=0.02)
        assert found.can_elastic_law_describe_loading

    def test_a_fast_ramp_before_a_hold_is_elastic_and_a_slow_one_is_not(self):
        time = np.arange(0.0, 120.0, 0.5)
        for duration, is_elastic in ((1.0, True), (30.0, False)):
            way = 2e-3 * np.clip(time / duration, 0, 1)
            load = force(way) * (1 - 0.4 * (1 - np.exp(-np.clip(time - duration, 0, None) / 15)))
            assert detect_controlled_quantity_and_creep(way, load, time).can_elastic_law_describe_loading == is_elastic

    @pytest.mark.parametrize("phase", [0.0, 0.2])
    def test_an_oscillation_with_its_loss_factor(self, phase):
        time = np.arange(0.0, 5.0, 0.02)
        way = 1e-3 + 2e-4 * np.sin(2 * np.pi * time)
        load = 2.0 + 0.4 * np.sin(2 * np.pi * time + phase)
        found = detect_controlled_quantity_and_creep(way, load, time)
        assert found.pattern == "oscillation" and found.frequency == pytest.approx(1.0, rel=0.01)
        assert found.loss_factor == pytest.approx(np.tan(phase), abs=0.01)
        assert found.can_elastic_law_describe_loading == (phase == 0.0)

    def test_cycles_that_return_to_rest_are_no_oscillation_around_an_offset(self):
        time = np.arange(0.0, 5.0, 0.02)
        way = 1e-3 * (1 - np.cos(2 * np.pi * time))
        found = find_final_oscillation_or_none(way, force(way), time)
        assert found is not None and found.returns

    def test_an_oscillation_after_a_ramp_does_not_make_the_ramp_preconditioning(self):
        time = np.arange(0.0, 10.0, 0.05)
        way = np.where(time < 5, 2e-4 * time, 1e-3 + 2e-4 * np.sin(2 * np.pi * time))
        found = ts.find_segments(recording(way, force(way), time))
        assert "preconditioning" not in found.labels and found.labels[10] == "ramp"


class TestPreload:
    @pytest.mark.parametrize("shift", [0.1e-3, 0.4e-3, 1e-3])
    def test_a_displacement_zeroed_at_a_preload(self, shift):
        found = estimate_load_at_zero_displacement(WAY, force(WAY + shift) + NOISE)
        assert found.load == pytest.approx(float(force(np.array([shift]))[0]), abs=0.02)
        assert found.shift == pytest.approx(shift, rel=0.15)

    @pytest.mark.parametrize("offset", [-0.3, -1.0])
    def test_a_load_against_the_direction_of_loading(self, offset):
        found = estimate_load_at_zero_displacement(WAY, FORCE + offset + NOISE)
        assert found.load == pytest.approx(offset, abs=0.02)
        assert found.fraction < 0 and found.shift < 0

    def test_loads_that_start_from_zero_or_elsewhere_are_none(self):
        assert estimate_load_at_zero_displacement(WAY, FORCE) is None
        assert estimate_load_at_zero_displacement(WAY + 1e-3, force(WAY + 1e-3)) is None
        assert estimate_load_at_zero_displacement(WAY, np.full(WAY.size, 2.0)) is None


def test_the_loading_from_rest_before_creep_is_kept():
    time = np.arange(60.0)
    way = np.where(time < 4, 10.0 * time, 35.0 + 18.0 * (1 - np.exp(-time / 30)))
    load = np.minimum(0.17 * time, 0.53) + 0.002 * np.sin(7.0 * time)
    load[0] = 0.0
    assert find_outliers_of_motion_and_load(way, load) == ()


class TestFirstSample:
    HELD = np.arange(1.0, 60.0)
    CREPT = np.concatenate([[0.0], 1e-3 * (1 + 0.4 * (1 - np.exp(-HELD / 12)))])

    def test_a_lost_first_load_before_creep_costs_one_sample(self):
        # The ramp before the hold has two samples.
        way, load = np.insert(self.CREPT, 1, 0.6e-3), np.insert(np.where(self.CREPT > 0, 2.0, 0.0), 1, 1.2)
        load += 0.1 * NOISE[:load.size]
        found = find_outliers_of_motion_and_load(way, changed(load, 0, 9999.0))
        assert [(name, group) for name, group, _ in found] == [("load", (0,))]

    def test_creep_is_recognised_where_the_recording_begins_in_the_hold(self):
        load = np.full(self.HELD.size, 2.0) + 0.1 * NOISE[:self.HELD.size]
        assert detect_controlled_quantity_and_creep(self.CREPT[1:], load).pattern == "creep"

    def test_air_at_an_even_speed_is_no_creep(self):
        way = 1e-3 + WAY
        assert detect_controlled_quantity_and_creep(way, 2.0 + force(way - 2e-3) + NOISE).creep == 0.0

    def test_a_hold_below_the_last_digit_of_the_load_is_no_creep(self):
        way = np.concatenate([WAY[:40], np.full(30, WAY[39]), WAY[40:]])
        assert detect_controlled_quantity_and_creep(way, np.round(force(way) / 0.4) * 0.4).creep == 0.0

    def test_two_pauses_with_a_short_motion_between_are_no_creep(self):
        """The force changes by 3 % of its range between the pauses, less than the band in which it counts as held."""
        way = np.concatenate([WAY[:70], np.full(9, WAY[69]), WAY[70:72], np.full(9, WAY[71]), WAY[72:]])
        load = force(way) + 0.3 * np.random.default_rng(2).normal(0.0, 0.01, way.size)
        found = detect_controlled_quantity_and_creep(way, load)
        assert found.creep == 0.0 and found.quantity == "displacement"

    def test_a_stage_whose_answers_come_late_does_not_rest(self):
        """The positions of 12 samples of the unloading change by a fifth of the motion, within 1 % of the depth."""
        time = 0.004 * np.arange(1500)
        true = 6.0 - 2.0 * np.abs(time - 3.0)
        way = true.copy()
        way[1224:1236] = true[1224] + 0.2 * (true[1224:1236] - true[1224])
        load = 0.83 * np.clip(true, 0.0, None) + np.random.default_rng(3).normal(0.0, 0.01, time.size)
        assert detect_controlled_quantity_and_creep(1e-3 * way, load, time).relaxation == 0.0

    @pytest.mark.parametrize("seed", [1, 4, 60, 61])
    def test_a_noisy_ramp_is_no_creep(self, seed):
        """The force of a needle is almost linear, and each part of the ramp lies in the band of a held force."""
        depth = np.linspace(0.0, 10.0, 401)
        noise = np.random.default_rng(seed).normal(0.0, 0.02, depth.size)
        load = np.polyval([8e-4, -2.7e-3, 0.1856, 0.0], depth) + noise
        assert detect_controlled_quantity_and_creep(1e-3 * depth, load).creep == 0.0

    def test_the_number_of_equal_loads_does_not_depend_on_the_thinning(self):
        held = np.arange(1.0, 60.0, 0.002)
        way = np.concatenate([np.linspace(0.0, 1e-3, 40), 1e-3 * (1 + 0.4 * (1 - np.exp(-held / 12)))])
        load = np.concatenate([np.linspace(0.0, 2.0, 40), np.full(held.size, 2.0)])
        load[:40] += 1e-3 * np.sin(np.arange(40.0))
        found = detect_controlled_quantity_and_creep(way, load)
        assert found.pattern == "creep" and found.equal_samples == pytest.approx(held.size, rel=0.01)

    def test_the_zero_of_a_staircase_after_a_wrong_first_displacement(self):
        """The noise of the force hides the corner at the first step; the displacement shows it."""
        rise = np.linspace(0.0, 0.5e-3, 6)
        levels = [np.append(np.full(10, level), level + rise[1:]) for level in (0.5e-3, 1.0e-3, 1.5e-3)]
        way = np.concatenate([rise, *levels, np.full(10, 2e-3)])
        load = changed(force(way) + 15.0 * np.random.default_rng(13).normal(0.0, 0.01, way.size), 0, 0.0)
        cleaned, _ = remove_outliers_and_saturation(recording(changed(way, 0, 9.999), load, 0.4 * np.arange(way.size)),
                                                    zeroed=["displacement"])
        assert cleaned.displacement[-1] == pytest.approx(2e-3, abs=1e-6)

    def test_a_step_away_from_a_single_first_sample_does_not_show_the_zero(self):
        way, load = self.CREPT - 8e-3 * (self.CREPT == 0), np.where(self.CREPT > 0, 2.0, 0.0)
        with pytest.raises(InputError, match="the zero of the displacement is not known"):
            remove_outliers_and_saturation(recording(way - way[0], load, np.arange(float(way.size))),
                                           zeroed=["displacement"])


def test_a_coarse_force_hides_no_preload():
    load = np.round(force(WAY + 0.2e-3) / 0.5) * 0.5
    assert estimate_load_at_zero_displacement(WAY, load).load == pytest.approx(force(np.array([0.2e-3]))[0], rel=0.3)
    assert estimate_load_at_zero_displacement(WAY, np.round(force(WAY) / 0.5) * 0.5) is None
