"""Profiles of rigid tools as signed distances."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import tissue_sim as ts


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
    outline = profile.outline(20e-3)
    assert abs(profile.gap(outline)).max() < 1e-12
    assert outline[0, 0] == pytest.approx(0, abs=1e-15) and outline[-1] == pytest.approx([8e-3, 20e-3])
