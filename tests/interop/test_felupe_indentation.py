"""The peer solution `felupe_indentation` agrees with this program: bonded punch on a cylinder with a bonded base.

Mesh and element are equal. The side wall of the punch is left out, because FElupe has no contact there.
"""


import numpy as np
import pytest
from felupe_indentation import Indentation

import tissue_sim as ts
from tissue_sim.fem.axisymmetric.solver import AxisymmetricSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh import cylinder_mesh_refined_under_needle
from tissue_sim.mesh.elements import Q4P0, Q9P1

#: Pa. The second set is the one that a warm start meets: other moduli and another ratio of them.
MODULI = [(1404.9, 699.4), (1200.0, 900.0)]
DEPTHS = np.array([0.5e-3, 1e-3, 1.5e-3])
BULK_RATIO = 1e4


def our_forces(mesh, C10, C20):
    material = ts.Material("reduced_polynomial_2", {"C10": C10, "C20": C20}, ts.Bulk("bulk_ratio", BULK_RATIO))
    solver = AxisymmetricSolver(mesh, material, {"base": "rz"}, {"face": "rz"})
    steps = [solver.step(depth) for depth in DEPTHS]
    assert all(step.status is StepStatus.CONVERGED for step in steps)
    return [step.force for step in steps]


@pytest.fixture(params=[Q4P0, Q9P1], ids=["Q4/P0", "Q9/P-1"])
def mesh(request):
    return cylinder_mesh_refined_under_needle(0.04, 0.07, 0.008, request.param, smallest=4e-3, growth=1.8,
                                              largest=15e-3)


@pytest.mark.slow
@pytest.mark.parametrize("warm", [False, True], ids=["from rest", "warm"])
def test_forces_equal_ours(mesh, warm):
    punch = Indentation(mesh, DEPTHS, bulk_ratio=BULK_RATIO, warm=warm)
    for moduli in MODULI:
        np.testing.assert_allclose(punch.forces(*moduli), our_forces(mesh, *moduli), rtol=1e-7)
    assert punch.solves == len(MODULI)


def test_warm_start_saves_iterations_and_no_accuracy(mesh):
    """One modulus moved by the step of a finite difference: the same forces, at most two iterations a depth."""
    forces, iterations = [], []
    for warm in (False, True):
        punch = Indentation(mesh, DEPTHS, bulk_ratio=BULK_RATIO, warm=warm)
        punch.forces(1400.0, 600.0)
        first = punch.iterations
        forces.append(punch.forces(1401.4, 600.0))
        iterations.append(punch.iterations - first)
    np.testing.assert_allclose(forces[1], forces[0], rtol=1e-7)
    assert iterations[1] <= 2 * DEPTHS.size < iterations[0]
