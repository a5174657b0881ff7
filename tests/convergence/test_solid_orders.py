"""Orders of convergence of the elements in space, on the solution of `test_orders`, and patches without error."""

import numpy as np
import pytest
from solid_meshes import block

import tissue_sim as ts
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh.solid import SOLID_ELEMENTS
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1, TET8P0, TET15P1
from tissue_sim.pose import Pose

AMOUNT = 2e-6  # m3
MATERIALS = {"reduced_polynomial_2": {"C10": 1404.9, "C20": 699.4}, "ogden_1": {"mu1": 3000.0, "alpha1": 4.0}}


def exact(points):
    """Displacement of incompressible matter that expands around the origin, at points (n, 3)."""
    distance = np.linalg.norm(points, axis=-1, keepdims=True)
    return points * (np.cbrt(distance**3 + AMOUNT) / distance - 1.0)


def prescribe_held_nodes(solver, way):
    """Displace the held nodes by a function of their positions times the depth of the tool, 0 to 1."""
    equations = solver.equations
    equations.compute_held_node_displacements = lambda frame: (
        -frame.origin[2] * way(solver.mesh.nodes[equations.held_nodes])).ravel()


def solve(mesh, material, way, steps):
    """The displacement of all nodes and the last step, where those of the surface go a way."""
    edge = np.unique(np.concatenate(list(mesh.sets.values())))
    solver = SolidSolver(mesh, material, {}, edge, start=Pose.at_depth(0.0))
    prescribe_held_nodes(solver, way)
    for share in np.linspace(0, 1, steps + 1)[1:]:
        step = solver.step(Pose.at_depth(share))
        assert step.status is StepStatus.CONVERGED
    return solver.field_sample().displacement, step


def law(name, ratio=1e4):
    return ts.Material(name, MATERIALS[name], ts.Bulk("bulk_ratio", ratio))


@pytest.mark.slow
@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.parametrize(("element", "order", "cells"), [
    (HEX8P0, 2, (4, 8)), (HEX27P1, 3, (2, 4)), (TET8P0, 2, (2, 4)), (TET15P1, 3, (2, 4))],
    ids=["H8/P0", "H27/P-1", "T8/P0", "T15/P-1"])
def test_order(element, order, cells, name):
    errors = []
    for count in cells:
        line = np.linspace(-0.01, 0.01, count + 1)
        mesh = block(line, line, line - 0.03, element)
        displacement, _ = solve(mesh, law(name), exact, 2)
        points, weights = element.quadrature
        values, slopes = element.evaluate_shape_functions_and_gradients(points)
        X = mesh.nodes[mesh.connectivity]
        places, found = np.einsum("qa,eai->eqi", values, X), np.einsum("qa,eai->eqi", values,
                                                                       displacement[mesh.connectivity])
        volumes = np.linalg.det(np.einsum("eai,qaj->eqij", X, slopes)) * weights
        errors.append(np.sqrt((((found - exact(places)) ** 2).sum(axis=-1) * volumes).sum()))
    assert np.log(errors[0] / errors[1]) / np.log(cells[1] / cells[0]) > order - 0.25


@pytest.mark.slow
@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.parametrize("element", SOLID_ELEMENTS.values(), ids=lambda element: element.name)
def test_patch(element, name):
    """A uniform deformation is a solution on elements of any shape, and has the stress of the law."""
    rng = np.random.default_rng(4)
    away = rng.uniform(-2e-3, 2e-3, 3)

    def move(corners):
        """The corner in the middle goes elsewhere, and all nodes follow."""
        return corners + away * (np.abs(corners - [0.01, 0.01, -0.01]) < 1e-9).all(axis=-1, keepdims=True)

    mesh = block([0, 0.01, 0.02], [0, 0.01, 0.02], [-0.02, -0.01, 0.0], element, move)
    assert np.abs(mesh.nodes - block([0, 0.01, 0.02], [0, 0.01, 0.02], [-0.02, -0.01, 0.0], element).nodes).max() > 5e-4
    stretch = np.diag([1.2, 0.9, 1.0 / 1.08]) @ (np.eye(3) + 0.1 * rng.uniform(-1, 1, (3, 3)))
    stretch /= np.cbrt(np.linalg.det(stretch))

    def way(places):
        return places @ (stretch - np.eye(3)).T

    displacement, step = solve(mesh, law(name), way, 4)
    np.testing.assert_allclose(displacement, way(mesh.nodes), atol=1e-10)
    assert step.residual < 1e-9
