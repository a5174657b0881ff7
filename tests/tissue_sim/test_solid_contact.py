"""The solid in space against contact mechanics, and whether its mesh has a direction of its own.

Formulas: Johnson, Contact Mechanics, 1985.
"""

import importlib.util
import sys

import pytest

from tissue_sim.mesh.hexahedra import HEX27P1
from tissue_sim.mesh.solid import needle_solid


@pytest.fixture(scope="module")
def solid_checks(root):
    """The module of the benchmark, which has the finer meshes."""
    spec = importlib.util.spec_from_file_location("solid_checks", root / "benchmarks" / "solid_checks.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def test_a_ball_that_slips_in_part_is_that_of_cattaneo_and_mindlin(solid_checks):
    """Two elements on the radius of contact; normal and tangential do not act on each other where nu = 1/2."""
    found = solid_checks.Mindlin(fine=2, far=40.0).run(press=2, push=(0.5,))
    assert max(map(abs, found["hertz_error"])) < 0.03
    assert 0.5 < found["tangential_over_limit"][0] < 0.8
    assert abs(found["way_error"][0]) < 0.03 and found["normal_changes"] < 0.005
    assert found["sliding_over_mu_normal"] == pytest.approx(1.0, abs=0.005)


def test_a_mesh_has_no_direction_of_its_own(solid_checks):
    """A needle that is dragged aside from the axis, to places turned about it by what is no symmetry of the mesh."""
    mesh = needle_solid(0.04, 0.07, 8e-3, HEX27P1, smallest=3e-3, growth=3.0, largest=30e-3, around=2)
    found = solid_checks.dragged(mesh, 3e-3, 4e-3)
    assert found["vertical_changes"] < 0.005
    assert found["radial_changes"] < 0.005 and found["around_over_radial"] < 0.005
