"""Contact, failure and segments of recordings: small versions of benchmarks/inverse/contact.py, and plain cases."""


import numpy as np
import pytest

import tissue_sim as ts

RECORDINGS = 24


@pytest.fixture(scope="module")
def virtual(benchmark_module):
    """The benchmark ``contact``."""
    return benchmark_module("inverse.contact")


@pytest.mark.slow
def test_intervals_hold_the_truth_and_are_narrow(virtual):
    """Of 24 intervals of 95 %, three or more miss with a probability of 12 %, five or more with 0.5 %."""
    rows = virtual.contacts(RECORDINGS, 11)
    assert sum(row["holds"] for row in rows) >= RECORDINGS - 3
    assert virtual.coverage(rows)[1] <= virtual.WIDEST


def test_failures_are_found_and_intact_tests_are_not_accused(virtual):
    rows = virtual.failures(60, 11)
    broken = [row["right"] for row in rows if row["failure"] != "intact"]
    assert np.mean(broken) >= virtual.FOUND
    assert all(row["right"] for row in rows if row["failure"] == "intact")


def pressed(air=0.5e-3, noise=2e-3, zero=0.03, drift=1e-4, wait=0, samples=400):
    """Time, displacement and force of a plate that comes down through air; 2 mm in all."""
    rng = np.random.default_rng(4)
    displacement = np.append(np.zeros(wait), np.linspace(0.0, 2e-3, samples))
    time = 0.1 * np.arange(displacement.size)
    depth = np.clip(displacement - air, 0.0, None)
    return time, displacement, 800 * depth + zero + drift * time + noise * rng.standard_normal(time.size)


def test_zero_and_drift_of_the_air_are_found_with_the_contact():
    time, displacement, force = pressed()
    contact = ts.find_contact(displacement, force, time)
    assert contact.status == "found" and contact.interval[0] <= 0.5e-3 <= contact.interval[1]
    assert contact.force_zero == pytest.approx(0.03, abs=2e-3)
    assert contact.drift == pytest.approx(1e-4, abs=1e-4)
    assert contact.noise == pytest.approx(2e-3, rel=0.3)
    assert displacement[contact.index - 1] <= contact.displacement < displacement[contact.index]
    way, load = contact.subtract_contact_zero_and_drift(displacement, force, time)
    assert way[contact.index] == pytest.approx(0.0, abs=1e-5) and abs(load[:contact.index].mean()) < 5e-4


def test_a_contact_is_found_although_no_window_fits_better_than_chance():
    """With this noise the p value of every window is below 0.5; in the shortest one few samples are in contact."""
    displacement = 8.9e-5 * np.arange(140)
    stretch = 1 - np.clip(displacement - 3.57e-3, 0.0, None) / 23.5e-3
    noise = np.random.default_rng(83).normal(0.0, 0.012, 140)
    contact = ts.find_contact(displacement, 8.67 * (stretch**-2 - stretch) + noise, 0.178 * np.arange(140))
    assert contact.status == "found" and contact.displacement == pytest.approx(3.57e-3, abs=0.1e-3)


@pytest.mark.parametrize("samples", [300, 20000])
def test_a_clear_contact_is_found_where_the_law_describes_no_long_window(samples):
    """Simulated data without noise: each misfit is significant, and that of a straight line is the least so."""
    displacement = np.linspace(0.0, 6e-3, samples)
    depth = np.clip(displacement - 1.5e-3, 0.0, None)
    noise = 1e-6 * np.random.default_rng(5).standard_normal(samples)
    contact = ts.find_contact(displacement, 200 * depth + 3e5 * np.clip(depth - 1e-3, 0.0, None) ** 2 + noise)
    assert contact.status == "found" and contact.displacement == pytest.approx(1.5e-3, abs=0.06e-3)


def test_a_contact_before_the_recording_is_not_given_a_place():
    """A settled preload: the force is there before the motion, and rises with it."""
    time, displacement, force = pressed(air=-0.2e-3, wait=60)
    contact = ts.find_contact(displacement, force, time)
    assert contact.status == "before" and np.isneginf(contact.interval[0]) and contact.interval[1] < 0.1e-3
    recording = ts.Recording({"time": time, "displacement": displacement, "force": force})
    segments = ts.find_segments(recording, "lubricated_compression")
    assert segments.labels[0] == "preload" and segments.labels[-1] == "ramp"
    assert any("settled preload" in line for line in segments.warnings)


def test_air_alone_has_no_contact():
    time, displacement, force = pressed(air=5e-3)
    assert ts.find_contact(displacement, force, time).status == "none"


def test_a_soft_start_is_not_air():
    """A force that stiffens, from the first sample on."""
    displacement = np.linspace(0.0, 2e-3, 300)
    force = 20 * displacement + 200 * np.clip(displacement - 1e-3, 0, None)
    force = force + 1e-4 * np.random.default_rng(1).standard_normal(300)
    assert ts.find_contact(displacement, force).status != "found"


def test_a_relaxing_hold_and_a_slower_ramp_are_no_failure():
    time = np.arange(0.0, 60.0, 0.1)
    displacement = np.interp(time, [0, 2, 40, 60], [0, 4e-3, 5e-3, 5e-3])
    force = np.zeros(time.size)
    memory = 0.0
    for k, gain in enumerate(np.diff(displacement, prepend=0.0)):
        memory = memory * np.exp(-0.1 / 3.0) + gain
        force[k] = 300 * displacement[k] + 900 * memory
    assert force[300] < 0.7 * force[20]
    assert ts.find_failure(displacement, force, time) is None


def test_a_specimen_that_ruptures_while_it_is_held():
    rng = np.random.default_rng(5)
    time = np.arange(0.0, 60.0, 0.1)
    displacement = np.minimum(0.2e-3 * time, 2e-3) + 1e-7 * rng.standard_normal(time.size)
    force = 1e3 * displacement * np.where(time > 10, 0.7 + 0.3 * np.exp(-(time - 10) / 4), 1.0)
    force[time > 40] *= 0.2
    failure = ts.find_failure(displacement, force, time)
    assert failure.mode == "rupture" and time[failure.index] == pytest.approx(40.0, abs=0.11)
    assert ts.find_failure(displacement[time < 40], force[time < 40], time[time < 40]) is None


def test_a_needle_that_punctures_drops_and_goes_on():
    displacement = np.linspace(0.0, 10e-3, 500)
    force = np.where(displacement < 6e-3, displacement, 0.5 * displacement + 0.2e-3) * 500
    failure = ts.find_failure(displacement, force, 0.1 * np.arange(500))
    assert failure.mode == "drop" and failure.displacement == pytest.approx(6e-3, abs=0.05e-3)
    assert not failure.recovered and failure.lost == pytest.approx(0.47, abs=0.03)


def test_segments_of_a_whole_test_and_of_its_simulation_are_the_same():
    protocol = ts.Protocol.parse("ramp 2mm @0.5mm/s; unload; ramp 2mm @0.5mm/s; unload; ramp 4mm @0.5mm/s; hold 10s; "
                                 "unload", points=401)
    recording = ts.Recording({"time": protocol.time, "displacement": protocol.displacement,
                              "force": 100 * protocol.displacement})
    found = ts.find_segments(recording, "lubricated_compression")
    assert [name for name, *_ in found.iterate_segment_names_and_bounds()] \
        == ["preconditioning", "ramp", "hold", "unload"]
    assert found.failure is None and not found.stated
    stated = ts.find_segments(ts.Recording(recording.channels, {"segment": protocol.segment}), "lubricated_compression")
    assert stated.stated and stated.labels.tolist() == protocol.segment.tolist()
    assert sum(end - first for _, first, end in found.iterate_segment_names_and_bounds()) == len(recording)


def test_a_preload_is_a_stop_under_little_force():
    protocol = ts.Protocol.parse("ramp 0.6mm @0.1mm/s; hold 5s; ramp 6mm @0.1mm/s", points=301)
    time = np.arange(0.0, protocol.time[-1], 0.1)
    displacement = np.interp(time, protocol.time, protocol.displacement)
    force = 500 * np.clip(displacement - 0.4e-3, 0, None) + 1e-3 * np.random.default_rng(2).standard_normal(time.size)
    recording = ts.Recording({"time": time, "displacement": displacement, "force": force})
    names = [name for name, *_ in ts.find_segments(recording).iterate_segment_names_and_bounds()]
    assert names == ["approach", "preload", "ramp"]


@pytest.mark.parametrize("samples", [3, 11])
def test_too_few_samples_are_refused_in_one_sentence(samples):
    with pytest.raises(ts.InputError, match="at least 12"):
        ts.find_contact(np.linspace(0, 1e-3, samples), np.zeros(samples))
    with pytest.raises(ts.InputError, match="differ in shape"):
        ts.find_contact(np.linspace(0, 1e-3, 20), np.zeros(samples))


@pytest.mark.slow
def test_brain_fails_at_its_largest_stress_and_silicones_stay_intact(data_folder):
    for path in sorted((data_folder / "brain_tension_damage").glob("brain_*.csv")):
        stretch, stress = np.loadtxt(path, delimiter=",", skiprows=1).T
        recording = ts.Recording({"stretch": stretch, "nominal stress": 1e3 * stress})
        found = ts.find_segments(recording, "uniaxial_tension")
        assert found.failure.index == np.argmax(stress) and found.contact.status == "before"
    for path in sorted((data_folder / "ecoflex_compression").glob("*_A1.csv")):
        recording = ts.read_recording(path, format="instron")
        assert ts.find_segments(recording, "lubricated_compression").failure is None
