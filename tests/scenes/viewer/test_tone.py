"""Tone mapping of colours and its inverse."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from scenes.viewer.bands import PALETTE, compute_displayed_srgb, find_surface_srgb

CHANNEL = st.integers(0, 255)


@example(surface=(19, 157, 17))
@given(surface=st.tuples(CHANNEL, CHANNEL, CHANNEL))
def test_surface_colour_inverts_seen_colour(surface):
    """For clipped channels the surface colour is not unique, so the test compares the seen colours."""
    seen = compute_displayed_srgb(surface)
    np.testing.assert_allclose(compute_displayed_srgb(find_surface_srgb(seen)), seen,
                               atol=12 if 0 in seen or 255 in seen else 2)


@pytest.mark.parametrize(("surface", "seen"), [((72, 40, 120), (56, 22, 123)), ((253, 231, 37), (229, 219, 100)),
                                               ((150, 150, 150), (166, 166, 166))])
def test_seen_colours_match_a_browser(surface, seen):
    """Pixels of a screenshot with ambient light; a directional light would add gloss."""
    np.testing.assert_allclose(compute_displayed_srgb(surface), seen, atol=4)


def test_the_bands_have_the_colours_of_the_palette_on_the_screen():
    """The blue channel of the two brightest bands is excluded: no surface gives such a saturated yellow."""
    for colour in PALETTE[:-2]:
        np.testing.assert_allclose(compute_displayed_srgb(find_surface_srgb(colour)), colour, atol=2)
    for colour in PALETTE[-2:]:
        np.testing.assert_allclose(compute_displayed_srgb(find_surface_srgb(colour))[:2], colour[:2], atol=2)
