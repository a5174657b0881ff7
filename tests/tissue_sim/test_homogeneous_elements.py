"""One element in homogeneous deformation against the closed form with the same finite bulk modulus.

The energies are written out here, differentiated by complex steps, and the free stretches follow from equilibrium. The
edges of the element slide along rigid planes, so that the deformation is homogeneous. With rigid grips it is not; see
`test_grips`.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import root

import tissue_sim as ts
from tissue_sim.fem.axisymmetric.solver import AxisymmetricSolver
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh import cylinder_mesh
from tissue_sim.mesh.elements import Q9P1
from tissue_sim.mesh.solid import create_block_mesh_from_boundaries
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1
from tissue_sim.pose import Pose

#: Edge of the element, m.
SIZE = 0.010
#: Bulk modulus over initial shear modulus.
RATIO = 1e3
#: Free strain at the start of an iteration over that of the solution; a larger difference would cause large pressures.
AWAY = 0.999
LAWS = {
    "neo_hooke": ({"C10": 1000.0}, lambda l, v: v["C10"] * (_sum(l, 2) - 3)),
    "mooney_rivlin": ({"C10": 1000.0, "C01": 400.0},
                      lambda l, v: v["C10"] * (_sum(l, 2) - 3) + v["C01"] * (_sum(l, -2) - 3)),
    "reduced_polynomial_3": ({"C10": 1000.0, "C20": 300.0, "C30": 20.0},
                             lambda l, v: sum(v[f"C{i}0"] * (_sum(l, 2) - 3)**i for i in (1, 2, 3))),
    "gent": ({"mu": 2000.0, "J_m": 20.0}, lambda l, v: -0.5 * v["mu"] * v["J_m"] * np.log(
        1 - (_sum(l, 2) - 3) / v["J_m"])),
    "ogden_2": ({"mu1": 2000.0, "alpha1": 3.0, "mu2": 800.0, "alpha2": -2.0}, lambda l, v: sum(
        2 * v[f"mu{i}"] / v[f"alpha{i}"]**2 * (_sum(l, v[f"alpha{i}"]) - 3) for i in (1, 2))),
}
#: Kind -> stretches along x, y, z; None: free of traction. The tangent of a single HEX27P1 under compression is
#: indefinite at 0.70.
MODES = {
    "uniaxial tension": (None, None, 1.6), "uniaxial compression": (None, None, 0.75),
    "equibiaxial tension": (1.3, 1.3, None), "biaxial tension": (1.4, 1.15, None), "planar tension": (1.5, 1.0, None),
    "confined compression": (1.0, 1.0, 0.97),
}
EVERY_LAW = pytest.mark.parametrize("law", LAWS)


def _sum(stretches, power):
    return sum(stretch**power for stretch in stretches)


def compute_nominal_stresses(law, stretches, bulk):
    """dW/dl_i of W = W_iso(l J^(-1/3)) + K (J - 1)^2 / 2 by complex steps, exact to rounding."""
    values, energy = LAWS[law]

    def total(point):
        J = point[0] * point[1] * point[2]
        return energy([each * J**(-1 / 3) for each in point], values) + 0.5 * bulk * (J - 1)**2

    steps = 1e-30j * np.eye(3)
    return np.array([total(np.asarray(stretches) + step).imag / 1e-30 for step in steps])


def solve_free_stretches(law, stretches, bulk):
    """Stretches whose free directions carry no traction, and their nominal stresses, Pa."""
    free = [axis for axis in range(3) if stretches[axis] is None]
    full = np.array([1.0 if each is None else each for each in stretches])
    if not free:
        return full, compute_nominal_stresses(law, full, bulk)

    def residual(guess):
        full[free] = guess
        return compute_nominal_stresses(law, full, bulk)[free] / bulk

    start = np.full(len(free), np.prod([each for each in stretches if each is not None])**(-1 / len(free)))
    found = root(residual, start, tol=1e-15)
    full[free] = found.x
    assert np.abs(residual(found.x)).max() < 1e-13
    return full, compute_nominal_stresses(law, full, bulk)


def make_material(law, ratio=RATIO):
    return ts.Material(law, LAWS[law][0], ts.Bulk("bulk_ratio", ratio))


def solve_cube(material, element, displacement, prescribed, pressure=0.0):
    """Mean nominal stress of a cube, Pa, shape (3, 3): sum of nodal force times undeformed position, over the volume.

    Args:
        displacement: start of the iteration, with the prescribed displacements, m, shape (nodes, 3).
        prescribed: whether a displacement is prescribed, shape (nodes, 3).
        pressure: start of the iteration, Pa.
    """
    line = [0.0, SIZE]
    mesh = create_block_mesh_from_boundaries(line, line, [-SIZE, 0.0], element)
    nodes = mesh.nodes
    sets = {f"prescribed {axis}": np.flatnonzero(prescribed(nodes)[:, number]) for number, axis in enumerate("xyz")}
    mesh = replace(mesh, sets={**mesh.sets, **sets})
    start = Pose((0.0, 0.0, 0.0))
    solver = SolidSolver(mesh, material, {name: name[-1] for name in sets}, np.zeros(0, int), start=start)
    positions, pressures, _ = solver.equations.committed
    positions[:] = displacement(nodes).ravel()
    # The constant pressure mode, with which the tangent is positive definite.
    modes = solver.batches.point_gradients_and_modes[1]
    pressures[::modes.shape[-1]] = pressure / modes[0, 0, 0]
    step = solver.step(start, tolerance=1e-12, max_iterations=40)
    assert step.status is StepStatus.CONVERGED
    forces = solver.batches.residual[:-1].reshape(-1, 3)
    return forces.T @ nodes / SIZE**3


@EVERY_LAW
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("element", [HEX27P1, HEX8P0])
def test_solid_element(law, mode, element):
    material, stretches = make_material(law), MODES[mode]
    full, expected = solve_free_stretches(law, stretches, material.bulk_modulus)
    # The free stretches start away from their solution.
    start = np.array([1.0 + AWAY * (found - 1.0) if given is None else given
                      for given, found in zip(stretches, full, strict=True)])
    low, high = np.array([0.0, 0.0, -SIZE]), np.array([SIZE, SIZE, 0.0])

    def prescribed(nodes):
        """The faces at low coordinates slide in their planes, and the opposite ones where a stretch is given."""
        has = np.array([each is not None for each in stretches])
        return np.isclose(nodes, low, atol=1e-9) | (np.isclose(nodes, high, atol=1e-9) & has)

    stress = solve_cube(material, element, lambda nodes: (start - 1.0) * (nodes - low), prescribed,
                        material.bulk_modulus * (np.prod(full) - 1.0))
    np.testing.assert_allclose(np.diag(stress), expected, rtol=1e-8, atol=1e-8 * np.abs(expected).max())
    np.testing.assert_allclose(stress - np.diag(np.diag(stress)), 0.0, atol=1e-8 * np.abs(expected).max())


@EVERY_LAW
@pytest.mark.parametrize("element", [HEX27P1, HEX8P0])
def test_solid_element_in_simple_shear(law, element):
    """Simple shear keeps the volume, so that the bulk modulus has no influence: equal to the incompressible form."""
    material, shear = make_material(law), 0.8
    gradient = np.zeros((3, 3))
    gradient[0, 2] = shear

    def prescribed(nodes):
        """All nodes of the surface; the middle node of HEX27P1 is free."""
        middle = np.array([0.5 * SIZE, 0.5 * SIZE, -0.5 * SIZE])
        is_outside = np.isclose(np.abs(nodes - middle), 0.5 * SIZE, atol=1e-9).any(axis=1)
        return np.repeat(is_outside[:, None], 3, axis=1)

    stress = solve_cube(material, element, lambda nodes: nodes @ gradient.T, prescribed)
    # Principal stretches l, 1/l with l - 1/l = gamma; dW/dgamma = (P_1 - P_3 / l^2) / (1 + 1/l^2).
    long = 0.5 * shear + np.sqrt(1.0 + 0.25 * shear**2)
    first, _, last = compute_nominal_stresses(law, [long, 1.0, 1.0 / long], material.bulk_modulus)
    expected = (first - last / long**2) / (1.0 + 1.0 / long**2)
    assert stress[0, 2] == pytest.approx(expected, rel=1e-8)
    closed = ts.KINDS["simple_shear"].closed_form.stress(material.energy_law, shear, material.values)
    assert stress[0, 2] == pytest.approx(float(closed), rel=1e-8)


def solve_cylinder(material, stretches):
    """Mean nominal stresses along r and z of a cylinder of one element, Pa, by its reactions at base, top and side."""
    radial, axial = stretches[0], stretches[2]
    mesh = cylinder_mesh(SIZE, SIZE, (1, 1), Q9P1)
    supports = {"base": "z"} | ({} if radial is None else {"side": "r"}) | ({} if axial is None else {"top": "z"})
    solver = AxisymmetricSolver(mesh, material, supports, {})
    equations, state = solver.equations, solver.committed
    full, _ = solve_free_stretches(material.law, stretches, material.bulk_modulus)
    start = np.array([1.0 + AWAY * (found - 1.0) if given is None else given
                      for given, found in zip((radial, axial), full[[0, 2]], strict=True)])
    moved = ((start - 1.0) * (mesh.nodes - [0.0, -SIZE])).ravel()
    state.history[:, :moved.size] = equations.start[:] = moved
    step = solver.step(0.0, tolerance=1e-12, max_iterations=40)
    assert step.status is StepStatus.CONVERGED
    # The middle node of the element has no equation.
    forces = np.where(equations.equation < 0, 0.0, equations.residual[equations.equation]).reshape(-1, 2)
    volume = np.pi * SIZE**3
    return np.array([(forces[:, 0] @ mesh.nodes[:, 0]) / (2.0 * volume),
                     (forces[:, 1] @ mesh.nodes[:, 1]) / volume])


@EVERY_LAW
@pytest.mark.parametrize("mode", [name for name, each in MODES.items() if each[0] == each[1]])
def test_axisymmetric_element(law, mode):
    material = make_material(law)
    _, expected = solve_free_stretches(law, MODES[mode], material.bulk_modulus)
    np.testing.assert_allclose(solve_cylinder(material, MODES[mode]), expected[[0, 2]], rtol=1e-8,
                               atol=1e-8 * np.abs(expected).max())


@EVERY_LAW
@pytest.mark.parametrize(("kind", "stretches"), [
    ("uniaxial_tension", (None, None, 1.6)), ("lubricated_compression", (None, None, 0.7)),
    ("equibiaxial_tension", (1.2, 1.2, None)), ("planar_tension", (1.3, 1.0, None))])
def test_difference_to_the_incompressible_form(law, kind, stretches):
    """At most 2 mu0 / K of the stress. At larger stretches it grows with the tangent modulus of the law."""
    material = make_material(law)
    number = next(axis for axis in range(3) if stretches[axis] is not None)
    _, stresses = solve_free_stretches(law, stretches, material.bulk_modulus)
    closed = float(ts.KINDS[kind].closed_form.stress(material.energy_law, stretches[number], material.values))
    assert stresses[number] == pytest.approx(closed, rel=2.0 / RATIO)
    assert stresses[number] != pytest.approx(closed, rel=1e-6)
