"""The fast mesh where forces depend on what is small: a shoulder in contact, an edge that tissue rubs against."""

import numpy as np
import pytest

import tissue_sim as ts

SPECIMEN = ts.Specimen(0.040, 0.070)
MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))


def test_a_shoulder_in_contact_is_meshed_as_an_edge():
    """A cone pressed in to beyond its shoulder: with elements of a contact radius over four it was 2.9 % too soft."""
    test = ts.Model(ts.Experiment(SPECIMEN, ts.Protocol.ramp(6e-3, 13), friction="frictionless",
                                  tool=ts.Tool("cone", 8e-3, half_angle=np.radians(70.0))), MATERIAL)
    fast, accurate = (ts.simulate(test, resolution=name).force for name in ("fast", "accurate"))
    assert fast[-1] == pytest.approx(accurate[-1], rel=0.011)


@pytest.mark.slow
@pytest.mark.parametrize("friction", ["stick", 0.3, 0.7])
@pytest.mark.parametrize("edge", [0.02, 0.05, 0.1])
def test_an_edge_that_tissue_rubs_against(friction, edge):
    """With elements of a sixth of the radius, whatever the edge, the fast mesh was up to 2.3 % off here."""
    test = ts.Model(ts.Experiment(SPECIMEN, ts.Protocol.ramp(4e-3, 9), tool=ts.Tool("flat", 8e-3, edge * 8e-3),
                                  friction=friction), MATERIAL)
    fast, accurate = (ts.simulate(test, resolution=name).force for name in ("fast", "accurate"))
    assert np.abs(fast - accurate).max() <= 0.01 * accurate.max()
