"""Exact derivatives of a solid's force with respect to sizes of specimen and tool.

They are compared with extrapolated differences of whole simulations, and in homogeneous compression with a closed form.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from force_differences import assert_exact

import tissue_sim as ts
from tissue_sim.fem.contact import pairs
from tissue_sim.fem.contact.pairs import RelativeContactTolerances
from tissue_sim.fem.solid import discretisation
from tissue_sim.fem.solid.discretisation import RESOLUTIONS, Resolution
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1
from tissue_sim.specimen.block import Block
from tissue_sim.specimen.cylinder import Cylinder

RADIUS = "experiment.specimen.radius"
HEIGHT = "experiment.specimen.height"
LENGTH = "experiment.specimen.length"
WIDTH = "experiment.specimen.width"
TOOL = "experiment.tool.radius"
EDGE = "experiment.tool.edge_radius"
CYLINDER = ts.Specimen(0.04, 0.05)
BLOCK = Block(0.09, 0.08, 0.05)
FLAT = ts.Tool("flat", 8e-3)
ROUNDED = ts.Tool("flat", 8e-3, edge_radius=2e-3)
ROUND = ts.Tool("round", 8e-3)
BALL = ts.Tool("sphere", 8e-3)
CONE = ts.Tool("cone", radius=8e-3, half_angle=math.radians(60.0), tip_radius=1e-3)
OBLIQUE = ts.Approach(5e-3, math.radians(20.0))
PRONY = ts.Prony((ts.PronyTerm(0.3, 2.0),), "long_term")
#: Loading, hold and unloading, mm.
CYCLE = (0.0, 1.0, 2.0, 2.0, 1.5)
OPTIONS = {"solver": "solid", "resolution": "few"}


@pytest.fixture(autouse=True)
def few_elements_and_close_contact(monkeypatch):
    """Closer than a user needs: a remaining violation would show in the differences."""
    monkeypatch.setattr(pairs, "TOLERANCES", RelativeContactTolerances(needle=1e-10, plate=1e-12))
    monkeypatch.setattr(discretisation, "TOLERANCES", RelativeContactTolerances(needle=1e-9, plate=1e-10))
    monkeypatch.setitem(RESOLUTIONS, "few", Resolution(HEX8P0, 0.5, 2.4, 3.0, 2))
    monkeypatch.setitem(RESOLUTIONS, "few of 27 nodes", Resolution(HEX27P1, 0.8, 3.0, 4.0, 1))


def model(tool, specimen=CYLINDER, way=(0.0, 1.5, 3.0), of_material=(), **options):
    """Return a model whose tool moves by `way`, mm, in steps of 1 s."""
    protocol = ts.Protocol(np.arange(1.0 * len(way)), 1e-3 * np.array(way))
    bulk = ts.Bulk("bulk_ratio", 1e4)
    tissue = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, **{"bulk": bulk, **dict(of_material)})
    return ts.Model(ts.Experiment(specimen, protocol, tool, **options), tissue)


@pytest.mark.parametrize(("tool", "options", "paths"), [
    (FLAT, {}, [RADIUS, HEIGHT, TOOL]),
    (ROUND, {"friction": 0.3}, [TOOL]),
    (ts.Tool(), {"specimen": BLOCK, "friction": 0.3, "friction_base": 0.2}, [LENGTH, WIDTH, HEIGHT])],
    ids=["bonded", "round", "plates"])
def test_sizes(tool, options, paths):
    assert assert_exact(model(tool, **options), paths, **OPTIONS) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("tool", "options", "paths"), [
    (ts.Tool(), {}, [RADIUS, HEIGHT]),
    (ts.Tool(), {"friction": 0.3, "friction_base": 0.2}, [RADIUS, HEIGHT]),
    (FLAT, {"way": (0.0, 0.4, 0.8), "friction": "frictionless"}, [RADIUS, HEIGHT, TOOL]),
    (ROUNDED, {}, [RADIUS, HEIGHT, TOOL, EDGE]),
    (ROUNDED, {"friction": "frictionless"}, [RADIUS, HEIGHT, TOOL, EDGE]),
    (ROUNDED, {"friction": "stick"}, [RADIUS, HEIGHT, TOOL, EDGE]),
    (ROUNDED, {"friction": 0.3}, [RADIUS, HEIGHT, TOOL, EDGE]),
    (ROUNDED, {"way": (0.0, 3.0, 6.0), "friction": 0.3, "friction_wall": 0.3}, [RADIUS, HEIGHT, TOOL, EDGE]),
    (ROUND, {"friction": "frictionless"}, [RADIUS, HEIGHT, TOOL]),
    (ROUND, {"friction": "stick"}, [RADIUS, HEIGHT, TOOL]),
    (BALL, {"friction": 0.05}, [RADIUS, HEIGHT, TOOL]),
    (CONE, {"friction": 0.3}, [RADIUS, HEIGHT])],
    ids=["plates, bonded", "plates, friction", "sharp face without friction", "rounded edge, bonded",
         "rounded edge without friction", "rounded edge, stick", "rounded edge, friction", "face and shaft", "round",
         "round, stick", "ball", "cone"])
def test_sizes_under_upright_tools(tool, options, paths):
    assert assert_exact(model(tool, **options), paths, **OPTIONS) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("tool", "options", "paths"), [
    (FLAT, {"approach": ts.Approach(1e-2, 0.0)}, [RADIUS, HEIGHT, TOOL]),
    (ROUND, {"friction": 0.3, "approach": OBLIQUE, "way": (0.0, 1.0, 2.0)}, [RADIUS, HEIGHT, TOOL]),
    (ROUNDED, {"friction": 0.3, "approach": OBLIQUE}, [RADIUS, HEIGHT, TOOL, EDGE]),
    (ROUND, {"friction": 0.3, "approach": OBLIQUE, "way": CYCLE, "of_material": {"viscoelastic": PRONY}},
     [RADIUS, HEIGHT, TOOL]),
    (ROUND, {"specimen": BLOCK, "friction": 0.3, "approach": OBLIQUE}, [LENGTH, WIDTH, HEIGHT, TOOL])],
    ids=["off the axis", "oblique", "oblique with rounded edge", "oblique with a Prony term", "oblique on a block"])
def test_sizes_under_other_approaches(tool, options, paths):
    assert assert_exact(model(tool, **options), paths, **OPTIONS) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("of_material", [
    {"viscoelastic": PRONY}, {"softening": ts.Softening(0.4, 200.0, 0.5)}, {"bulk": ts.Bulk("incompressible")},
    {"poroelasticity": ts.Poroelasticity(0.5, 1e-5)}], ids=["Prony", "softening", "incompressible", "drainage"])
def test_sizes_with_other_materials(of_material):
    """The bulk modulus of incompressible tissue depends on the specimen, the time of drainage on the contact radius."""
    paths = [RADIUS, HEIGHT, TOOL]
    assert assert_exact(model(FLAT, way=CYCLE, of_material=of_material), paths, **OPTIONS) == 1.0


@pytest.mark.slow
@pytest.mark.parametrize(("tool", "options"), [(FLAT, {}), (ROUND, {"friction": 0.3})], ids=["bonded", "round"])
def test_sizes_with_quadratic_elements(tool, options):
    paths = [RADIUS, HEIGHT, TOOL]
    assert assert_exact(model(tool, **options), paths, **OPTIONS | {"resolution": "few of 27 nodes"}) == 1.0


@pytest.mark.slow
def test_size_together_with_other_parameters():
    """The derivatives do not depend on the parameters that are requested with them."""
    test, names = model(ROUND, friction=0.3, friction_base=0.2), ["C10", HEIGHT, "experiment.friction", TOOL]
    answer = ts.sensitivities(test, names, **OPTIONS)
    assert answer.exact.all()
    for k, name in enumerate(names):
        alone = ts.sensitivities(test, [name], **OPTIONS).values[:, 0]
        np.testing.assert_allclose(answer.values[:, k], alone, rtol=0, atol=1e-9 * abs(alone).max())


#: C10 of the neo-Hookean law of the closed form, Pa.
C10 = 1000.0
#: Its bulk modulus, Pa.
BULK_MODULUS = 2e5


def nominal_stress(stretch):
    """Nominal stress of uniaxial compression, Pa; complex numbers are allowed.

    W = C10 (J^(-2/3) tr FF^T - 3) + K/2 (J - 1)^2; Newton's method determines the lateral stretch without stress.
    """
    def stress(own, other, third):
        J = own * other * third
        trace = own**2 + other**2 + third**2
        return 2.0 * C10 * J**(-2 / 3) * (own - trace / (3.0 * own)) + BULK_MODULUS * (J - 1.0) * J / own

    lateral = stretch**-0.5
    for _ in range(20):
        above, below = (stress(lateral + step, lateral + step, stretch) for step in (1e-7, -1e-7))
        slope = (above - below) / 2e-7
        lateral = lateral - stress(lateral, lateral, stretch) / slope
    return stress(stretch, lateral, lateral)


@pytest.mark.slow
@pytest.mark.parametrize("specimen", [Block(0.04, 0.03, 0.02), Cylinder(0.02, 0.02)], ids=["block", "cylinder"])
def test_homogeneous_compression(specimen):
    """F = -A P(1 - d / H): the derivative is 2 F / R with respect to the radius of a cylinder.

    It is F / L and F / B with respect to length and width of a block, and -A P' d / H^2 with respect to the height."""
    test = model(ts.Tool(), specimen, friction="frictionless", friction_base="frictionless")
    test = replace(test, material=ts.Material("neo_hooke", {"C10": C10}, ts.Bulk("K_Pa", BULK_MODULUS)))
    sizes = {LENGTH: 1.0, WIDTH: 1.0} if isinstance(specimen, Block) else {RADIUS: 2.0}
    answer = ts.sensitivities(test, [*sizes, HEIGHT], **OPTIONS)
    assert answer.exact.all()
    force, depth = answer.recording.force[1:], answer.recording.displacement[1:]
    stretch = 1.0 - depth / specimen.height
    area = -force / nominal_stress(stretch)
    np.testing.assert_allclose(area, area[0], rtol=1e-9)
    for k, (path, power) in enumerate(sizes.items()):
        size = getattr(specimen, path.rpartition(".")[2])
        np.testing.assert_allclose(answer.values[1:, k], power * force / size, rtol=1e-8)
    slope = nominal_stress(stretch + 1e-20j).imag / 1e-20
    np.testing.assert_allclose(answer.values[1:, -1], -area * slope * depth / specimen.height**2, rtol=1e-8)


@pytest.mark.parametrize(("tool", "options"), [
    (FLAT, {"of_material": {"layers": (ts.Layer(5e-3, 2.0),)}}),
    (BALL, {"friction": 0.3, "adhesion": ts.Adhesion(0.02, 0.5e-3)})], ids=["layers", "adhesion"])
def test_without_exact_derivative(tool, options):
    """Areas of contact laws depend on the mesh, and a mesh with layers cannot be moved."""
    assert not discretisation.make_solver(model(tool, **options), resolution="few").differentiates_geometry
