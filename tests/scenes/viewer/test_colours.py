"""Colours, round and steady levels, and the colour bar."""

import re
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import tissue_sim as ts
from scenes.colour_scale import compute_volume_weighted_quantiles
from scenes.viewer.bands import (
    PALETTE,
    choose_band_levels,
    colour_bar_html,
    compute_field_quantile_range,
    keep_or_choose_band_levels,
)

RANGES = st.tuples(st.floats(-1e6, 1e6), st.floats(1e-9, 1e6)).map(lambda pair: (pair[0], pair[0] + pair[1]))


def lightness(colour):
    """CIE lightness L* of an sRGB colour."""
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in np.array(colour) / 255]
    luminance = np.dot(linear, [0.2126, 0.7152, 0.0722])
    return 116 * luminance ** (1 / 3) - 16


def test_palette_colours_differ_in_lightness_and_contrast_with_black_and_white():
    values = [lightness(colour) for colour in PALETTE]
    assert len(PALETTE) == 10 and min(np.diff(values)) > 4
    assert values[0] > 15 and values[-1] < 90


@given(RANGES, st.integers(2, 20))
def test_levels_cover_the_range_in_round_steps(ends, bands):
    low, high = ends
    levels = choose_band_levels(low, high, bands)
    assert levels.shape == (bands + 1,) and levels[0] <= low and levels[-1] >= high
    # The rounding of large levels is left out of the small step between them.
    step = float(f"{(levels[-1] - levels[0]) / bands:.3g}")
    first = np.round(levels[0] / step)
    assert levels == pytest.approx((first + np.arange(bands + 1)) * step, rel=1e-10, abs=1e-10 * step)
    # One or two digits of those that people count in.
    assert f"{step:.4e}"[:6] in {"1.0000", "1.5000", "2.0000", "2.5000", "3.0000", "4.0000", "5.0000", "6.0000",
                                 "8.0000"}


@given(st.floats(0.0, 1e3), st.floats(2e-3, 1e3))
def test_levels_use_more_than_half_of_the_bands(low, width):
    """For ranges wider than rounding errors."""
    levels = choose_band_levels(low, low + width)
    used = np.searchsorted(levels, low + width, "left") - np.searchsorted(levels, low, "right") + 1
    assert used >= 5


def test_levels_of_a_known_range():
    assert choose_band_levels(0.0, 5.3).tolist() == [0.0, 0.6, 1.2, 1.8, 2.4, 3.0, 3.6, 4.2, 4.8, 5.4, 6.0]
    assert choose_band_levels(-2.0, 9.7).tolist() == [-3.0, -1.5, 0.0, 1.5, 3.0, 4.5, 6.0, 7.5, 9.0, 10.5, 12.0]


@pytest.mark.parametrize("value", [1.0, 3.217, -4.0, 1e-4, 0.25])
def test_a_uniform_field_is_inside_one_band(value):
    levels = choose_band_levels(value * (1 - 1e-9) if value > 0 else value * (1 + 1e-9), value)
    step = levels[1] - levels[0]
    assert np.abs(levels - value).min() > 0.15 * step
    assert levels[0] <= min(value, 0.0) and levels[-1] >= max(value, 0.0)


def test_a_field_of_zeros_gets_levels_from_0_to_1():
    assert choose_band_levels(0.0, 0.0) == pytest.approx(np.linspace(0, 1, 11))


@pytest.mark.parametrize("ends", [(np.nan, 1.0), (0.0, np.inf), (2.0, 1.0)])
def test_an_invalid_range_is_refused(ends):
    with pytest.raises(ts.InputError, match="must have finite bounds"):
        choose_band_levels(*ends)
    with pytest.raises(ts.InputError, match="at least 2"):
        choose_band_levels(0.0, 1.0, 1)


def test_levels_are_kept_while_they_are_suitable():
    levels = choose_band_levels(0.0, 5.3)
    assert keep_or_choose_band_levels(levels, 0.0, 5.9) is levels
    assert keep_or_choose_band_levels(levels, 0.0, 3.1) is levels
    assert keep_or_choose_band_levels(levels, 0.0, 6.1)[-1] > 6.1
    assert keep_or_choose_band_levels(levels, 0.0, 2.0)[-1] < 3.1
    assert keep_or_choose_band_levels(None, 0.0, 5.3).tolist() == levels.tolist()
    assert len(keep_or_choose_band_levels(levels, 0.0, 5.3, 8)) == 9


def test_levels_change_rarely_for_an_oscillating_range():
    levels, changes = None, 0
    for k in range(600):
        new = keep_or_choose_band_levels(levels, 0.0, 4.0 + 0.4 * np.sin(0.3 * k))
        changes += new is not levels
        levels = new
    assert changes == 2  # the first ones, and those that cover the largest


def test_range_excludes_a_fraction_of_the_volume_at_either_end():
    values = np.concatenate([[-1e6], np.linspace(0.0, 1.0, 1001), [1e6]])
    weights = np.concatenate([[1.0], np.ones(1001), [1.0]])
    low, high = compute_volume_weighted_quantiles(values, weights)
    assert 0.0 < low < 0.02 and 0.98 < high < 1.0
    # A small volume counts as little as it is.
    assert compute_volume_weighted_quantiles(np.array([[0.0, 1.0], [2.0, 1e9]]),
                                             np.array([[1.0, 1.0], [1.0, 1e-6]]))[1] < 3.0


def test_range_of_a_field_ignores_rounding_errors():
    """Stresses within 1e-4 of the shear modulus count as uniform or zero."""
    material = ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("bulk_ratio", 1e4))
    noise = 1e-4 * np.sin(np.arange(90.0)).reshape(10, 9)
    fields = {"von_mises": 700.0 + noise, "pressure": noise, "displacement": 1e-8 * noise, "energy": 50.0 * (1 + noise)}

    def range_of(name, factor):
        return compute_field_quantile_range(factor * fields[name],
                                            SimpleNamespace(weights=np.ones((10, 9)), material=material), name,
                                            factor)

    low, high = range_of("von_mises", 1e-3)
    assert low == high == pytest.approx(0.7, rel=1e-6)
    assert range_of("pressure", 1e-3) == (0.0, 0.0)
    low, high = range_of("displacement", 1e3)
    assert -1e-9 < low < -0.9e-9 and 0.9e-9 < high < 1e-9
    low, high = range_of("energy", 1.0)
    assert 49.99 < low < high < 50.01


def test_the_bar_shows_the_colours_of_the_bands_and_round_numbers():
    html = colour_bar_html(choose_band_levels(-2.0, 9.7), PALETTE, "stress <rr> [kPa]")
    bar = ElementTree.fromstring(html)
    assert bar.get("data-testid") == "colour-bar"
    blocks = [part for part in bar.iter() if part.get("data-colour")]
    assert [part.get("data-colour") for part in blocks] == ["#{:02x}{:02x}{:02x}".format(*rgb) for rgb in PALETTE]
    assert all(part.get("data-colour") in part.get("style") for part in blocks)
    assert blocks[0].get("title") == "below −1.5" and blocks[1].get("title") == "−1.5 to 0.0"
    assert blocks[-1].get("title") == "above 10.5"
    assert [part.text for part in bar.iter("span")] == ["−3.0", "0.0", "3.0", "6.0", "9.0", "12.0"]
    assert "stress <rr> [kPa]" in "".join(bar.itertext())
    # Colours of the page, light or dark, for whatever is not a band.
    assert re.findall(r"(?<!-)color:([^;\"]+)", html) == ["currentColor"]


@pytest.mark.parametrize(("ends", "numbers", "power"), [
    ((0.0, 1.2345e6), ["0.00", "0.30", "0.60", "0.90", "1.20", "1.50"], " × 10⁶"),
    ((0.0, 4.1e-5), ["0", "10", "20", "30", "40", "50"], " × 10⁻⁶"),
    ((0.997, 1.003), ["0.9968", "0.9984", "1.0000", "1.0016", "1.0032", "1.0048"], ""),
    ((0.0, 30.0), ["0", "6", "12", "18", "24", "30"], ""),
])
def test_numbers_of_the_bar_are_short_and_exact(ends, numbers, power):
    bar = ElementTree.fromstring(colour_bar_html(choose_band_levels(*ends), PALETTE, "energy [J/m³]"))
    assert [part.text for part in bar.iter("span")] == numbers
    assert f"energy [J/m³]{power}" in list(bar.itertext())


def test_the_bar_requires_one_colour_per_band():
    with pytest.raises(ts.InputError, match="must be one per band; got 9 for 10 bands"):
        colour_bar_html(choose_band_levels(0.0, 1.0), PALETTE[1:], "x")
