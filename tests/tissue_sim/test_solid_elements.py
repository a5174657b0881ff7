"""The kernel of the elements in space against its own differences, and against a law written out by itself."""

import numpy as np
import pytest
from solid_meshes import block

import tissue_sim as ts
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh.solid import SOLID_ELEMENTS, create_block_mesh_from_boundaries
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1
from tissue_sim.pose import Pose

pytestmark = pytest.mark.slow

LAWS = {"reduced_polynomial_2": {"C10": 1404.9, "C20": 699.4}, "mooney_rivlin": {"C10": 600.0, "C01": 700.0},
        "ogden_2": {"mu1": 3000.0, "alpha1": 3.0, "mu2": 500.0, "alpha2": -4.0}}
every_element = pytest.mark.parametrize("element", SOLID_ELEMENTS.values(), ids=lambda element: element.name)


def solver(element, material, cells=1):
    line = np.linspace(0.0, 0.01, cells + 1)
    mesh = block(line, line * 1.5, line - 0.01, element)
    return SolidSolver(mesh, material, {"base": "xyz"}, mesh.sets["top"], start=Pose.at_depth(0.0))


def forces(tissue):
    """Return the forces of all degrees of freedom at given pressures, without the volume residual."""
    tissue.equations.assemble_and_get_least_volume_ratio()
    batches, modes = tissue.batches, tissue.mesh.element.pressure_modes
    missed = tissue.tissue.bulk_moduli[0] * batches.moduli[:, None] * batches.gaps.reshape(batches.batches, modes, -1)
    rates = batches.volume_rates.reshape(batches.batches, modes, -1, missed.shape[-1])
    residual = batches.residual.copy()
    np.add.at(residual, batches._equations.ravel(), -(missed[:, :, None] * rates).sum(axis=1).ravel())
    return residual[:-1]


@every_element
@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("past", ["none", "tanh", "erf"])
def test_tangent_is_the_derivative_of_the_forces(element, name, past):
    rng = np.random.default_rng(3)
    history = {} if past == "none" else {"viscoelastic": ts.Prony((ts.PronyTerm(0.3, 0.5),)),
                                         "softening": ts.Softening(0.3, 400.0, 0.2, past)}
    tissue = solver(element, ts.Material(name, LAWS[name], ts.Bulk("bulk_ratio", 1e3), **history))
    batches, x = tissue.batches, tissue.x
    if history:
        # It has been loaded higher before, and stresses are left.
        memory = tissue.tissue.region_material_arrays[0].memory
        memory.set_step_duration(0.1)
        memory.largest[:] = rng.uniform(0.0, 2000.0, memory.largest.shape)
        memory.inherited[:] = rng.normal(0.0, 300.0, memory.inherited.shape)
    x[:] = rng.normal(0.0, 0.03 * 0.01 / element.order, x.size)
    batches.pressures[: batches.count * tissue.mesh.element.pressure_modes] = rng.normal(0.0, 300.0)
    tissue.equations.assemble_and_get_least_volume_ratio()
    tangent, rates = batches.matrix.toarray(), batches.volume_rates.copy()
    np.testing.assert_allclose(tangent, tangent.T, atol=1e-12 * np.abs(tangent).max())
    here, pressures = x.copy(), batches.pressures.copy()
    way = rng.normal(size=x.size)

    def perturbed(step):
        x[:], batches.pressures[:] = here + step * way, pressures
        # The pressures follow the volume as they do in a linear solution.
        batches.volume_rates[:], batches.gaps[:] = rates, 0.0
        batches.store_assembled_volume_rates()
        tissue.tissue.update_pressures(step * way)
        return forces(tissue)

    h = 1e-7
    difference = (perturbed(h) - perturbed(-h)) / (2 * h)
    np.testing.assert_allclose(tangent @ way, difference, atol=1e-8 * np.abs(difference).max())


@pytest.mark.parametrize("name", LAWS)
def test_stress_of_a_point_is_that_of_the_law(name):
    """One element, uniformly stretched: nodal forces are those of the principal Kirchhoff stresses."""
    material = ts.Material(name, LAWS[name], ts.Bulk("bulk_ratio", 1e3))
    tissue = solver(HEX8P0, material)
    stretches, p = np.array([1.3, 0.85, 0.95]), 250.0
    rotation = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0]
    F = rotation @ np.diag(stretches)
    tissue.x[:] = (tissue.mesh.nodes @ (F - np.eye(3)).T).ravel()
    tissue.batches.pressures[:] = p * np.sqrt(tissue.batches.weights.sum())  # of the orthonormal mode
    _, deviator = material.energy_law.compute_energy_and_kirchhoff_stresses(stretches, material.parameters)
    J = stretches.prod()
    piola = rotation @ np.diag((deviator + p * J) / stretches)
    sizes = np.ptp(tissue.mesh.nodes, axis=0)
    # Each node has a quarter of the stress on the three sides that meet there.
    areas = 0.25 * np.prod(sizes) / sizes
    signs = np.sign(tissue.mesh.nodes - tissue.mesh.nodes.mean(axis=0))
    np.testing.assert_allclose(forces(tissue).reshape(-1, 3), (signs * areas) @ piola.T, rtol=1e-10, atol=1e-9)


@every_element
def test_equal_stretches_have_the_tangent_of_ones_that_are_nearly_equal(element):
    tissue = solver(element, ts.Material("ogden_2", LAWS["ogden_2"], ts.Bulk("bulk_ratio", 1e3)))
    matrices = []
    for apart in (0.0, 1e-9, 1e-4):
        stretch = np.diag([1.1, 1.1 + apart, 1.1 - apart])
        tissue.x[:] = (tissue.mesh.nodes @ (stretch - np.eye(3))).ravel()
        tissue.equations.assemble_and_get_least_volume_ratio()
        matrices.append(tissue.batches.matrix.toarray())
    for matrix, close in zip(matrices[1:], (1e-7, 2e-3), strict=True):
        np.testing.assert_allclose(matrix, matrices[0], atol=close * np.abs(matrices[0]).max())


def test_an_element_inside_out_is_named():
    mesh = create_block_mesh_from_boundaries([0.0, 0.01, 0.02], [0.0, 0.01], [-0.01, 0.0], HEX8P0)
    mesh.nodes[mesh.connectivity[1, 0]] += [0.02, 0.0, 0.0]
    with pytest.raises(ts.InputError, match="positive volume; element 1 is inside out or has no volume"):
        SolidSolver(mesh, ts.Material("neo_hooke", {"C10": 1500.0}), {"base": "xyz"}, mesh.sets["top"],
                    start=Pose.at_depth(0.0))


def test_lanes_that_are_left_over_change_nothing():
    """Three elements in lanes for four or eight: as often as not one of them is used twice."""
    material = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3))
    found = []
    for x in (np.linspace(0.0, 0.03, 4), np.array([0.0, 0.01, 0.02, 0.025, 0.03])):
        mesh = create_block_mesh_from_boundaries(x, [0.0, 0.01], [-0.01, 0.0], HEX27P1)
        tissue = SolidSolver(mesh, material, {"base": "xyz"}, mesh.sets["top"], start=Pose.at_depth(0.0))
        step = tissue.step(Pose.at_depth(1e-3))
        assert step.status is StepStatus.CONVERGED
        found.append(step.force)
    assert found[0] == pytest.approx(found[1], rel=2e-3)
