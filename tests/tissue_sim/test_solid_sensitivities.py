"""Exact derivatives of the solid's force against central differences of whole simulations; the force along a way."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.differentiation import FiniteDifferenceSettings
from tissue_sim.fem.contact.pairs import RelativeContactTolerances
from tissue_sim.fem.solid import discretisation
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.mesh.mesh_mapping import CylinderWithTopCircle, map_cylinder
from tissue_sim.mesh.solid import create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0
from tissue_sim.parameters import parameter, parameter_values, with_values

STUDY = {"C10": 1404.9, "C20": 699.4}
FLAT = ts.Tool("flat", radius=8e-3)
BALL = ts.Tool("sphere", radius=8e-3)
ROUND = ts.Tool("round", radius=8e-3)
OBLIQUE = ts.Approach(5e-3, math.radians(20.0))
PRONY = ts.Prony((ts.PronyTerm(0.3, 2.0),), "long_term")
SOFTENING = ts.Softening(0.3, 50.0, 0.5)
#: Specimen under self-weight whose stated height is that of the mould.
HEAVY = ts.Specimen(0.04, 0.05, density=1040.0, gravity=9.81, height_is="moulded")
#: The same with the height after it was placed on the base.
PLACED = replace(HEAVY, height_is="placed")
LUMP = {"lump": ts.Material("neo_hooke", {"C10": 2500.0}, ts.Bulk("bulk_ratio", 10.0), viscoelastic=ts.Prony((
    ts.PronyTerm(0.2, 1.0),)))}
OUT = (0.0, 1.0, 2.0, 1.0, 0.3)


@pytest.fixture(autouse=True)
def close_contact(monkeypatch):
    """Closer than a user needs: a remaining violation would show in the differences."""
    monkeypatch.setattr(discretisation, "TOLERANCES", RelativeContactTolerances(needle=1e-9, plate=1e-10))


@dataclass(frozen=True)
class Gel(ts.ContactLaw):
    """Pulls less as it is stretched, and drags the tissue along more the harder it is pressed, aside in another way."""

    name = "gel"
    tack: float = parameter("s", "Pa", key="tack_Pa", default=40.0)

    @property
    def reach(self):
        return 1e-3

    def traction(self, gap, pressure, slip, face):
        left = 1.0 - np.maximum(gap, 0.0) / self.reach
        return ts.Traction(self.tack * left**2, tuple((k * left + 200.0 * pressure) * way for k, way in zip(
            (1e5, 5e4), slip, strict=True)), drag_rates=((1e5, 0.0), (0.0, 5e4)))


def solid_mesh(centre=(0.0, 0.0), interfaces=()):
    return create_cylinder_mesh_under_needle(0.04, 0.05, 8e-3, HEX8P0, smallest=4e-3, growth=2.5, largest=30e-3,
                                             around=2,
                                             centre=centre,
                                             interfaces=np.cumsum(interfaces))


def model(tool=FLAT, friction="bonded", way=(0.0, 1.5, 3.0), approach=None, specimen=None, laws=(), base="bonded",
          **of_material):
    """The path in mm, one sample per second."""
    material = ts.Material("reduced_polynomial_2", STUDY, ts.Bulk("bulk_ratio", 1e4), **of_material)
    protocol = ts.Protocol(np.arange(1.0 * len(way)), 1e-3 * np.array(way))
    return ts.Model(ts.Experiment(specimen or ts.Specimen(0.04, 0.05), protocol, tool=tool, friction=friction,
                                  friction_base=base, approach=approach, contact_laws=laws), material)


def mesh_of(of):
    """Return a mesh with boundaries on the interfaces of layers, and a lateral region if the material has one."""
    if of.experiment.tool.is_plate:
        return create_cylinder_mesh_under_needle(0.04, 0.05, 0.024, HEX8P0, smallest=9e-3, growth=2.2, largest=20e-3,
                                                 around=2)
    mesh = solid_mesh((5e-3, 0.0) if of.experiment.approach else (0.0, 0.0), [
        layer.thickness for layer in of.material.layers])
    middle = mesh.nodes[mesh.connectivity].mean(axis=1)
    side = np.flatnonzero((middle[:, 0] > 0.0) & (middle[:, 2] > -0.02))
    return replace(mesh, regions=dict.fromkeys(of.material.regions, side))


def assert_exact(of, names, rel):
    mesh = mesh_of(of)
    answer = ts.sensitivities(of, names, solver="solid", mesh=mesh)
    assert answer.exact.all()
    for k, name in enumerate(names):
        value, width = parameter_values(of.material)[name], 1e-4
        more, less = (ts.simulate(ts.Model(of.experiment, with_values(of.material, {name: value * factor})),
                                  solver="solid", mesh=mesh).force for factor in (1 + width, 1 - width))
        slope = (more - less) / (2 * width * value)
        assert abs(slope).max() > 0.0
        np.testing.assert_allclose(answer.values[:, k], slope, rtol=0, atol=rel * abs(slope).max())
    return answer


@pytest.mark.slow
@pytest.mark.parametrize(("tool", "friction", "approach"), [
    (FLAT, "bonded", None), (FLAT, "bonded", OBLIQUE), (BALL, "frictionless", None), (BALL, "stick", None),
    (ROUND, 0.3, OBLIQUE)], ids=["bonded", "oblique", "ball", "ball that sticks", "oblique with friction"])
def test_elastic(tool, friction, approach):
    answer = assert_exact(model(tool, friction, approach=approach), ["C20"], 1e-6)
    assert answer.kinks.any() == (friction != "bonded")


def test_a_law_that_is_linear_in_its_parameters():
    """At constant bulk ratio the force is homogeneous of degree one in C10 and C20 (Euler), also with friction."""
    answer = ts.sensitivities(model(ROUND, 0.3, approach=OBLIQUE), ["C10", "C20"], solver="solid",
                              mesh=solid_mesh((5e-3, 0.0)))
    np.testing.assert_allclose(answer.values @ list(STUDY.values()), answer.recording.force, rtol=1e-7, atol=1e-12)


@pytest.mark.slow
def test_what_the_tissue_remembers():
    """Stresses of a Prony term and the largest load of softening depend on the parameters of the steps before."""
    of = model(way=(0.0, 2.0, 2.0, 1.0), viscoelastic=PRONY, softening=ts.Softening(0.3, 50.0, 0.5))
    assert_exact(of, ["C10", "viscoelastic.terms[0].g", "viscoelastic.terms[0].tau", "softening.loss"], 1e-6)


@pytest.mark.slow
def test_friction_with_a_past():
    """Anchors of what sticks and slips move with the parameters."""
    of = model(ROUND, 0.3, (0.0, 1.0, 2.0, 2.0), viscoelastic=PRONY)
    assert_exact(of, ["C20", "viscoelastic.terms[0].g"], 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("options", "names"), [
    ({"way": (0.0, 1.5, 3.0, 2.0), "softening": SOFTENING},
     ["C10", "softening.loss", *(f"regions.lump.{name}" for name in (
         "C10", "bulk.bulk_ratio", "viscoelastic.terms[0].g", "viscoelastic.terms[0].tau"))]),
    ({"tool": ROUND, "friction": 0.3, "approach": OBLIQUE, "viscoelastic": PRONY}, ["C20", "regions.lump.C10"]),
    ({"tool": BALL, "friction": 0.3, "specimen": HEAVY},
     ["C10", "regions.lump.C10", "regions.lump.viscoelastic.terms[0].g"])], ids=["bonded", "oblique", "that weighs"])
def test_several_materials(options, names):
    """Each region has its law, bulk response and history."""
    assert_exact(model(regions=LUMP, **options), names, 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("options", "names"), [
    ({}, ["C10", "C20"]), ({"tool": ROUND, "friction": 0.3, "approach": OBLIQUE}, ["C10"]),
    ({"tool": BALL, "friction": "frictionless"}, ["C10"]), ({"tool": ts.Tool(), "base": "as_tool"}, ["C10"]),
    ({"tool": ts.Tool(), "friction": 0.2, "base": "as_tool"}, ["C10"]),
    ({"tool": ts.Tool(), "friction": "frictionless", "base": "as_tool"}, ["C10"]),
    ({"way": (0.0, 2.0, 2.0, 1.0), "viscoelastic": PRONY, "softening": SOFTENING},
     ["C10", "viscoelastic.terms[0].g", "viscoelastic.terms[0].tau", "softening.loss"])],
    ids=["bonded", "oblique", "ball", "bonded plates", "plates with friction", "plates without", "with a past"])
def test_weight(options, names):
    """Self-weight enters the equilibrium, the history, the height of the tool's contact, and the level of a plate."""
    assert_exact(model(**{"specimen": HEAVY, **options}), names, 1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("options", "names"), [
    ({"layers": (ts.Layer(5e-3, 3.0),)}, ["C10", "layers[0].ratio"]),
    ({"tool": BALL, "friction": 0.3, "base": "stick", "viscoelastic": PRONY}, ["C10", "viscoelastic.terms[0].g"]),
    ({"tool": ROUND, "friction": 0.3, "approach": OBLIQUE, "softening": SOFTENING}, ["C10"]),
    ({"tool": ts.Tool(), "friction": 0.2, "base": "as_tool"}, ["C10"])], ids=["layers", "ball", "oblique", "plates"])
def test_a_height_that_was_measured_as_placed(options, names):
    """The moulded height is another with each parameter, and the force feels that: 2e-3 of the largest derivative."""
    of = model(**{"specimen": PLACED, **options})
    answer = assert_exact(of, names, 1e-6)
    mesh = make_solver(of, mesh=mesh_of(of)).mesh
    moulded = replace(of, experiment=replace(of.experiment, specimen=HEAVY))
    held = ts.sensitivities(moulded, names[:1], solver="solid", mesh=mesh).values[:, 0]
    assert np.abs(held - answer.values[:, 0]).max() > 1e-3 * np.abs(held).max()


@pytest.mark.slow
@pytest.mark.parametrize(("options", "names"), [
    ({"tool": BALL, "laws": [ts.Adhesion(0.02, 0.5e-3)]}, ["C10"]),
    ({"tool": BALL, "friction": 0.3, "laws": [ts.Adhesion(0.02, 0.5e-3)]}, ["C10"]),
    ({"tool": ts.Tool(), "way": (0.0, 1.0, 0.5, 0.0, -0.1), "laws": [Gel()]}, ["C10", "C20"]),
    ({"tool": ROUND, "approach": OBLIQUE, "viscoelastic": PRONY, "laws": [Gel()]},
     ["C10", "viscoelastic.terms[0].g"]),
    ({"tool": BALL, "specimen": HEAVY, "viscoelastic": PRONY, "laws": [ts.Adhesion(0.02, 0.5e-3)]},
     ["C10", "viscoelastic.terms[0].tau"]),
    ({"tool": ts.Tool(), "way": (0.0, 1.0, 0.5, 0.0, -0.1), "specimen": HEAVY, "laws": [Gel()]}, ["C10"]),
    ({"tool": BALL, "way": (0.0, 1.0, 2.0, 1.0, 0.0), "specimen": PLACED, "laws": [Gel()]}, ["C10"])],
    ids=["adhesion", "adhesion and friction", "gel under a plate", "oblique gel", "adhesion and weight",
         "gel and weight", "gel and a height as placed"])
def test_laws_of_contact(options, names):
    """In and out again; what has touched is pulled and dragged."""
    of = model(**{"friction": "frictionless", "way": OUT, **options})
    answer = assert_exact(of, names, 1e-6)
    assert answer.recording.force.min() < 0.0 or of.experiment.approach, "some of it pulls"


@pytest.mark.slow
def test_by_difference_where_laws_act_on_a_side_as_high_as_placed():
    """A plate may come to lie on the upper half of the side, whose area depends on the height."""
    of = model(ts.Tool(), "frictionless", (0.0, 1.0), specimen=PLACED, laws=[Gel()])
    answer = ts.sensitivities(of, ["C10"], solver="solid", mesh=mesh_of(of))
    assert not answer.exact.any() and answer.values[-1, 0] > 0.0


@pytest.mark.slow
def test_geometry_moves_the_nodes_of_one_mesh():
    """Nodes of one mesh move, so that derivatives by differences do not depend on their width."""
    slopes = []
    for width in (1e-2, 1e-4):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("tissue_sim.differentiation.DIFFERENCES", FiniteDifferenceSettings(simulation_width=width))
            answer = ts.sensitivities(model(approach=OBLIQUE, way=(0.0, 2.0)), ["experiment.tool.radius",
                                                                                "experiment.approach.offset",
                                                                                "experiment.approach.angle"],
                                      solver="solid", mesh=solid_mesh((5e-3, 0.0)))
        assert answer.exact.tolist() == [True, False, False]
        slopes.append(answer.values[-1])
    np.testing.assert_allclose(*slopes, rtol=0.01)
    assert slopes[0][0] > 0.0


def test_a_moved_mesh_has_its_circle_and_its_side():
    before, after = CylinderWithTopCircle(0.04, 0.05, 8e-3, (5e-3, 0.0)), CylinderWithTopCircle(0.05, 0.04, 6e-3,
                                                                                                (-3e-3, 2e-3))
    mesh = solid_mesh((5e-3, 0.0))
    moved = map_cylinder(mesh, before, after)
    edge = np.intersect1d(mesh.sets["face"], mesh.sets["free"])
    np.testing.assert_allclose(np.hypot(*(moved.nodes[edge, :2] - after.centre).T), 6e-3, rtol=1e-12)
    corners = np.hypot(*mesh.nodes[:, :2].T) > 0.04 * (1 - 1e-12)
    assert corners.sum() > 8
    np.testing.assert_allclose(np.hypot(*moved.nodes[corners, :2].T), 0.05, rtol=1e-12)
    assert moved.nodes[:, 2].min() == pytest.approx(-0.04)
    np.testing.assert_allclose(map_cylinder(moved, after, before).nodes, mesh.nodes, atol=1e-15)


def test_the_force_of_a_recording_is_that_against_the_way():
    """The force is that on a load cell of the stage; the work of the stage equals that of the wrench."""
    recording = ts.simulate(model(approach=OBLIQUE), solver="solid", mesh=solid_mesh((5e-3, 0.0)))
    way = np.array([math.sin(OBLIQUE.angle), 0.0, -math.cos(OBLIQUE.angle)])
    vector = np.column_stack([recording.channel(name) for name in ("Fx", "Fy", "Fz")])
    np.testing.assert_allclose(recording.force, -vector @ way, rtol=1e-12, atol=1e-15)
    assert abs(recording.force[-1] / recording.channel("Fz")[-1] - 1.0) > 0.01
