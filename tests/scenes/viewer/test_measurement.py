"""Measurement: replicates on a common grid, residual and RMSE of the model, and the motion to simulate."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import tissue_sim as ts
from scenes.viewer.measurement import (
    build_measurement_from_replicates,
    compute_force_residual,
    interpolate_loading_and_unloading,
    make_first_cycle_motion_protocol,
)
from tissue_sim.experiment.kinds.standard_tests import NEEDLE
from tissue_sim.recording.segmentation import find_loading_and_unloading_indices

DEPTH = 10e-3


def tried(force_in, force_out=None, *, points=201, hold=0, labels=True, noise=0.0, seed=0, deepest=DEPTH,
          **metadata):
    """Recording of a ramp, a hold with relaxation and an unloading at 1 mm/s; forces are functions of depth in m."""
    there = np.linspace(0, deepest, points)
    depth, force, segment = [there], [force_in(there)], ["ramp"] * points
    if hold:
        depth.append(np.full(hold, deepest))
        force.append(np.linspace(force_in(deepest), (force_out or force_in)(deepest), hold + 1)[1:])
        segment += ["hold"] * hold
    if force_out is not None:
        back = there[-2::-1]
        depth.append(back)
        force.append(force_out(back))
        segment += ["unload"] * back.size
    depth, force = np.concatenate(depth), np.concatenate(force)
    force = force + noise * np.random.default_rng(seed).normal(size=force.size)
    channels = {"time": np.arange(depth.size) * (deepest / (points - 1) / 1e-3), "displacement": depth, "force": force}
    return ts.Recording(channels, {"segment": segment} if labels else {}, {"name": f"run {seed}", **metadata})


def stiff(d):
    return 200 * d + 8e3 * d**2


def soft(d):
    return 150 * d + 8e3 * d**2


@pytest.mark.parametrize("labels", [True, False])
def test_branches_exclude_the_hold(labels):
    recording = tried(stiff, soft, hold=40, labels=labels)
    load, unload = find_loading_and_unloading_indices(recording)
    np.testing.assert_allclose(recording.force[load], stiff(recording.displacement[load]), rtol=1e-12)
    np.testing.assert_allclose(recording.force[unload], soft(recording.displacement[unload]), rtol=1e-12)
    assert load[[0, -1]].tolist() == [0, 200] and unload[[0, -1]].tolist() == [240, 440]


def test_unknown_labels_are_ignored():
    recording = tried(stiff, soft, hold=40)
    foreign = replace(recording, labels={"segment": np.char.add("phase ", recording.labels["segment"])})
    for found, expected in zip(find_loading_and_unloading_indices(foreign),
                               find_loading_and_unloading_indices(recording), strict=True):
        assert found.tolist() == expected.tolist()


def test_a_noisy_displacement_gives_the_same_branches():
    recording = tried(stiff, soft, labels=False, points=2001)
    noise = 0.02e-3 * np.random.default_rng(1).normal(size=len(recording))
    load, unload = find_loading_and_unloading_indices(recording.with_channels(displacement=recording.displacement
                                                                              + noise))
    assert load[0] < 40 and 1960 < load[-1] < 2040 and 1960 < unload[0] < 2040 and unload[-1] > 3960
    assert load.size > 300 and unload.size > 300


def test_only_the_first_cycle_is_used():
    one, two = tried(stiff, soft), tried(soft, soft)
    for labels in (True, False):
        both = {name: np.concatenate([one.channel(name), two.channel(name)]) for name in ("displacement", "force")}
        segment = [*one.labels["segment"], *np.where(two.labels["segment"] == "ramp", "reload", "unload")]
        load, unload = find_loading_and_unloading_indices(ts.Recording(both, {"segment": segment} if labels else {}))
        assert load[[0, -1]].tolist() == [0, 200] and unload[[0, -1]].tolist() == [200, 400]


def test_the_envelope_covers_the_replicates():
    runs = [tried(lambda d, k=k: k * stiff(d), soft, hold=20) for k in (0.9, 1.0, 1.2)]
    measured = build_measurement_from_replicates(runs)
    assert (measured.depth[0], measured.depth[-1]) == (0.0, DEPTH)
    expected = stiff(measured.depth)
    np.testing.assert_allclose(measured.load.mean, 3.1 / 3 * expected, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(measured.load.low, 0.9 * expected, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(measured.load.high, 1.2 * expected, rtol=1e-4, atol=1e-9)
    np.testing.assert_allclose(measured.load.standard_deviation, np.std([0.9, 1.0, 1.2], ddof=1) * expected, rtol=1e-4,
                               atol=1e-9)
    np.testing.assert_allclose(measured.unload.high - measured.unload.low, 0, atol=1e-12)


def test_the_mean_ends_at_the_shortest_replicate():
    measured = build_measurement_from_replicates([tried(stiff), tried(stiff, deepest=6e-3)])
    assert measured.depth[-1] == DEPTH and measured.unload is None
    assert np.isfinite(measured.load.mean[measured.depth <= 6e-3]).all()
    assert np.isnan(measured.load.mean[measured.depth > 6.001e-3]).all()


def test_noise_equals_the_noise_of_the_sensor():
    measured = build_measurement_from_replicates([tried(stiff, soft, noise=0.02, seed=seed) for seed in range(6)])
    assert measured.replicate_force_rms_scatter == pytest.approx(0.02, rel=0.1)
    assert build_measurement_from_replicates([tried(stiff)]).replicate_force_rms_scatter is None


def test_residual_and_rmse_of_a_known_error():
    """The model is 3 % too stiff in loading and 0.05 N too low in unloading; the RMSE is computed by hand."""
    measured = build_measurement_from_replicates([tried(stiff, soft, hold=20) for _ in range(2)])
    model = tried(lambda d: 1.03 * stiff(d), lambda d: soft(d) - 0.05, hold=20, points=401)
    found = compute_force_residual(model, measured)
    np.testing.assert_allclose(found.load, 0.03 * stiff(found.depth), atol=1e-6)
    np.testing.assert_allclose(found.unload, -0.05, atol=1e-5)
    wrong = np.concatenate([0.03 * stiff(np.linspace(0, DEPTH, 201)), np.full(201, -0.05)])
    assert found.rmse == pytest.approx(np.sqrt(np.mean(wrong**2)), rel=1e-4)
    assert found.samples == 2 * (201 + 201)


def test_the_rmse_of_the_true_curve_is_the_noise():
    measured = build_measurement_from_replicates([tried(stiff, soft, hold=30, noise=0.02, seed=seed)
                                                  for seed in range(3)])
    assert compute_force_residual(tried(stiff, soft, hold=30), measured).rmse == pytest.approx(0.02, rel=0.06)


def test_a_model_that_reaches_no_measured_depth_is_refused():
    deep = tried(stiff)
    deep = deep.with_channels(displacement=deep.displacement + 20e-3)
    with pytest.raises(ts.InputError, match="model: must reach the measured depths"):
        compute_force_residual(deep, build_measurement_from_replicates([tried(stiff)]))


@pytest.mark.parametrize("hold", [0, 300])
def test_the_motion_has_few_samples_and_keeps_its_corners(hold):
    runs = [tried(lambda d, k=k: k * stiff(d), soft, points=1001, hold=hold, seed=i)
            for i, k in enumerate((0.8, 1.0, 1.2))]
    found = make_first_cycle_motion_protocol(build_measurement_from_replicates(runs))
    assert 40 <= found.time.size <= 50
    assert found.displacement[0] == 0 and found.depth == DEPTH and found.displacement[-1] == 0
    assert found.time[-1] == runs[0].time[-1]
    np.testing.assert_allclose(np.interp(runs[0].time, found.time, found.displacement), runs[0].displacement, atol=1e-9)
    assert set(found.segment) == {"ramp", "unload"} | ({"hold"} if hold else set())


def test_motion_ends_after_the_first_unloading():
    one = tried(stiff, soft)
    both = ts.Recording({"time": np.arange(2 * len(one)) * 0.05,
                         "displacement": np.tile(one.displacement, 2), "force": np.tile(one.force, 2)})
    assert make_first_cycle_motion_protocol(build_measurement_from_replicates([both])).time[-1] \
        == pytest.approx(one.time[-1])


def test_a_recording_without_time_uses_the_stated_speed():
    def bare(**metadata):
        run = tried(stiff, **metadata)
        return build_measurement_from_replicates(
            [ts.Recording({name: run.channel(name) for name in ("displacement", "force")},
                          metadata=run.metadata)])

    assert make_first_cycle_motion_protocol(bare(speed_mm_s=2.0)).time[-1] == pytest.approx(5.0)
    assert make_first_cycle_motion_protocol(bare(speed_mm_s=2.0), speed=4e-3).time[-1] == pytest.approx(2.5)
    assert make_first_cycle_motion_protocol(bare()).time[-1] == pytest.approx(10 / 0.248)
    with pytest.raises(ts.InputError, match=r"speed: must be positive and finite; got 0 m/s"):
        make_first_cycle_motion_protocol(bare(), speed=0.0)


@pytest.mark.slow
def test_thinning_the_motion_adds_less_error_than_the_noise():
    """The virtual measurement has 601 samples, the simulation for comparison 50."""
    protocol = ts.Protocol.parse("ramp 8mm @1mm/s; hold 3s; unload", points=301)
    experiment = NEEDLE.experiment(specimen=ts.Specimen(0.04, 0.07), protocol=protocol)
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4),
                           viscoelastic=ts.Prony((ts.PronyTerm(0.3, 2.0),)))
    true = ts.simulate(ts.Model(experiment, material), resolution="fast")
    measured = build_measurement_from_replicates([ts.Rig(force_noise=0.02, seed=seed).measure(true)
                                                  for seed in range(3)])
    model = ts.Model(replace(experiment, protocol=make_first_cycle_motion_protocol(measured)), material)
    short = ts.simulate(model, resolution="fast")
    assert len(short) <= 50
    assert compute_force_residual(short, measured).rmse == pytest.approx(0.02, rel=0.05)
    assert compute_force_residual(short, build_measurement_from_replicates([true])).rmse < 5e-4


def read_measurement_files(paths, **reading):
    return build_measurement_from_replicates([each for path in paths for each in ts.read_recordings(path, **reading)])


def test_files_are_read_and_invalid_files_are_named(tmp_path):
    for seed in range(2):
        ts.write_recording(tried(stiff, soft, seed=seed, kind="needle_indentation"), tmp_path / f"run_{seed}.csv")
    measured = read_measurement_files([tmp_path / "run_0.csv", tmp_path / "run_1.csv"])
    assert (len(measured.recordings), measured.recordings[0].name,
            measured.stated_test_kind) == (2, "run 0", "needle_indentation")
    ts.write_recording(tried(stiff, kind="bonded_compression"), tmp_path / "other.csv")
    with pytest.raises(ts.InputError, match=r"other\.csv: kind: must be the same in all recordings"):
        read_measurement_files([tmp_path / "run_0.csv", tmp_path / "other.csv"])
    stretch = np.linspace(1, 0.8, 9)
    ts.write_recording(ts.Recording({"stretch": stretch, "nominal stress": stretch - 1}), tmp_path / "stress.csv")
    with pytest.raises(ts.InputError, match=r"stress\.csv: displacement: must be a channel of the recording"):
        read_measurement_files([tmp_path / "stress.csv"])
    with pytest.raises(ts.InputError, match=r"short\.csv: must have at least 5 samples; got 4"):
        build_measurement_from_replicates([tried(stiff, source="short.csv").select(slice(0, 4))])
    out = tried(stiff)
    ts.write_recording(out.with_channels(displacement=-out.displacement), tmp_path / "pull.csv")
    with pytest.raises(ts.InputError, match=r"pull\.csv: displacement: must increase above its first value"):
        read_measurement_files([tmp_path / "pull.csv"])
    with pytest.raises(ts.InputError, match=r"gone\.csv"):
        read_measurement_files([tmp_path / "gone.csv"])
    with pytest.raises(ts.InputError, match="must contain at least one recording; got none"):
        read_measurement_files([])


def test_measured_silicone_has_the_peak_forces_of_its_files(data_folder):
    """Five compressions of one specimen to 20 mm; the peak forces of the files bound the mean."""
    files = sorted((data_folder / "ecoflex_compression").glob("EF10_0T_A*.csv"))
    columns = {"time": "Time (s)", "displacement": "Compression (mm)", "force": "Load (N)"}
    measured = read_measurement_files(files, columns=columns, skip_lines=7)
    assert len(measured.recordings) == 5 and measured.unload is None
    at = [np.interp(15e-3, each.displacement, each.force) for each in measured.recordings]
    i = int(np.argmin(abs(measured.depth - 15e-3)))
    assert min(at) * 0.97 < measured.load.mean[i] < max(at) * 1.03
    assert np.isfinite(measured.load.mean[5:190]).all()
    assert 0 < measured.replicate_force_rms_scatter < 0.1 * max(at)
    found = make_first_cycle_motion_protocol(measured)
    assert found.time.size <= 50 and found.depth == pytest.approx(20e-3, rel=0.02)


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(st.lists(st.floats(1e-5, 1e-3), min_size=6, max_size=40), st.integers(0, 2**16))
def test_monotone_depth_in_gives_the_same_force_out(steps, seed):
    depth = np.cumsum(steps)
    force = np.random.default_rng(seed).normal(size=depth.size)
    load, unload = interpolate_loading_and_unloading(ts.Recording({"displacement": depth, "force": force}), depth)
    np.testing.assert_allclose(load, force, rtol=1e-9, atol=1e-12)
    assert np.isnan(unload).all()
    back = ts.Recording({"displacement": np.append(depth, depth[-2::-1]), "force": np.append(force, 2 * force[-2::-1])})
    load, unload = interpolate_loading_and_unloading(back, depth)
    np.testing.assert_allclose(load, force, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(unload[:-1], 2 * force[:-1], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize(("said", "expected"), [
    ({}, ""), ({"tool": {"shape": "flat", "radius_mm": 8.0}}, ""), ({"tool": {"shape": "flat"}}, ""),
    ({"tool": {"shape": "cone", "radius_mm": 8.0}}, "cone of 8 mm radius"), ({"tool": {"shape": "cone"}}, "cone"),
    ({"tool": {"shape": "flat", "radius_mm": 4.0}}, "flat of 4 mm radius"), ({"tool": "a nail"}, ""),
])
def test_a_measurement_says_when_it_was_made_with_another_tool(said, expected):
    depth = np.linspace(0.0, 5e-3, 40)
    recording = ts.Recording({"time": depth / 1e-3, "displacement": depth, "force": 200.0 * depth}, {},
                             {"name": "a", **said})
    assert build_measurement_from_replicates([recording]).describe_deviating_tool_or_empty(ts.Tool("flat", 8e-3)) \
        == expected
