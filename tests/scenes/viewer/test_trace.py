"""Trace: thinning of ticks, reversals of the motion, and the saved recording."""

import tomllib
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import tissue_sim as ts
from calibration.campaign.campaign import load_campaign
from haptics.loop.ring import PAUSED, TICK
from scenes.catalogue import SCENES, make_kind_specimen_tool_metadata
from scenes.cli import main
from scenes.viewer.page.saving import make_trace_file_bytes_by_name
from scenes.viewer.scene import Scene
from scenes.viewer.trace import SETTINGS, Trace, interpolate_branch_force, make_csv_and_sidecar_bytes_by_name
from tissue_sim.recording.segmentation import MOTION_SETTINGS, find_strictly_monotone_sample_indices
from tissue_sim.tool_force import ForceStatus


def ticks(time, depth, force=None, flags=0):
    """Records of the ring for a motion; the default force is that of a spring of 200 N/m."""
    records = np.zeros(len(time), TICK)
    records["time"], records["tool_depth"], records["flags"] = time, depth, flags
    records["tissue_force"] = 200.0 * np.asarray(depth) if force is None else force
    return records


def played(corners, seconds, *, noise=0.0, seed=0):
    """Ticks at 1 kHz of a piecewise linear motion through (time, depth) corners, up to `seconds`."""
    time = np.arange(0.0, seconds, 1e-3)
    depth = np.interp(time, *np.transpose(corners)) + noise * np.random.default_rng(seed).uniform(-1, 1, time.size)
    return ticks(time, depth)


def fed(records, catch=40, **options):
    """Trace that received the ticks in batches of a given size."""
    trace = Trace(**options)
    for first in range(0, len(records), catch):
        trace.append_ticks_and_count_new_points(records[first:first + catch])
    return trace


CYCLE = [(0, 0), (5, 10e-3), (8, 10e-3), (13, 0), (14, 0)]


def test_kept_points_have_the_steps_of_the_settings():
    records = played(CYCLE, 14)
    records["tissue_force"] = 0.0
    trace = fed(records)
    step, way = np.diff(trace.time), np.abs(np.diff(trace.depth))
    # The times are of 1 kHz ticks: a kept one may come a tick after it is due.
    assert step.min() >= SETTINGS.shortest - 1.1e-3
    assert step.max() <= SETTINGS.longest + SETTINGS.shortest + 1e-3
    assert (way[step < SETTINGS.longest - 1e-9] >= SETTINGS.depth_step - 1e-12).all()
    assert way.max() < 2 * SETTINGS.depth_step
    assert len(trace) < 1300 < 14_000


def test_rendered_force_and_tissue_force_are_kept():
    records = played(CYCLE, 14)
    records["force"] = np.minimum(records["tissue_force"], 1.2)
    trace = fed(records)
    np.testing.assert_array_equal(trace.rendered_force, np.minimum(trace.force, 1.2))
    assert trace.rendered_force.max() == 1.2 < trace.force.max()


def test_force_changes_of_a_standing_tool_are_kept():
    time = np.arange(0, 1, 1e-3)
    trace = fed(ticks(time, np.full(time.size, 5e-3), np.exp(-time / 0.05)))
    early = trace.time < 0.08
    assert early.sum() > 10 and np.diff(trace.time[~early]).max() > 0.9 * SETTINGS.longest


@pytest.mark.slow
def test_the_batch_size_does_not_change_the_points():
    records = played(CYCLE, 14)
    points = [(each.time.tolist(), each.depth.tolist(), each.force.tolist())
              for each in (fed(records, catch) for catch in (1, 7, 40, 14_000))]
    assert points[0] == points[1] == points[2] == points[3]


def test_paused_and_nonfinite_ticks_are_skipped():
    records = played(CYCLE, 14)
    records["flags"][2000:3000] = PAUSED
    records["tool_depth"][4000:4500] = np.nan
    records["tissue_force"][6000:6500] = np.inf
    trace = fed(records)
    for begin, end in ((2, 3), (4, 4.5), (6, 6.5)):
        assert not ((trace.time >= begin) & (trace.time < end - 1e-9)).any()
    assert np.isfinite(trace.depth).all() and np.isfinite(trace.force).all()
    assert Trace().append_ticks_and_count_new_points(records[2000:3000]) == 0


def test_fading_forces_are_not_drawn_and_late_forces_not_recorded():
    records = played(CYCLE, 14)
    for second, status in enumerate(ForceStatus):
        records["status"][1000 * second : 1000 * second + 500] = status
    trace = fed(records)
    drawn = {int(time) for time in trace.time if time < len(ForceStatus) and time % 1 < 0.5 - 1e-9}
    assert drawn == {ForceStatus.CONVERGED, ForceStatus.LATE}
    assert trace.is_late.any() and (np.floor(trace.time[trace.is_late]) == ForceStatus.LATE).all()
    recorded = trace.make_equilibrium_recording({}).time + trace.time[0]
    assert np.isin(recorded, trace.time[~trace.is_late]).all() and len(recorded) == (~trace.is_late).sum()
    records["status"] = ForceStatus.LATE
    with pytest.raises(ts.InputError, match="two equilibrium points"):
        fed(records).make_equilibrium_recording({})


def test_the_oldest_points_are_dropped_at_the_limit():
    records = played([(0, 0), *((i + 1, 5e-3 * ((i + 1) % 2)) for i in range(20))], 20)
    whole, short = fed(records), fed(records, max_points=500)
    assert len(short) == 500 < len(whole)
    for name in ("time", "depth", "force"):
        assert getattr(short, name).tolist() == getattr(whole, name)[-500:].tolist()
    assert short._points.shape[1] == 1000
    for mine, full in zip(short.get_newest_loading_and_unloading(), whole.get_newest_loading_and_unloading(),
                          strict=True):
        assert mine.time.tolist() == full.time.tolist()


def test_a_new_loop_clears_the_trace():
    trace = fed(played(CYCLE, 14))
    trace.append_ticks_and_count_new_points(played([(0, 1e-3), (1, 2e-3)], 1))
    assert trace.time[-1] < 1.0 and trace.depth.min() == pytest.approx(1e-3)
    trace.delete_all_points()
    assert len(trace) == 0 and trace.get_newest_loading_and_unloading() == (None, None)


def test_newest_branches_of_two_cycles():
    trace = fed(played([(0, 0), (4, 8e-3), (8, 2e-3), (12, 10e-3), (14, 6e-3)], 14))
    load, unload = trace.get_newest_loading_and_unloading()
    assert (load.depth.min(), load.depth.max()) == pytest.approx((2e-3, 10e-3), abs=2 * SETTINGS.depth_step)
    assert (unload.depth.min(), unload.depth.max()) == pytest.approx((6e-3, 10e-3), abs=2 * SETTINGS.depth_step)
    assert load.time[0] == pytest.approx(8, abs=0.03) and unload.time[0] == pytest.approx(12, abs=0.03)
    assert load.time[-1] == unload.time[0]


def test_an_unloading_must_exceed_the_hysteresis():
    for back, branches in ((0.8 * MOTION_SETTINGS.hysteresis, 1), (1.6 * MOTION_SETTINGS.hysteresis, 3)):
        trace = fed(played([(0, 0), (2, 5e-3), (2.1, 5e-3 - back), (4, 9e-3)], 4))
        assert len(trace._list_branch_directions_and_indices()) == branches


def test_tremor_of_a_hand_is_no_reversal():
    trace = fed(played(CYCLE, 14, noise=0.45 * MOTION_SETTINGS.hysteresis))
    assert [direction for direction, *_ in trace._list_branch_directions_and_indices()] == [1, -1]


def test_a_short_reversal_replaces_only_its_part_of_the_curve():
    trace = fed(played([(0, 0), (4, 8e-3), (4.2, 7e-3), (5, 9e-3)], 5))
    grid = np.linspace(0, 10e-3, 101)
    load, unload = trace.interpolate_newest_force_at_each_depth(grid)
    felt = grid <= 8.9e-3
    np.testing.assert_allclose(load[felt], 200 * grid[felt], atol=1e-9)
    assert np.isnan(load[grid > 9.05e-3]).all()
    assert np.isfinite(unload[(grid > 7.05e-3) & (grid < 7.95e-3)]).all()
    assert np.isnan(unload[(grid < 6.9e-3) | (grid > 8.05e-3)]).all()
    newest, _ = trace.get_newest_loading_and_unloading()
    assert newest.depth.min() > 6.9e-3  # what the newest branch alone would show


def test_the_newest_pass_is_returned():
    records = played([(0, 0), (4, 8e-3), (8, 0), (12, 6e-3)], 12)
    records["tissue_force"] *= np.where(records["time"] > 8, 0.5, 1.0)
    load, _ = fed(records).interpolate_newest_force_at_each_depth(np.array([2e-3, 7e-3]))
    np.testing.assert_allclose(load, [0.5 * 0.4, 1.4], atol=2e-3)


def test_recording_has_segments_and_cycles():
    record = fed(played([*CYCLE, (19, 10e-3), (24, 0)], 24)).make_equilibrium_recording({"name": "felt",
                                                                                         "kind": "needle_indentation"})
    assert record.name == "felt" and record.time[0] == 0
    segment, cycle = record.labels["segment"], record.labels["cycle"]
    middles = {2: ("ramp", 1), 6.5: ("hold", 1), 10: ("unload", 1), 16: ("reload", 2), 21: ("unload", 2)}
    for time, expected in middles.items():
        i = int(np.searchsorted(record.time, time))
        assert (segment[i], cycle[i]) == expected
    changes = np.flatnonzero(segment[1:] != segment[:-1]) + 1
    # A hold begins and ends within the hysteresis of where the tool stood, at 2 mm/s.
    np.testing.assert_allclose(record.time[changes], [5, 8, 13, 14, 19], atol=0.12)
    assert list(segment[changes]) == ["hold", "unload", "hold", "reload", "unload"]


def test_recording_reads_back_equal(tmp_path):
    record = fed(played(CYCLE, 14, noise=0.01e-3)).make_equilibrium_recording({"name": "felt",
                                                                               "kind": "needle_indentation"})
    for name, content in make_csv_and_sidecar_bytes_by_name(record, "felt").items():
        (tmp_path / name).write_bytes(content)
    again = ts.read_recording(tmp_path / "felt.csv", kind="needle_indentation")
    assert set(again.channels) == set(record.channels) == {"time", "displacement", "force"}
    for name in record.channels:  # mm in the file: the last digit of a metre may change
        np.testing.assert_allclose(again.channel(name), record.channel(name), rtol=4e-16, atol=0)
    for name in ("segment", "cycle"):
        assert again.labels[name].tolist() == record.labels[name].tolist()


@pytest.mark.parametrize(("kind", "specimen", "tool", "stated"), [
    ("needle_indentation", ts.Specimen(0.040, 0.070), ts.Tool("sphere", radius=6e-3),
     {"shape": "cylinder", "radius_mm": 40.0, "height_mm": 70.0, "tool": "sphere", "tool_radius_mm": 6.0}),
    ("bonded_compression", ts.Block(0.020, 0.024, 0.015), None,
     {"shape": "block", "length_mm": 20.0, "width_mm": 24.0, "height_mm": 15.0})])
def test_a_saved_curve_has_the_metadata_of_a_simulated_one(tmp_path, kind, specimen, tool, stated):
    """With these metadata, `import` needs no further information, and its output can be read."""
    tests = {} if tool is None else {"tool": tool}
    experiment = ts.KINDS[kind].experiment(specimen=specimen, protocol=ts.Protocol.ramp(4e-3, 5), **tests)
    scene = Scene(SCENES[kind], experiment, ts.Material("neo_hooke", {"C10": 1000.0}))
    for name, content in make_trace_file_bytes_by_name(scene, fed(played([(0, 0), (5, 4e-3), (10, 0)], 10))).items():
        (tmp_path / name).write_bytes(content)
    felt = ts.read_recording(tmp_path / f"{kind}.csv")
    assert {key: felt.metadata[key] for key in ("kind", "specimen", "tool")} \
        == make_kind_specimen_tool_metadata(kind, experiment)
    assert felt.metadata["simulated"] is True
    assert main(["import", str(tmp_path / f"{kind}.csv"), "-o", str(tmp_path / "campaign.toml")]) == 0
    text = (tmp_path / "campaign.toml").read_text(encoding="utf-8")
    content = tomllib.loads(text)
    said = {**content["specimen"][0], **content["test"][0]}
    assert said["kind"] == kind and {key: said[key] for key in stated} == stated
    assert load_campaign(tmp_path / "campaign.toml").tests[0].specimen == specimen


def test_a_trace_without_equilibria_gives_no_recording():
    with pytest.raises(ts.InputError, match="two equilibrium points"):
        Trace().make_equilibrium_recording({})


depths = st.lists(st.floats(0.0, 0.02), min_size=2, max_size=30)


@settings(max_examples=200, deadline=None)
@given(depths)
def test_a_monotone_branch_is_interpolated_exactly(steps):
    depth = np.cumsum(np.abs(steps) + 1e-6)
    force = np.random.default_rng(len(steps)).normal(size=depth.size)
    assert find_strictly_monotone_sample_indices(depth, 1).tolist() == list(range(depth.size))
    assert find_strictly_monotone_sample_indices(depth[::-1], -1).tolist() == list(range(depth.size))
    assert interpolate_branch_force(depth, force, 1, depth).tolist() == force.tolist()
    assert interpolate_branch_force(depth[::-1], force[::-1], -1, depth).tolist() == force.tolist()


@settings(max_examples=300, deadline=None)
@given(depths, st.sampled_from([1, -1]))
def test_one_way_is_strictly_monotone_and_reaches_both_ends(depth, direction):
    way = direction * np.array(depth)
    kept = find_strictly_monotone_sample_indices(np.array(depth), direction)
    assert (np.diff(way[kept]) > 0).all() and (np.diff(kept) > 0).all()
    assert way[kept].max() == way.max()


def test_standing_samples_at_both_ends_are_removed():
    depth = np.array([0, 0, 0, 1, 2, 3, 3, 3]) * 1e-3
    assert find_strictly_monotone_sample_indices(depth, 1).tolist() == [2, 3, 4, 5]
    assert find_strictly_monotone_sample_indices(depth[::-1], -1).tolist() == [2, 3, 4, 5]


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(st.lists(st.floats(0.001, 0.03), min_size=1, max_size=12), st.integers(0, 2**16))
def test_reversals_are_counted_despite_noise(ways, seed):
    corners = np.concatenate([[0.0], np.cumsum(np.array(ways) * np.resize([1, -1], len(ways)))])
    depth = np.concatenate([np.linspace(a, b, 50) for a, b in pairwise(corners)])
    depth += 0.4 * MOTION_SETTINGS.hysteresis * np.random.default_rng(seed).uniform(-1, 1, depth.size)
    trace = fed(ticks(np.arange(depth.size) * 0.2, depth), 1000)
    assert [direction for direction, *_ in trace._list_branch_directions_and_indices()] \
        == np.resize([1, -1], len(ways)).tolist()
