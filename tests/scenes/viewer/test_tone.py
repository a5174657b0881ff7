"""The tone curve, there and back."""

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from scenes.viewer.colours import PALETTE
from scenes.viewer.tone import seen_colour, surface_colour

CHANNEL = st.integers(0, 255)


@example(surface=(19, 157, 17))
@given(surface=st.tuples(CHANNEL, CHANNEL, CHANNEL))
def test_what_is_seen_comes_from_a_surface_that_looks_so(surface):
    """A channel that the curve clips at black leaves the surface open, not what is seen."""
    seen = seen_colour(surface)
    np.testing.assert_allclose(seen_colour(surface_colour(seen)), seen, atol=12 if 0 in seen or 255 in seen else 2)


@pytest.mark.parametrize(("surface", "seen"), [((72, 40, 120), (56, 22, 123)), ((253, 231, 37), (229, 219, 100)),
                                               ((150, 150, 150), (166, 166, 166))])
def test_against_what_a_browser_has_drawn(surface, seen):
    """Pixels of a screenshot in light from all sides; a directional light adds a little gloss."""
    np.testing.assert_allclose(seen_colour(surface), seen, atol=4)


def test_the_bands_are_seen_in_their_own_colours():
    """But for the blue of the brightest two: no surface looks so yellow."""
    for colour in PALETTE[:-2]:
        np.testing.assert_allclose(seen_colour(surface_colour(colour)), colour, atol=2)
    for colour in PALETTE[-2:]:
        np.testing.assert_allclose(seen_colour(surface_colour(colour))[:2], colour[:2], atol=2)
