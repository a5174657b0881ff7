"""Finite elements of a compressible law: closed forms in both solvers, tangent, bonded compression against FElupe."""

import numpy as np
import pytest
from solid_meshes import block

import tissue_sim as ts
from tissue_sim.fem.reduced.model import require_reducible
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.mesh.solid_element import HEX27P1
from tissue_sim.pose import Pose

pytestmark = pytest.mark.slow

#: Radius, edge and height of the specimen, m.
SIZE = 0.02
LAW = ts.find_law("hyperfoam_2")
VALUES = {"mu1": 1000.0, "alpha1": 4.0, "nu1": 0.2, "mu2": 500.0, "alpha2": -2.0, "nu2": 0.35}
FOAM = ts.Material("hyperfoam_2", VALUES)
#: Kind of test -> mode of the law.
MODES = {"lubricated_compression": "uniaxial", "confined_compression": "confined"}


def simulate(kind, specimen, material=FOAM, **options):
    """Compress a specimen by 40 % in 4 steps."""
    experiment = ts.KINDS[kind].experiment(specimen=specimen, protocol=ts.Protocol.ramp(0.4 * SIZE, points=5))
    return ts.simulate(ts.Model(experiment, material), **options)


@pytest.mark.parametrize("kind", MODES)
@pytest.mark.parametrize(("specimen", "solver"), [(ts.Specimen(SIZE, SIZE), "axisymmetric"),
                                                  (ts.Block(SIZE, SIZE, SIZE), "solid")], ids=["axisymmetric", "solid"])
def test_homogeneous_compression_is_the_closed_form(kind, specimen, solver):
    found = simulate(kind, specimen, solver=solver)
    expected = -specimen.area * LAW.nominal_stress(1.0 - found.displacement / SIZE, VALUES, MODES[kind])
    np.testing.assert_allclose(found.force, expected, rtol=1e-8, atol=1e-8 * expected.max())


@pytest.mark.parametrize("terms", [1, 3])
def test_laws_of_other_orders_share_the_kernel(terms):
    """Absent terms do not contribute; equal terms add up."""
    one = {"mu1": 900.0, "alpha1": 6.0, "nu1": 0.1}
    values = one if terms == 1 else {f"{name[:-1]}{i}": value / (3.0 if name == "mu1" else 1.0)
                                     for i in (1, 2, 3) for name, value in one.items()}
    found = simulate("lubricated_compression", ts.Specimen(SIZE, SIZE), ts.Material(f"hyperfoam_{terms}", values))
    expected = -np.pi * SIZE**2 * ts.find_law("hyperfoam_1").nominal_stress(1.0 - found.displacement / SIZE, one)
    np.testing.assert_allclose(found.force, expected, rtol=1e-8, atol=1e-8 * expected.max())
    assert ts.find_law(f"hyperfoam_{terms}").kernel_energy == LAW.kernel_energy


def test_tangent_is_the_derivative_of_the_forces():
    line, rng = np.linspace(0.0, 0.01, 2), np.random.default_rng(3)
    mesh = block(line, line * 1.5, line - 0.01, HEX27P1)
    tissue = SolidSolver(mesh, FOAM, {"base": "xyz"}, mesh.sets["top"], start=Pose.at_depth(0.0))
    batches, x = tissue.batches, tissue.x
    x[:] = rng.normal(0.0, 0.001, x.size)
    tissue.equations.assemble_and_get_least_volume_ratio()
    tangent, here, direction, h = batches.matrix.toarray(), x.copy(), rng.normal(size=x.size), 1e-8
    np.testing.assert_allclose(tangent, tangent.T, atol=1e-12 * np.abs(tangent).max())
    ends = []
    for step in (h, -h):
        x[:] = here + step * direction
        tissue.equations.assemble_and_get_least_volume_ratio()
        ends.append(batches.residual[:-1].copy())
    difference = (ends[0] - ends[1]) / (2.0 * h)
    np.testing.assert_allclose(tangent @ direction, difference, atol=1e-7 * np.abs(difference).max())


def test_bonded_compression_is_that_of_felupe():
    """FElupe's law of Storakers in bilinear axisymmetric elements, extrapolated over two meshes to element size 0.

    The corners are singular: the error decreases with the first power of the size.
    """
    fem = pytest.importorskip("felupe")
    forces = []
    for cells in (32, 64):
        mesh = fem.Rectangle(b=(SIZE, SIZE), n=(cells + 1, cells + 1))
        field = fem.FieldContainer([fem.FieldAxisymmetric(fem.RegionQuad(mesh), dim=2)])
        beta = [nu / (1.0 - 2.0 * nu) for nu in (VALUES["nu1"], VALUES["nu2"])]
        law = fem.Hyperelastic(fem.storakers, mu=[VALUES["mu1"], VALUES["mu2"]],
                               alpha=[VALUES["alpha1"], VALUES["alpha2"]], beta=beta)
        body = fem.SolidBody(law, field)
        bounds = {"base": fem.Boundary(field[0], fx=lambda x: np.isclose(x, 0.0)),
                  "side": fem.Boundary(field[0], fx=lambda x: np.isclose(x, SIZE), skip=(1, 0)),
                  "top": fem.Boundary(field[0], fx=lambda x: np.isclose(x, SIZE), skip=(0, 1), value=0.0)}
        for displacement in (0.1 * SIZE, 0.2 * SIZE):
            bounds["top"].value = -displacement
            dof0, dof1 = fem.dof.partition(field, bounds)
            fem.newtonraphson(items=[body], dof0=dof0, dof1=dof1, ext0=fem.dof.apply(field, bounds, dof0), verbose=0,
                              tol=1e-10)
        reaction = body.assemble.vector(field).toarray().reshape(-1, 2)[np.isclose(mesh.points[:, 0], SIZE), 0]
        forces.append(-float(reaction.sum()))
    extrapolated = 2.0 * forces[1] - forces[0]
    found = simulate("bonded_compression", ts.Specimen(SIZE, SIZE), resolution="accurate").force[2]
    assert found == pytest.approx(extrapolated, rel=1e-3)


def test_nearly_incompressible_parameters_are_refused():
    with pytest.raises(ts.InputError, match=r"K/mu0 of at most 10 with hyperfoam_1.*got 49"):
        simulate("lubricated_compression", ts.Specimen(SIZE, SIZE),
                 ts.Material("hyperfoam", {"mu1": 1000.0, "alpha1": 2.0, "nu1": 0.49}))


def test_reduced_solids_are_refused():
    needle = ts.KINDS["needle_indentation"].experiment(specimen=ts.Specimen(SIZE, SIZE), tool=ts.Tool("round", 2e-3),
                                                       protocol=ts.Protocol.ramp(1e-3, points=3))
    with pytest.raises(ts.InputError, match="compressible law in a reduced solid"):
        require_reducible(ts.Model(needle, FOAM))
