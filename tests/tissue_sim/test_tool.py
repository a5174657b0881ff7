"""Profiles of rigid tools as signed distances."""

import pickle
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import tissue_sim as ts
from tissue_sim.experiment.tools.tool import convert_tool_sizes_to_si, list_all_tool_sizes_by_key
from tissue_sim.parameters import parameter


@pytest.mark.parametrize(("point", "gap"), [
    ((0.0, -1e-3), 1e-3), ((8e-3, 5e-3), 0.0), ((7.9e-3, 5e-3), -0.1e-3), ((9e-3, -1e-3), np.sqrt(2) * 1e-3),
    ((4e-3, 0.2e-3), -0.2e-3)])
def test_sharp_punch(point, gap):
    assert ts.Tool("flat", 8e-3).profile.gap(np.array([point]))[0] == pytest.approx(gap, abs=1e-15)


@given(edge=st.floats(1e-5, 7.9e-3), angle=st.floats(0.0, np.pi / 2), away=st.floats(-0.5, 3.0))
def test_rounded_edge(edge, angle, away):
    """Along a normal of the arc the gap is the way that was gone."""
    away *= edge
    centre = np.array([8e-3 - edge, edge])
    point = centre + (edge + away) * np.array([np.cos(angle), -np.sin(angle)])
    assert ts.Tool("flat", 8e-3, edge).profile.gap(point[None])[0] == pytest.approx(away, abs=1e-12)


@pytest.mark.parametrize("edge", [0.0, 1e-3])
def test_outline_lies_on_the_surface(edge):
    profile = ts.Tool("flat", 8e-3, edge).profile
    outline = profile.sample_outline_up_to_height(20e-3)
    assert abs(profile.gap(outline)).max() < 1e-12
    assert outline[0, 0] == pytest.approx(0, abs=1e-15) and outline[-1] == pytest.approx([8e-3, 20e-3])


@st.composite
def tools(draw):
    """A tool of any shape and size, about 8 mm wide."""
    shape = draw(st.sampled_from(["plate", "flat", "round", "sphere", "cone", "profile"]))
    share = draw(st.floats(0.0, 0.95))
    match shape:
        case "plate":
            return ts.Tool()
        case "flat":
            return ts.Tool("flat", 8e-3, edge_radius=share * 8e-3)
        case "cone":
            return ts.Tool("cone", 8e-3, half_angle=np.radians(draw(st.floats(1.0, 89.0))), tip_radius=share * 8e-3)
        case "profile":
            turns = np.sort(draw(st.lists(st.floats(0.0, 80.0), min_size=1, max_size=5)))
            ways = 8e-3 / turns.size * np.stack([np.ones(turns.size), np.tan(np.radians(turns))], axis=-1)
            return outlined(np.concatenate([[[0.0, 0.0]], np.cumsum(ways, axis=0)]), share * 0.3e-3)
    return ts.Tool(shape, 8e-3)


def outlined(points, edge_radius=0.0):
    """A profile tool of these points, m, shape (n, 2)."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "profile.csv"
        np.savetxt(path, points * 1e3, delimiter=",", fmt="%.17g")
        return ts.Tool("profile", profile_file=path, edge_radius=edge_radius)


coordinate = st.floats(0.0, 20e-3)
place = st.tuples(coordinate, st.floats(-20e-3, 20e-3))


@given(tool=tools(), one=place, other=place)
def test_gap_is_a_distance(tool, one, other):
    """The gap changes by at most the distance between two points."""
    gaps = tool.profile.gap(np.array([one, other]))
    assert abs(gaps[0] - gaps[1]) <= np.hypot(one[0] - other[0], one[1] - other[1]) + 1e-12


@given(tool=tools())
def test_outline_has_no_gap(tool):
    outline = tool.profile.sample_outline_up_to_height(15e-3)
    below = outline[outline[:, 1] < 15e-3 - 1e-9]
    assert len(below) > 1 and abs(tool.profile.gap(below)).max() < 1e-11


@given(tool=tools())
def test_deepest_point_is_on_the_axis(tool):
    """The frame of a tool: nothing of it is below z = 0, and on the axis it begins there."""
    outline = tool.profile.sample_outline_up_to_height(15e-3)
    assert outline[0, 0] == pytest.approx(0.0, abs=1e-9) and outline[0, 1] == pytest.approx(outline[:, 1].min())
    assert outline[0, 1] == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize(("tool", "at", "radius"), [
    (ts.Tool(), 5e-3, 0.04), (ts.Tool("flat", 8e-3, 1e-3), 5e-3, 8e-3),
    # Hertz: sqrt(R d); Sneddon: 2/pi d tan(alpha); neither wider than the shaft.
    (ts.Tool("round", 8e-3), 0.08e-3, 0.8e-3), (ts.Tool("sphere", 8e-3), 20e-3, 8e-3),
    (ts.Tool("cone", 8e-3, half_angle=np.pi / 4), 2e-3, 2e-3 * 2 / np.pi),
    (ts.Tool("cone", 8e-3, half_angle=np.pi / 4, tip_radius=2e-3), 0.02e-3, 0.2e-3)])
def test_contact_radius(tool, at, radius):
    assert tool.contact_radius(at, specimen_radius=0.04) == pytest.approx(radius)


@pytest.mark.parametrize(("arguments", "words"), [
    ({"shape": "con"}, "unknown tool shape 'con'; did you mean 'cone'"),
    ({"shape": "plate", "edge_radius": 1e-3}, "covers the whole top face"),
    ({"shape": "sphere"}, "a sphere tool needs a radius"),
    ({"shape": "round", "radius": 0.0}, "tool.radius"),
    ({"shape": "round", "radius": np.inf}, "tool.radius"),
    ({"shape": "round", "radius": 8e-3, "edge_radius": 1e-3}, "a round tool has no edge radius"),
    ({"shape": "flat", "radius": 8e-3, "half_angle": 0.5}, "a flat tool has no half angle"),
    ({"shape": "sphere", "radius": 8e-3, "tip_radius": 1e-3}, "a sphere tool has no tip radius"),
    ({"shape": "flat", "radius": 8e-3, "profile_file": "a.csv"}, "a flat tool has no profile file"),
    ({"shape": "flat", "radius": 8e-3, "edge_radius": -1e-3}, "0 or more and less than the radius"),
    ({"shape": "flat", "radius": 8e-3, "edge_radius": np.nan}, "0 or more and less than the radius"),
    ({"shape": "cone", "radius": 8e-3, "half_angle": 1.0, "tip_radius": 8e-3}, "less than the radius"),
    ({"shape": "cone", "radius": 8e-3}, "a cone tool needs a half angle"),
    ({"shape": "cone", "radius": 8e-3, "half_angle": np.pi / 2}, "below 90 degrees"),
    ({"shape": "cone", "radius": 8e-3, "half_angle": -0.5}, "at least 0.6 degrees"),
    ({"shape": "cone", "radius": 8e-3, "half_angle": np.nan}, "at least 0.6 degrees and below 90"),
    ({"shape": "profile"}, "needs the file of its profile")])
def test_refused(arguments, words):
    with pytest.raises(ts.InputError, match=words):
        ts.Tool(**arguments)


def test_a_profile_has_the_radius_of_its_file():
    points = np.array([[0.0, 0.0], [5e-3, 0.0], [6e-3, 3e-3]])
    tool = outlined(points)
    assert tool.radius == pytest.approx(6e-3) and tool.edge_radius == pytest.approx(0.02 * 6e-3)
    with pytest.raises(ts.InputError, match=r"the profile's radius is 0\.006 m; leave the radius out"), \
            TemporaryDirectory() as folder:
        path = Path(folder) / "profile.csv"
        np.savetxt(path, points * 1e3)
        ts.Tool("profile", 5e-3, profile_file=path)


def test_every_size_is_declared_and_can_be_changed():
    """Flags, campaigns and fits reach it by its key and by its path."""
    cone = ts.Tool("cone", 8e-3, half_angle=1.0, tip_radius=1e-3)
    assert [size.field for size in list_all_tool_sizes_by_key().values()] \
        == ["radius", "edge_radius", "half_angle", "tip_radius"]
    assert convert_tool_sizes_to_si({"half_angle_deg": 60.0, "tip_radius_mm": 0.5}) == pytest.approx(
        {"half_angle": np.pi / 3, "tip_radius": 0.5e-3})
    assert ts.with_values(cone, {"half_angle": 0.5}) == ts.Tool("cone", 8e-3, half_angle=0.5, tip_radius=1e-3)


@pytest.mark.parametrize("tool", [ts.Tool(), ts.Tool("flat", 8e-3, 1e-3), ts.Tool("cone", 8e-3, half_angle=1.0)])
def test_equal_tools_are_equal_wherever_they_come_from(tool):
    copy = pickle.loads(pickle.dumps(tool))
    assert copy == tool and hash(copy) == hash(tool) and replace(tool) == tool
    assert isinstance(tool, ts.Tool) and type(tool) is ts.TOOLS[tool.shape]
    assert tool != ts.Tool("sphere", 8e-3)


def test_one_key_means_one_size():
    @dataclass(frozen=True)
    class Other(type(ts.Tool("sphere", 1e-3))):
        name = "other"
        girth: float = parameter("g", "m", key="edge_radius_mm", factor=1e-3, default=0.0)

    ts.TOOLS.register(Other)
    try:
        with pytest.raises(ts.InputError, match="use the key edge_radius_mm for different sizes"):
            list_all_tool_sizes_by_key()
    finally:
        ts.TOOLS.unregister("other")
