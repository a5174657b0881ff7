"""Forces against FElupe, an independent program, on the same mesh with the same element: Q4/P0 and Q9/P-1.

What is compared is the whole chain: axisymmetric kinematics, law, mixed formulation, condensation, reactions. Both
sides solve to rounding, so the difference is far below the six digits asked for (at most 3e-11 where FElupe's last
Newton step is the coarser one).
"""


import felupe_problem
import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.mesh import cylinder_mesh
from tissue_sim.mesh.elements import Q4P0, Q9P1

#: Radius, m.
RADIUS = 0.04
#: Height, m.
HEIGHT = 0.07
DEPTHS = np.array([2e-3, 5e-3, 10e-3])
LAWS = {
    "reduced_polynomial_2": {"C10": 1404.9, "C20": 699.4},
    "ogden_1": {"mu1": 3225.9, "alpha1": 14.8},
}


def felupe_law(law):
    make = {"reduced_polynomial_2": felupe_problem.reduced_polynomial, "ogden_1": felupe_problem.ogden}[law]
    return make(*LAWS[law].values())


def simulated(mesh, law, held, ratio):
    """Our forces at `DEPTHS`, N, and the bulk modulus, Pa."""
    material = ts.Material(law, LAWS[law], ts.Bulk("bulk_ratio", ratio))
    face = {"rz": "bonded", "z": "frictionless"}[held]
    protocol = ts.Protocol(np.arange(1.0 + DEPTHS.size), np.concatenate([[0.0], DEPTHS]))
    experiment = ts.Experiment(ts.Specimen(RADIUS, HEIGHT), protocol, friction=face, friction_base=face)
    recording = ts.simulate(ts.Model(experiment, material), mesh=mesh)
    assert recording.force[0] == pytest.approx(0.0, abs=1e-12)
    return recording.force[1:], material.bulk_modulus


@pytest.mark.parametrize("law", LAWS)
def test_tangent_of_the_oracle(law):
    """The laws written for FElupe: the tangent is the derivative of the stress, at rest and at coincident stretches
    too, and the stress of a pure dilation is zero."""
    umat = felupe_law(law)
    F = np.eye(3)[:, :, None, None] + 0.2 * np.random.default_rng(3).normal(size=(3, 3, 2, 4))
    F[:, :, 0, 0] = np.eye(3)
    F[:, :, 0, 1] = np.diag([0.8, 1.25, 1.25])
    F[:, :, 0, 2] = np.diag([1.1, 1.1, 1.1])
    tangent, h = umat.hessian([F, None])[0], 1e-6
    for k, l in np.ndindex(3, 3):
        step = np.zeros((3, 3, 1, 1))
        step[k, l] = h
        slope = (umat.gradient([F + step, None])[0] - umat.gradient([F - step, None])[0]) / (2 * h)
        np.testing.assert_allclose(tangent[:, :, k, l], slope, rtol=0, atol=1e-7 * abs(tangent).max())
    np.testing.assert_allclose(umat.gradient([F, None])[0][:, :, 0, 2], 0.0, atol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize(("element", "pressure"), [(Q4P0, "P0"), (Q4P0, "P0 mixed"), (Q9P1, "P-1")],
                         ids=["Q4/P0 condensed", "Q4/P0 mixed", "Q9/P-1"])
@pytest.mark.parametrize("held", ["rz", "z"], ids=["bonded", "lubricated"])
@pytest.mark.parametrize("law", LAWS)
def test_forces_equal_those_of_felupe(element, pressure, held, law):
    mesh = cylinder_mesh(RADIUS, HEIGHT, (3, 4), element, grading=(2.0, 1.5))
    forces, bulk_modulus = simulated(mesh, law, held, 1e3)
    theirs = felupe_problem.compression_curve(mesh, felupe_law(law), bulk_modulus, DEPTHS, held=held,
                                              pressure=pressure, tolerance=1e-10)
    np.testing.assert_allclose(forces, theirs, rtol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("ratio", [13 / 6, 50.0, 1e5])
@pytest.mark.parametrize(("element", "pressure"), [(Q4P0, "P0"), (Q9P1, "P-1")], ids=["Q4/P0", "Q9/P-1"])
def test_forces_equal_over_the_range_of_bulk_moduli(element, pressure, ratio):
    mesh = cylinder_mesh(RADIUS, HEIGHT, (3, 4), element)
    forces, bulk_modulus = simulated(mesh, "reduced_polynomial_2", "rz", ratio)
    theirs = felupe_problem.compression_curve(mesh, felupe_law("reduced_polynomial_2"), bulk_modulus,
                                              DEPTHS, pressure=pressure)
    np.testing.assert_allclose(forces, theirs, rtol=1e-7)


def test_taylor_hood_tends_to_the_same_forces():
    """FElupe's Q9/Q1 is another element: it differs on a coarse mesh, and less on a finer one."""
    differences = []
    for counts in ((3, 4), (6, 8)):
        mesh = cylinder_mesh(RADIUS, HEIGHT, counts, Q9P1, grading=(3.0, 2.0))
        forces, bulk_modulus = simulated(mesh, "reduced_polynomial_2", "rz", 1e3)
        theirs = felupe_problem.compression_curve(mesh, felupe_law("reduced_polynomial_2"),
                                                  bulk_modulus, DEPTHS, pressure="Q1")
        differences.append(abs(forces / theirs - 1).max())
    assert 1e-6 < differences[1] < 0.5 * differences[0] < 0.01


@pytest.mark.parametrize("law", LAWS)
def test_tension_between_grips_is_that_of_felupe(law):
    """A cylinder twice as high as its radius. On the same mesh the forces are equal; four-node elements on another mesh
    give the forces of the default mesh within 0.5 %."""
    radius, height, pull = 0.010, 0.020, np.array([3e-3, 6e-3])
    material = ts.Material(law, LAWS[law], ts.Bulk("bulk_ratio", 1e3))
    experiment = ts.KINDS["uniaxial_tension"].experiment(
        specimen=ts.Specimen(radius, height), protocol=ts.Protocol(np.arange(3.0), np.concatenate([[0.0], pull])))
    model = ts.Model(experiment, material)
    mesh = cylinder_mesh(radius, height, (4, 6), Q9P1, grading=(2.0, 1.5))
    theirs = -felupe_problem.compression_curve(mesh, felupe_law(law), material.bulk_modulus, -pull, pressure="P-1",
                                               tolerance=1e-10)
    np.testing.assert_allclose(ts.simulate(model, mesh=mesh).force[1:], theirs, rtol=1e-6)
    mesh = cylinder_mesh(radius, height, (20, 40), Q4P0, grading=(8.0, 8.0))
    theirs = -felupe_problem.compression_curve(mesh, felupe_law(law), material.bulk_modulus, -pull)
    np.testing.assert_allclose(ts.simulate(model, estimate_error=False).force[1:], theirs, rtol=0.005)
