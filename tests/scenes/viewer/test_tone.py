"""The tone curve, there and back."""

from itertools import product

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
    """As near as whole numbers allow: near black one step of a bright channel of the surface is several of a dark one
    that is seen. A channel that the curve clips at black leaves the surface open, not what is seen."""
    seen = np.array(seen_colour(surface))
    found = surface_colour(tuple(seen.tolist()))
    steps = [np.clip(np.add(found, step), 0, 255) for step in product((-1, 0, 1), repeat=3)]
    again = np.array(seen_colour(found))
    step = np.max([np.abs(np.subtract(seen_colour(tuple(near.tolist())), again)) for near in steps], axis=0)
    assert (np.abs(again - seen) <= np.maximum(step, 12 if 0 in seen or 255 in seen else 2)).all()


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
