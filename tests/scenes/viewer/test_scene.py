"""Scene: change of test, tool and interface, and assignment of measurements to kinds of tests."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import tissue_sim as ts
from scenes.catalogue import SCENES
from scenes.viewer.measurement import build_measurement_from_replicates
from scenes.viewer.scene import Scene, limit_lateral_position_to_top_and_range, read_measurements_by_kind
from tissue_sim.snapshot import Snapshot

PUNCH = ts.Tool("flat", radius=0.006, edge_radius=0.001)


def tried(force=1.0, **metadata):
    """Recording of a ramp to 4 mm."""
    depth = np.linspace(0.0, 4e-3, 41)
    return ts.Recording({"time": depth / 1e-3, "displacement": depth, "force": force * 200 * depth}, {}, metadata)


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_has_default_tool_and_interfaces(needle, name):
    there = needle.with_test_and_tool(name)
    kind, experiment = SCENES[name], there.experiment
    assert there.kind is kind
    assert (experiment.tool.shape, experiment.tool.radius) == (kind.tool.shape, kind.tool.radius)
    usual = kind.make_default_interfaces_by_field(kind.tool)
    assert {name: getattr(experiment, name) for name in usual} == usual
    assert experiment.has_lateral_wall == kind.has_lateral_wall
    assert experiment.specimen is needle.experiment.specimen and experiment.protocol is needle.experiment.protocol
    assert (there.material, there.source) == (needle.material, needle.source)
    assert there.model.experiment is experiment and there.max_tool_displacement == 4e-3
    back = there.with_test_and_tool("needle_indentation")
    assert back.experiment.tool == needle.experiment.tool and back.experiment.friction == "bonded"
    assert not back.experiment.has_lateral_wall


def test_another_tool_keeps_the_interfaces(needle):
    own = replace(needle, experiment=replace(needle.experiment, friction="stick", friction_base=0.4, friction_wall=0.2))
    there = own.with_test_and_tool("needle_indentation", tool=PUNCH)
    assert there.experiment.tool is PUNCH
    assert (there.experiment.friction, there.experiment.friction_base, there.experiment.friction_wall) == \
        ("stick", 0.4, 0.2)
    there = there.with_test_and_tool("needle_indentation", friction=0.3)
    assert there.experiment.tool is PUNCH, "the present tool is kept"
    assert (there.experiment.friction, there.experiment.friction_base) == (0.3, 0.4)


def test_another_scene_resets_the_interfaces(needle):
    plates = needle.with_test_and_tool("friction_compression", friction=0.2)
    assert (plates.experiment.friction, plates.experiment.resolved_base_interface) == (0.2, 0.2)
    bonded = plates.with_test_and_tool("bonded_compression")
    assert (bonded.experiment.friction, bonded.experiment.friction_base) == ("bonded", "bonded")


@pytest.mark.parametrize(("name", "changes", "expected"), [
    ("needle", {}, "scene: must be one of lubricated_compression"),
    ("bonded_compression", {"tool": PUNCH},
     "tool: must fit the scene bonded compression; got a 'flat' tool. Choose another tool or scene."),
    ("needle_indentation", {"tool": ts.Tool()},
     "tool: must fit the scene needle indentation; got a 'plate' tool. Choose another tool or scene."),
    ("needle_indentation", {"friction": "sticky"}, "friction"),
    ("needle_indentation", {"friction": 0.3}, "Give the tool an edge radius"),
    ("needle_indentation", {"tool": ts.Tool("sphere", radius=0.005)}, "no flat face to be bonded to"),
    ("needle_indentation", {"tool": ts.Tool("flat", radius=0.05)}, "must be smaller than the specimen's"),
])
def test_invalid_changes_are_refused(needle, name, changes, expected):
    before = needle.experiment
    with pytest.raises(ts.InputError) as caught:
        needle.with_test_and_tool(name, **changes)
    assert expected in str(caught.value) and "\n" not in str(caught.value)
    assert needle.experiment is before


def test_a_measurement_belongs_to_its_kind_of_test(needle):
    measured = build_measurement_from_replicates([tried()])
    scene = replace(needle, measurements={"bonded_compression": measured})
    assert scene.measurement is None
    there = scene.with_test_and_tool("bonded_compression")
    assert isinstance(there, Scene) and there.measurement is measured
    assert there.with_test_and_tool("needle_indentation").measurement is None


def test_recordings_are_grouped_by_kind_of_test(tmp_path):
    paths = [tmp_path / f"{name}.csv" for name in "abcd"]
    for path, recording in zip(paths, (tried(1.0, kind="bonded_compression"), tried(2.0),
                                       tried(3.0, kind="bonded_compression"), tried(4.0)), strict=True):
        ts.write_recording(recording, path)
    found = read_measurements_by_kind(paths, "needle_indentation")
    assert set(found) == {"bonded_compression", "needle_indentation"}
    for kind, factors in (("bonded_compression", (1.0, 3.0)), ("needle_indentation", (2.0, 4.0))):
        assert [each.force[-1] for each in found[kind].recordings] == pytest.approx([0.8 * each for each in factors])
    assert read_measurements_by_kind([], "needle_indentation") == {}


def test_a_recording_of_an_unknown_kind_is_refused(tmp_path):
    path = tmp_path / "pulled.csv"
    ts.write_recording(tried(kind="tension"), path)
    with pytest.raises(ts.InputError) as caught:
        read_measurements_by_kind([path], "needle_indentation")
    assert str(caught.value).startswith(f"{path}: kind: the kind of test of a recording must be one of lubr")
    with pytest.raises(ts.InputError, match=r"nowhere\.csv"):
        read_measurements_by_kind([tmp_path / "nowhere.csv"], "needle_indentation")


def test_reach_of_the_tool(needle):
    """The reach is the whole top surface; for a reduced solid, the box around the first contact."""
    assert needle.allowed_tool_xy_ranges == ((-0.04, 0.04),) * 2 and needle.min_tool_displacement == -5e-3
    block = replace(needle, experiment=replace(needle.experiment, specimen=ts.Block(0.06, 0.05, 0.03)))
    np.testing.assert_allclose(block.allowed_tool_xy_ranges, [(-0.03, 0.03), (-0.025, 0.025)], rtol=1e-8)
    experiment = replace(needle.experiment, approach=ts.Approach(6e-3))
    of_box = replace(needle, experiment=experiment, reduced=SimpleNamespace(box=ts.PoseBox(2e-3, 4e-3), lifting=12))
    np.testing.assert_allclose(of_box.allowed_tool_xy_ranges, [(4e-3, 8e-3), (-2e-3, 2e-3)])
    assert of_box.min_tool_displacement == 0.0
    snapshot = Snapshot(ts.Pose.at_depth(0.0), 0.0, None)
    assert limit_lateral_position_to_top_and_range(of_box, snapshot, (0.0, 1e-3)) == pytest.approx((4e-3, 1e-3))
    assert limit_lateral_position_to_top_and_range(needle, snapshot, (1e-3, 2e-3)) == pytest.approx((1e-3, 2e-3))
    with pytest.raises(ts.InputError, match="cannot be changed for a reduced solid"):
        of_box.with_test_and_tool("bonded_compression")
    # One that leans goes aside by half a millimetre on its way down, or by more than the box is wide.
    leaning = replace(of_box, experiment=replace(experiment, approach=ts.Approach(6e-3, math.asin(0.125))))
    np.testing.assert_allclose(leaning.allowed_tool_xy_ranges[0], [4e-3, 7.5e-3])
    steep = replace(leaning, reduced=SimpleNamespace(box=ts.PoseBox(1e-4, 4e-3), lifting=12))
    assert steep.allowed_tool_xy_ranges[0] == pytest.approx((5.75e-3, 5.75e-3))
    lifted = replace(of_box, reduced=SimpleNamespace(box=of_box.reduced.box, lifting=0))
    assert lifted.min_tool_displacement == -5e-3
