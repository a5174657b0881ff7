"""Preset views: the scene fits into the view and fills it, and the section faces are visible."""

import numpy as np
import pytest

import tissue_sim as ts
from scenes.viewer.page.view_controls import FIELD_OF_VIEW, PRESETS, compute_preset_camera_pose
from scenes.viewer.revolution import WedgeOpening
from scenes.viewer.tool_picture import (
    compute_height_of_tool_with_longest_arrow,
    make_base_plate,
    make_drawn_tool_surface,
)

#: Flat needle.
NEEDLE = ts.Tool("flat", radius=0.008)
#: Plate.
PLATE = ts.Tool()
#: Parameters of the reference study, Pa.
STUDY = ts.Specimen(0.04, 0.07)
FLAT = ts.Specimen(0.05, 0.01)
TALL = ts.Specimen(0.01, 0.08)
OPENING = WedgeOpening()


def drawn(specimen, tool, depth):
    """Points of all drawn parts around an undeformed specimen, m, shape (n, 3)."""
    angles = np.linspace(0.0, 2 * np.pi, 90)
    rim = specimen.radius * np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=-1)
    above = compute_height_of_tool_with_longest_arrow(tool, specimen)
    return np.concatenate([rim, rim - [0.0, 0.0, specimen.height], make_base_plate(specimen, OPENING).vertices,
                           make_drawn_tool_surface(tool, specimen, OPENING).vertices - np.array([0.0, 0.0, depth]),
                           [[0.0, 0.0, above - depth]]])


def in_view(pose, points, aspect):
    """Position in the view, (right, up) from -1 to 1, and distance in front of the camera, m."""
    ahead = pose.look_at - pose.position
    ahead = ahead / np.linalg.norm(ahead)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    way = points - pose.position
    far = way @ ahead
    half = np.tan(0.5 * FIELD_OF_VIEW)
    return np.stack([way @ right / (far * half * aspect), way @ np.cross(right, ahead) / (far * half)], axis=-1), far


@pytest.mark.parametrize("aspect", [0.5, 1.0, 16 / 9, 3.0])
@pytest.mark.parametrize(("specimen", "tool"), [(STUDY, NEEDLE), (STUDY, PLATE), (FLAT, NEEDLE), (FLAT, PLATE),
                                                (TALL, PLATE)])
@pytest.mark.parametrize("preset", sorted(set(PRESETS) - {"contact"}))
def test_the_scene_fits_into_the_view_and_fills_it(preset, specimen, tool, aspect):
    for depth in (0.0, 0.15 * specimen.height):
        height = compute_height_of_tool_with_longest_arrow(tool, specimen)
        pose = compute_preset_camera_pose(preset, specimen, tool, depth, height, aspect)
        place, far = in_view(pose, drawn(specimen, tool, depth), aspect)
        assert far.min() > 0 and np.abs(place).max() <= 1.0
        assert depth or np.abs(place).max() >= 0.75, "no wasted space"


@pytest.mark.parametrize("aspect", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("tool", [NEEDLE, ts.Tool("sphere", radius=0.004), ts.Tool("flat", radius=0.002)])
def test_contact_is_a_close_view_of_the_end_of_the_tool(tool, aspect):
    depth = 6e-3
    height = compute_height_of_tool_with_longest_arrow(tool, STUDY)
    pose = compute_preset_camera_pose("contact", STUDY, tool, depth, height, aspect)
    around = np.array([[x, 0.0, -depth + z] for x in (-1, 1) for z in (0.0, tool.radius)]) * [tool.radius, 1, 1]
    place, far = in_view(pose, around, aspect)
    assert far.min() > 0 and np.abs(place).max() <= 1.0
    across = np.abs(place[:, 0]).max() * max(aspect, 1.0)
    assert across >= 0.25, "the tool is large in it"
    pose = compute_preset_camera_pose("iso", STUDY, tool, depth, height, aspect)
    whole, _ = in_view(pose, around, aspect)
    assert np.ptp(place[:, 0]) > 1.5 * np.ptp(whole[:, 0])


@pytest.mark.parametrize("cut", [90.0, 120.0, 180.0])
@pytest.mark.parametrize("preset", ["iso", "front", "contact"])
def test_both_section_faces_are_visible(preset, cut):
    height = compute_height_of_tool_with_longest_arrow(NEEDLE, STUDY)
    pose = compute_preset_camera_pose(preset, STUDY, NEEDLE, 5e-3, height)
    half = np.radians(0.5 * cut)
    for side in (-1, 1):
        azimuth = -np.pi / 2 + side * half
        # Out of the tissue and into the wedge that is cut out.
        normal = -side * np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        assert normal[1] < 1e-12
        assert (pose.position - pose.look_at) @ normal > 0


def test_presets_have_the_stated_directions():
    poses = {name: compute_preset_camera_pose(name, STUDY, NEEDLE, 0.0, 0.05) for name in PRESETS}
    away = {name: (pose.position - pose.look_at) / np.linalg.norm(pose.position - pose.look_at)
            for name, pose in poses.items()}
    np.testing.assert_allclose(away["front"], [0.0, -1.0, 0.0], atol=1e-12)
    assert away["top"][2] > 0.999
    assert 0 < away["contact"][2] < away["iso"][2] < 0.9
    for pose in poses.values():
        assert abs(pose.look_at[0]) + abs(pose.look_at[1]) == 0.0, "the axis is in the middle"
