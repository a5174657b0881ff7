"""The solid in space against contact mechanics, and whether its mesh prefers a direction.

Formulas: Johnson, Contact Mechanics, 1985.
"""


import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.mesh.solid import Grading, create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1


@pytest.fixture(scope="module")
def solid_checks(benchmark_module):
    """The benchmark, which also checks finer meshes."""
    return benchmark_module("solids.solid_checks")


@pytest.mark.slow
def test_a_ball_that_slips_in_part_is_that_of_cattaneo_and_mindlin(solid_checks):
    """Two elements on the radius of contact; normal and tangential do not act on each other where nu = 1/2."""
    found = solid_checks.Mindlin(fine=2, far=40.0).run(press=2, push=(0.5,))
    assert max(map(abs, found["hertz_error"])) < 0.03
    assert 0.5 < found["tangential_over_limit"][0] < 0.8
    assert abs(found["way_error"][0]) < 0.03 and found["normal_changes"] < 0.005
    assert found["sliding_over_mu_normal"] == pytest.approx(1.0, abs=0.005)


@pytest.mark.slow
def test_a_mesh_has_no_direction_of_its_own(solid_checks):
    """A needle that is dragged aside from the axis, to places turned about it by what is no symmetry of the mesh."""
    mesh = create_cylinder_mesh_under_needle(0.04, 0.07, 8e-3, HEX27P1, smallest=3e-3, growth=3.0, largest=30e-3,
                                             around=2)
    found = solid_checks.dragged(mesh, 3e-3, 4e-3)
    assert found["vertical_changes"] < 0.005
    assert found["radial_changes"] < 0.005 and found["around_over_radial"] < 0.005


@pytest.mark.slow
@pytest.mark.parametrize(("mu", "points", "sizes"), [
    (0.15, 7, (0.2, 1.8, 1.9, 4)), (0.3, 31, (0.6, 2.5, 3.8, 2))], ids=["as in real time", "coarse"])
def test_plates_with_friction_turn_round_without_a_cut(mu, points, sizes):
    """What begins to slip after a turn has the way of its force, not of the force's change, which is against it."""
    specimen = ts.Block(0.02, 0.02, 0.02)
    way = np.linspace(0.0, 3e-3, points)
    way = np.concatenate([way, way[-2::-1]])
    experiment = ts.KINDS["lubricated_compression"].experiment(
        specimen=specimen, protocol=ts.Protocol(np.arange(way.size, dtype=float), way), friction=mu)
    model = ts.Model(experiment, ts.Material("neo_hooke", {"C10": 450.0}, ts.Bulk("bulk_ratio", 1e3)))
    smallest, growth, largest, around = sizes
    mesh = specimen.solid_mesh(Grading(HEX8P0, 0.01 * smallest, growth, 0.01 * largest, around))
    recording = ts.simulate(model, solver="solid", mesh=mesh)
    found = recording.metadata["solver"]
    assert found["cuts"] == 0 and found["newton_iterations"] < 8.0 * way.size
    # What friction takes, at a third of the depth.
    third = (points - 1) // 3
    assert recording.force[-1 - third] < 0.97 * recording.force[third]
