"""Self-weight and layers of the solid in space: columns by hand, and the axisymmetric solid."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

import tissue_sim as ts
from tissue_sim.fem.solid.discretisation import build_mesh, make_solver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh.solid import create_block_mesh_from_boundaries, create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX27P1
from tissue_sim.pose import Pose

#: Name of the law.
LAW = "reduced_polynomial_2"
#: Parameters of the reference study, Pa.
STUDY = {"C10": 1404.9, "C20": 699.4}
#: Density, kg/m3.
DENSITY = 1040.0
#: Gravitational acceleration, m/s2.
GRAVITY = 9.81
WEIGHT = DENSITY * GRAVITY
FLAT = ts.Tool("flat", 8e-3)


def model(friction="bonded", tool=None, *, specimen=None, gravity=GRAVITY, height_is="moulded", ratio=1e3, layers=(),
          depth=2e-3, base=None):
    specimen = specimen or ts.Specimen(0.04, 0.07, density=DENSITY, gravity=gravity, height_is=height_is)
    experiment = ts.Experiment(specimen, ts.Protocol.ramp(depth, 2), tool=tool or ts.Tool(), friction=friction,
                               friction_base=base or friction)
    return ts.Model(experiment, ts.Material(LAW, STUDY, ts.Bulk("bulk_ratio", ratio), layers=layers))


def column_sag(height):
    """Return the sag of the one-dimensional incompressible column: each slice carries the weight above it."""
    def stress(stretch):
        invariant = stretch**2 + 2 / stretch - 3
        return 2 * (STUDY["C10"] + 2 * STUDY["C20"] * invariant) * (stretch - stretch**-2)

    def loss(load):
        return 1 - brentq(lambda stretch: stress(stretch) + load, 0.2, 1.0)

    return quad(lambda above: loss(WEIGHT * above), 0, height)[0]


def test_a_confined_column_is_pressed_together_by_its_weight():
    """Small weight between walls that let it slide: u(z) = -w / (K + 4 mu / 3) (H z - z^2 / 2) from the base."""
    height, ratio = 0.05, 20.0
    light = ts.Specimen(shape="block", length=0.02, width=0.02, height=height, density=1e-3 * DENSITY, gravity=GRAVITY)
    m = model("frictionless", specimen=light, ratio=ratio)
    mesh = create_block_mesh_from_boundaries(np.linspace(-0.01, 0.01, 2), np.linspace(-0.01, 0.01, 2),
                                             np.linspace(-height, 0.0, 6), HEX27P1)
    x, y, _ = np.abs(mesh.nodes.T)
    walls = {"x": np.flatnonzero(x > 0.01 - 1e-9), "y": np.flatnonzero(y > 0.01 - 1e-9)}
    mesh.sets.update({f"wall {axis}": nodes for axis, nodes in walls.items()})
    from tissue_sim.fem.solid.solver import SolidSolver

    solver = SolidSolver(mesh, m.material, {"base": "xyz", "wall x": "x", "wall y": "y"}, np.zeros(0, int),
                         start=Pose.at_depth(0.0), specific_weight=light.specific_weight)
    assert solver.step(Pose.at_depth(0.0)).status is StepStatus.CONVERGED
    mu = m.material.mu0
    over = mesh.nodes[:, 2] + height
    expected = -light.specific_weight / (ratio * mu + 4 / 3 * mu) * (height * over - over**2 / 2)
    np.testing.assert_allclose(solver.x[2::3], expected, rtol=2e-5, atol=1e-6 * np.abs(expected).max())


def standing(width, height):
    """A block on a base without friction, which has settled."""
    tall = ts.Block(width, width, height, density=DENSITY, gravity=GRAVITY)
    line = np.linspace(-0.5 * width, 0.5 * width, 2 + (height < 3.0 * width))
    return make_solver(model("frictionless", specimen=tall, ratio=1e3),
                       mesh=create_block_mesh_from_boundaries(line, line, np.linspace(-height, 0.0, 6), HEX27P1))


def test_sag_of_a_block():
    """The one-dimensional theory neglects terms of second order in width over height."""
    assert standing(0.02, 0.045).sag == pytest.approx(column_sag(0.045), rel=3e-3)


def test_a_slender_block_falls_over():
    """Greenhill's height (Proc. Camb. Phil. Soc. 4 (1881) 65): H^3 = 7.8373 E I / (w A)."""
    width, young = 0.01, 6.0 * STUDY["C10"]
    critical = (7.8373 * young * width**2 / 12 / WEIGHT) ** (1 / 3)
    assert standing(width, 0.93 * critical).sag > 0.0
    with pytest.raises(ts.ConvergenceError, match=r"has no equilibrium under its own weight.*no longer stable"):
        standing(width, 1.2 * critical)


def coarse(tool=None, layers=()):
    """2700 freedoms, with boundaries on the interfaces."""
    mesh = create_cylinder_mesh_under_needle(0.04, 0.07, 8e-3 if tool else 0.024, HEX27P1,
                                             smallest=2.4e-3 if tool else 9e-3,
                                             growth=2.2,
                                             largest=20e-3, around=2,
                                             interfaces=np.cumsum([layer.thickness for layer in layers]))
    return mesh


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "tool", "height_is"), [
    ("frictionless", None, "moulded"), ("bonded", None, "placed"), ("bonded", FLAT, "moulded")])
def test_weight_is_that_of_the_axisymmetric_solid(friction, tool, height_is):
    m = model(friction, tool, height_is=height_is, base="bonded" if tool else None)
    expected, found = ts.simulate(m), ts.simulate(m, solver="solid", mesh=coarse(tool))
    assert found.force[-1] == pytest.approx(expected.force[-1], rel=0.015)
    assert abs(found.force[0]) < 1e-6
    sags = [each.metadata["solver"]["self_weight"] for each in (expected, found)]
    assert sags[1]["sag_mm"] == pytest.approx(sags[0]["sag_mm"], rel=0.01)
    if height_is == "placed":
        assert sags[1]["moulded_height_mm"] - sags[1]["sag_mm"] == pytest.approx(70.0, abs=1e-6)


@pytest.mark.slow
def test_a_tool_that_is_taken_away_leaves_a_specimen_that_has_settled():
    solver = make_solver(model("stick", FLAT, base="bonded"), mesh=coarse(FLAT))
    sagged = solver.x.copy()
    assert np.abs(sagged).max() > 2e-3
    assert solver.step(Pose.at_depth(1e-3)).force > 0.05
    solver.reset_to_first_touch()
    again = solver.step(Pose.at_depth(0.0))
    assert again.status is StepStatus.CONVERGED and abs(again.force) < 1e-6
    np.testing.assert_allclose(solver.x, sagged, atol=1e-9)


@pytest.mark.slow
def test_what_slips_goes_on_where_nothing_moves():
    """All of a specimen's base but its middle slips as it settles. A plate that begins to press it holds nothing aside;
    where some of the base were taken to stick it would be the roundings that choose them."""
    m = model(0.2)
    solver = make_solver(m, mesh=coarse(None))
    slipped = solver.contact.slipped.copy()
    assert slipped.sum() > 30
    for _ in range(2):
        step = solver.step(solver.pose)
        assert step.status is StepStatus.CONVERGED and step.iterations == 0 and step.slipping == slipped.sum()
        np.testing.assert_array_equal(solver.contact.slipped, slipped)
    assert solver.step(Pose.at_depth(1e-3), max_iterations=7).status is StepStatus.CONVERGED


@pytest.mark.slow
@pytest.mark.parametrize(("tool", "layers", "precision"), [
    (FLAT, (ts.Layer(2e-3, 5.0),), 0.03), (FLAT, (ts.Layer(4e-3, 3.0), ts.Layer(10e-3, 0.4)), 0.02),
    (None, (ts.Layer(20e-3, 3.0),), 0.01)])
def test_layers_are_those_of_the_axisymmetric_solid(tool, layers, precision):
    """On a mesh of the same fineness without layers the needle is 1.5 % too stiff."""
    m = model("bonded", tool, gravity=0.0, layers=layers)
    expected = ts.simulate(m).force[-1]
    found = ts.simulate(m, solver="solid", mesh=coarse(tool, layers)).force[-1]
    assert found == pytest.approx(expected, rel=precision)
    bare = ts.simulate(model("bonded", tool, gravity=0.0)).force[-1]
    assert abs(expected / bare - 1.0) > 2.0 * precision


def test_interfaces_are_boundaries_of_elements():
    layers = (ts.Layer(0.7e-3, 3.0), ts.Layer(1.9e-3, 0.5), ts.Layer(20e-3, 2.0))
    for specimen in (ts.Specimen(0.04, 0.07), ts.Block(0.06, 0.05, 0.07)):
        for tool in (None, FLAT):
            mesh = build_mesh(model(tool=tool, specimen=specimen).experiment, "realtime", layers)
            z = np.unique(mesh.nodes[:, 2])
            for interface in (-0.7e-3, -2.6e-3, -22.6e-3):
                assert abs(z - interface).min() < 1e-12
    with pytest.raises(ts.InputError, match="thinner than the specimen, height 70 mm; got 80 mm"):
        build_mesh(model().experiment, "realtime", (ts.Layer(0.08, 2.0),))
