"""Picture file: the view is unchanged, next to a colour bar and force curves."""

import io

import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.image import imread

import tissue_sim as ts
from scenes.viewer.page.saving import DrawnForceCurve, compose_picture_png

LEVELS = [0.0, 0.5, 1.0, 2.0]
COLOURS = ["#440154", "#21918c", "#fde725"]
CAPTION = ["Needle indentation", "phantom: C10 1.40 kPa", "depth 8.00 mm, force 1.23 N"]


def opened(png: bytes) -> np.ndarray:
    """Decode a PNG, shape (h, w, 3), uint8."""
    assert png.startswith(b"\x89PNG")
    return np.round(imread(io.BytesIO(png), format="png")[:, :, :3] * 255).astype(np.uint8)


def render(height=360, width=480, channels=4):
    """Image with noise in the middle and a transparent (or black) border."""
    picture = np.zeros((height, width, channels), np.uint8)
    picture[60:-60, 80:-80, :3] = np.random.default_rng(0).integers(0, 256, (height - 120, width - 160, 3))
    picture[60:-60, 80:-80, 3:] = 255
    return picture


def find(picture, part):
    """Row and column of the first pixel of a part of the picture."""
    high, wide = part.shape[:2]
    corners = np.argwhere((picture == part[0, 0]).all(axis=2))
    return [(i, j) for i, j in corners if np.array_equal(picture[i:i + high, j:j + wide], part)]


def test_without_levels_there_is_no_bar():
    """For tissue without fields, the picture has the view only and no space for a bar."""
    view = render()
    alone, with_bar = (opened(compose_picture_png(view, levels, COLOURS, "von Mises stress [kPa]", CAPTION))
                     for levels in (None, LEVELS))
    assert find(alone, view[60:-60, 80:-80, :3]) and alone.shape[1] < with_bar.shape[1] - 100
    assert not (alone == np.round(np.array(to_rgb(COLOURS[2])) * 255)).all(axis=2).any()


@pytest.mark.parametrize("curves", [(), (DrawnForceCurve(np.arange(5) * 1e-3, np.arange(5.0), "model", "#0072B2"),)])
def test_the_picture_contains_the_unchanged_view(curves):
    view = render()
    picture = opened(compose_picture_png(view, LEVELS, COLOURS, "von Mises stress [kPa]", CAPTION, curves=curves))
    (place,) = find(picture, view[60:-60, 80:-80, :3])
    around = picture[place[0] - 50:place[0] - 1, place[1] - 70:place[1] + 300]
    assert (around == 255).all()  # what was transparent is white


def test_transparent_pixels_are_blended_with_white():
    view = np.zeros((300, 300, 4), np.uint8)
    view[:] = [200, 100, 0, 102]
    picture = opened(compose_picture_png(view, LEVELS, COLOURS, "J", ["x"]))
    expected = np.round(np.array([200, 100, 0]) * 0.4 + 255 * 0.6).astype(np.uint8)
    assert (picture == expected).all(axis=2).sum() >= 300 * 300


def test_the_bar_has_the_bands_in_ascending_order():
    picture = opened(compose_picture_png(render(), LEVELS, COLOURS, "von Mises stress [kPa]", CAPTION))
    rows = [np.argwhere((picture == np.round(np.array(to_rgb(colour)) * 255)).all(axis=2)) for colour in COLOURS]
    heights = [np.unique(found[:, 0]) for found in rows]
    assert heights[0].min() > heights[1].max() > heights[1].min() > heights[2].max()
    sizes = [each.size for each in heights]
    assert max(sizes) - min(sizes) <= 4
    # The same colours as rows of numbers.
    numbers = np.array([to_rgb(colour) for colour in COLOURS])
    for same in (numbers, np.round(255 * numbers).astype(np.uint8)):
        assert np.array_equal(opened(compose_picture_png(render(), LEVELS, same, "von Mises stress [kPa]", CAPTION)),
                              picture)


def test_the_force_curve_is_drawn_in_its_colour():
    depth = np.linspace(0, 10e-3, 20)
    band = (depth, 180 * depth, 220 * depth)
    curves = (DrawnForceCurve(depth, 200 * depth, "model", "#0072B2"),
              DrawnForceCurve(depth, 150 * depth, "", "#0072B2", dashed=True),
              DrawnForceCurve(depth, np.full(20, np.nan), "live", "#D55E00"))
    with_curve = opened(compose_picture_png(render(), LEVELS, COLOURS, "J", CAPTION, curves=curves, band=band,
                                            now=(5e-3, 1.0)))
    without = opened(compose_picture_png(render(), LEVELS, COLOURS, "J", CAPTION))
    assert with_curve.shape[1] == without.shape[1] + 600 and with_curve.shape[0] == without.shape[0]
    blue = np.argwhere((with_curve == [0x00, 0x72, 0xB2]).all(axis=2))
    assert blue.shape[0] > 500 and blue[:, 1].min() > without.shape[1] - 60


def test_long_captions_are_wrapped_and_formulas_are_text():
    short = opened(compose_picture_png(render(), LEVELS, COLOURS, "J", ["x"]))
    long = opened(compose_picture_png(render(), LEVELS, COLOURS, "J", ["x", "a $\\frac{ material " * 20]))
    assert long.shape[1] == short.shape[1] and long.shape[0] > short.shape[0] + 100
    assert (long[:, -15:] == 255).all()


@pytest.mark.parametrize(("changes", "message"), [
    ({"render": np.zeros((4, 4), np.uint8)}, r"^render: must have shape .*got \(4, 4\)"),
    ({"render": np.zeros((4, 4, 3))}, r"^render: must .*uint8; got .*float64"),
    ({"levels": [0.0, 1.0]}, "^colours: must be one per band; got 3 for 1 bands"),
    ({"levels": [0.0, 1.0, 1.0, 2.0]}, "^levels: must be two or more ascending"),
    ({"levels": [0.0, np.nan, 1.0, 2.0]}, "^levels: "),
])
def test_invalid_input_is_refused(changes, message):
    asked = {"render": render(), "levels": LEVELS, "colours": COLOURS, "label": "J", "caption": CAPTION} | changes
    with pytest.raises(ts.InputError, match=message):
        compose_picture_png(**asked)
