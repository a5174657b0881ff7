"""Fixtures of the tests of the finite elements."""

import pytest

from tissue_sim.fem.solid.discretisation import RESOLUTIONS, Resolution
from tissue_sim.mesh.solid_element import HEX8P0


@pytest.fixture(scope="session")
def coarse():
    """Name of a resolution with a third of the elements of ``"realtime"``.

    Tests compare a reduced solid with the whole solid on the same mesh, so that the error of the mesh has no effect."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(RESOLUTIONS, "coarse", Resolution(HEX8P0, 0.5, 2.4, 3.0, 4))
        yield "coarse"
