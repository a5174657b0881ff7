"""The axisymmetric solid against closed forms, finite differences and itself."""

import numpy as np
import pytest
from scipy.optimize import brentq

import tissue_sim as ts
from tissue_sim.fem.axisymmetric.solver import AxisymmetricSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh import cylinder_mesh, divide_into_graded_intervals, structured_mesh
from tissue_sim.mesh.elements import Q4P0, Q9P1

LAWS = {
    "reduced_polynomial_2": {"C10": 1404.9, "C20": 699.4},
    "mooney_rivlin": {"C10": 624.3, "C01": 746.1},
    "ogden_1": {"mu1": 3225.9, "alpha1": 14.8},
}
every_element = pytest.mark.parametrize("element", [Q9P1, Q4P0], ids=lambda e: e.name)
every_law = pytest.mark.parametrize("law", LAWS)


def material(law="reduced_polynomial_2", ratio=1e4):
    return ts.Material(law, LAWS[law], ts.Bulk("bulk_ratio", ratio))


def compressible_force(material, stretch, area):
    """Homogeneous uniaxial compression of the slightly compressible solid: the lateral stretch that frees the side.

    Independent of the elements: principal Kirchhoff stresses and U(J) = K/2 (J - 1)^2.
    """
    K = material.bulk_modulus

    def stresses(lateral):
        _, tau = material.energy_law.compute_energy_and_kirchhoff_stresses([stretch, lateral, lateral],
                                                                           material.parameters)
        J = stretch * lateral**2
        return tau + K * (J - 1) * J

    lateral = brentq(lambda x: stresses(x)[1], 0.9 * stretch**-0.5, 1.1 * stretch**-0.5, xtol=1e-15, rtol=1e-15)
    return -stresses(lateral)[0] / stretch * area


@pytest.mark.slow
@every_element
@every_law
@pytest.mark.parametrize("ratio", [50.0, 1e3, 1e5])
def test_lubricated_compression_is_the_homogeneous_solution(element, law, ratio):
    mesh = cylinder_mesh(0.04, 0.07, (3, 4), element, grading=(2.5, 1.5))
    stuff = material(law, ratio)
    solver = AxisymmetricSolver(mesh, stuff, {"base": "z"}, {"top": "z"})
    for depth in (2e-3, 5e-3, 10e-3, 20e-3):
        step = solver.step(depth)
        assert step.status is StepStatus.CONVERGED
        expected = compressible_force(stuff, 1 - depth / 0.07, np.pi * 0.04**2)
        assert step.force == pytest.approx(expected, rel=1e-9)


def test_lubricated_compression_tends_to_the_incompressible_closed_form():
    """The difference to the closed form falls in proportion to mu/K."""
    law = ts.find_law("reduced_polynomial_2")
    closed = -law.nominal_stress(1 - 10 / 70, LAWS["reduced_polynomial_2"]) * np.pi * 0.04**2
    errors = []
    for ratio in (1e2, 1e3, 1e4, 1e5):
        solver = AxisymmetricSolver(cylinder_mesh(0.04, 0.07, (2, 2), Q9P1), material(ratio=ratio), {"base": "z"},
                                    {"top": "z"})
        errors.append(abs(solver.step(10e-3).force / closed - 1))
    np.testing.assert_allclose(np.array(errors[:-1]) / errors[1:], 10.0, rtol=0.05)


@pytest.mark.slow
@every_element
def test_patch(element):
    """Irregular quadrilaterals carry a homogeneous deformation exactly."""
    mesh = cylinder_mesh(0.04, 0.07, (3, 3), element)
    nodes = mesh.nodes.copy()
    inside = np.ones(len(nodes), dtype=bool)
    for members in mesh.sets.values():
        inside[members] = False
    rng = np.random.default_rng(1)
    if element is Q4P0:
        nodes[inside] += rng.uniform(-2e-3, 2e-3, (inside.sum(), 2))
    else:
        # Move the corners and place the other nodes half way, so that the map stays bilinear.
        corners = np.unique(mesh.connectivity[:, :4])
        moved = corners[inside[corners]]
        nodes[moved] += rng.uniform(-2e-3, 2e-3, (moved.size, 2))
        shapes = np.stack([(1 + a * element.reference_nodes[:, 0]) * (1 + b * element.reference_nodes[:, 1]) / 4
                           for a, b in element.reference_nodes[:4]], axis=-1)
        nodes[mesh.connectivity] = np.einsum("ac,eci->eai", shapes, nodes[mesh.connectivity[:, :4]])
    mesh = type(mesh)(element, nodes, mesh.connectivity, mesh.sets)
    stuff = material(ratio=1e3)
    solver = AxisymmetricSolver(mesh, stuff, {"base": "z"}, {"top": "z"})
    step = solver.step(7e-3)
    assert step.force == pytest.approx(compressible_force(stuff, 0.9, np.pi * 0.04**2), rel=1e-9)


@pytest.mark.slow
@every_element
@every_law
def test_tangent_is_the_derivative_of_the_residual(element, law):
    """Every column of the condensed tangent at a strained state, against central differences of nodal forces.

    The nodal forces come from a second solver in which all shared nodes are moved as told; only what is condensed,
    interior nodes and pressures, is free to settle there.
    """
    mesh = cylinder_mesh(0.04, 0.07, (2, 2), element)
    stuff = material(law, 1e3)
    solver = AxisymmetricSolver(mesh, stuff, {"base": "rz"}, {"top": "rz"})
    depth = 8e-3
    assert solver.step(depth).status is StepStatus.CONVERGED
    tangent = _full(solver.equations.assemble_committed_tangent())

    state = solver.state[: 2 * len(mesh.nodes)]
    shared = np.unique(mesh.connectivity[:, : element.boundary_nodes])
    everything_held = type(mesh)(element, mesh.nodes, mesh.connectivity, {**mesh.sets, "shared": shared})

    def nodal_forces(displacement):
        held = AxisymmetricSolver(everything_held, stuff, {"shared": "rz"}, {})
        assert held.equations.free == 0
        held.equations.direction[:] = displacement / depth
        assert held.step(depth, tolerance=1e-13, max_iterations=20).status is StepStatus.CONVERGED
        return held.equations.residual[held.equations.equation]

    h = 1e-7
    unknowns = np.flatnonzero((solver.equations.equation >= 0) & (solver.equations.equation < solver.equations.free))
    numeric = np.zeros_like(tangent)
    for dof in unknowns:
        step = h * (np.arange(state.size) == dof)
        column = (nodal_forces(state + step) - nodal_forces(state - step)) / (2 * h)
        numeric[solver.equations.equation[unknowns], solver.equations.equation[dof]] = column[unknowns]
    assert abs(tangent - numeric).max() < 1e-7 * abs(tangent).max()


class TestStepping:
    def solver(self):
        return AxisymmetricSolver(cylinder_mesh(0.04, 0.07, (4, 5), Q9P1), material(), {"base": "rz"}, {"top": "rz"})

    def test_path_does_not_matter(self):
        """An elastic solid: the force depends on the depth only, not on the steps or on unloading."""
        one, many = self.solver(), self.solver()
        direct = one.step(6e-3)
        for depth in (1e-3, 4e-3, 9e-3, 5e-3, 5.5e-3, 6e-3):
            step = many.step(depth)
            assert step.status is StepStatus.CONVERGED
        assert step.force == pytest.approx(direct.force, rel=1e-9)
        assert many.step(0.0).force == pytest.approx(0.0, abs=1e-9)

    def test_predictor_saves_iterations(self):
        spent = []
        for order in (0, 2):
            solver = self.solver()
            spent.append(sum(solver.step(d, predictor_order=order).iterations for d in np.linspace(2e-4, 1e-2, 50)))
        assert spent[1] < 0.7 * spent[0]

    def test_failed_step_commits_nothing(self):
        solver = self.solver()
        good = solver.step(4e-3)
        assert solver.step(69e-3).status is not StepStatus.CONVERGED
        assert solver.depth == 4e-3
        again = solver.step(4e-3)
        assert again.force == pytest.approx(good.force, rel=1e-9) and again.iterations <= 1

    def test_every_status_has_words(self):
        assert all(status.message for status in StepStatus)

    def test_set_material_scales_the_force(self):
        """The force is homogeneous of degree one in the moduli."""
        solver = self.solver()
        first = solver.step(5e-3).force
        solver.set_material(ts.Material("reduced_polynomial_2", {"C10": 2809.8, "C20": 1398.8},
                                        ts.Bulk("bulk_ratio", 1e4)))
        assert solver.step(5e-3).force == pytest.approx(2 * first, rel=1e-9)

    def test_bulk_ratio_out_of_range(self):
        with pytest.raises(ts.InputError, match=r"K/mu0 must be .* got 1\.5"):
            AxisymmetricSolver(cylinder_mesh(0.04, 0.07, (2, 2), Q9P1), material(ratio=1.5), {}, {"top": "z"})

    def test_band_is_narrow_in_flat_and_in_tall_specimens(self):
        """The half band follows the shorter side of the mesh, and the answer does not depend on the numbering."""
        flat, tall = (AxisymmetricSolver(cylinder_mesh(0.04, 0.07, counts, Q9P1), material(), {"base": "rz"},
                                         {"top": "rz"}) for counts in ((12, 3), (3, 12)))
        assert flat.equations.half_band < 40 and tall.equations.half_band < 40
        dense = np.linalg.solve(_full(flat.equations.assemble_committed_tangent()), np.ones(flat.equations.free))
        assert np.isfinite(dense).all() and flat.step(3e-3).force == pytest.approx(tall.step(3e-3).force, rel=0.02)


def _full(lower):
    """Symmetric dense matrix of LAPACK's lower band storage."""
    size = lower.shape[1]
    dense = np.zeros((size, size))
    for d in range(lower.shape[0]):
        i = np.arange(size - d)
        dense[i + d, i] = dense[i, i + d] = lower[d, : size - d]
    return dense


class TestMesh:
    def test_graded_line(self):
        line = divide_into_graded_intervals(10.0, 5, 16.0, "last")
        np.testing.assert_allclose(np.diff(line)[:-1] / np.diff(line)[1:], 2.0)
        both = np.diff(divide_into_graded_intervals(10.0, 6, 1.5, "both"))
        np.testing.assert_allclose(both, both[::-1])
        assert both.max() / both.min() == pytest.approx(1.5)
        assert divide_into_graded_intervals(10.0, 5, 2.0, "first")[-1] == 10.0

    @pytest.mark.parametrize(("count", "grading", "ends"), [(0, 1.0, "last"), (3, 0.5, "last"), (3, 1.0, "left")])
    def test_bad_grading(self, count, grading, ends):
        with pytest.raises(ts.InputError):
            divide_into_graded_intervals(1.0, count, grading, ends)

    @every_element
    def test_volume(self, element):
        solver = AxisymmetricSolver(cylinder_mesh(0.04, 0.07, (3, 4), element, grading=(2.0, 2.0)), material(),
                                    {"base": "z"}, {"top": "z"})
        assert solver.equations.reference.weights.sum() == pytest.approx(np.pi * 0.04**2 * 0.07, rel=1e-12)

    def test_mesh_starts_at_the_axis(self):
        with pytest.raises(ts.InputError, match="the first radius must be 0, the axis"):
            structured_mesh(np.array([0.01, 0.02]), np.array([-0.07, 0.0]), Q4P0)

    def test_folded_mesh_is_refused(self):
        mesh = structured_mesh(np.array([0.0, 0.02, 0.01]), np.array([-0.07, 0.0]), Q4P0)
        with pytest.raises(ts.InputError, match="elements of positive area; got an element of zero or negative area"):
            AxisymmetricSolver(mesh, material(), {"base": "z"}, {"top": "z"})
