"""Exact derivatives of the force with respect to sizes of specimen and tool in the axisymmetric solver."""

from dataclasses import replace

import numpy as np
import pytest
from force_differences import assert_exact

import tissue_sim as ts
from tissue_sim import differentiation
from tissue_sim.fem.axisymmetric import shape_sensitivity
from tissue_sim.fem.axisymmetric.discretisation import make_solver
from tissue_sim.fem.axisymmetric.solver import AxisymmetricSolver
from tissue_sim.fem.contact import pairs
from tissue_sim.fem.contact.pairs import RelativeContactTolerances
from tissue_sim.parameters import parameters, with_values

PRONY = ts.Prony((ts.PronyTerm(0.3, 2.0),), "long_term")
SOFTENING = ts.Softening(0.4, 300.0, 0.1)
RADIUS = "experiment.specimen.radius"
HEIGHT = "experiment.specimen.height"
TOOL_RADIUS = "experiment.tool.radius"
EDGE_RADIUS = "experiment.tool.edge_radius"
THICKNESS = "material.layers[0].thickness"
FLAT = ts.Tool("flat", 8e-3)
ROUND = ts.Tool("round", 8e-3)
#: A needle's edge that the tissue touches.
EDGED = ts.Tool("flat", 8e-3, edge_radius=1e-3)
#: Loading, hold, unloading and reloading.
CYCLE = "ramp 6mm @0.5mm/s; hold 5s; unload 2mm; reload"


@pytest.fixture(autouse=True)
def close_contact(monkeypatch):
    """Closer than a user needs: a remaining violation would show in the differences."""
    monkeypatch.setattr(pairs, "TOLERANCES", RelativeContactTolerances(needle=1e-10, plate=1e-12))


def make_model(text="ramp 5mm", *, of_material=None, points=6, **options):
    options = {"tool": FLAT, **options}
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4},
                           **{"bulk": ts.Bulk("bulk_ratio", 1e4), **(of_material or {})})
    return ts.Model(ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.parse(text, points), **options), material)


@pytest.mark.parametrize(("text", "options", "paths"), [
    ("ramp 5mm", {"tool": ts.Tool()}, [RADIUS, HEIGHT]),
    ("ramp 5mm", {"tool": ts.Tool(), "friction": "frictionless", "friction_base": "frictionless"}, [RADIUS, HEIGHT]),
    ("ramp 5mm", {"tool": ts.Tool(), "friction": 0.2, "friction_base": 0.1}, [RADIUS, HEIGHT]),
    (CYCLE, {"tool": ts.Tool(), "friction": 0.2, "friction_base": 0.2, "of_material": {"viscoelastic": PRONY}},
     [RADIUS, HEIGHT]),
    ("ramp 5mm", {}, [RADIUS, HEIGHT, TOOL_RADIUS]),
    ("ramp 5mm", {"of_material": {"bulk": ts.Bulk("incompressible")}}, [RADIUS, HEIGHT, TOOL_RADIUS]),
    (CYCLE, {"of_material": {"viscoelastic": PRONY, "softening": SOFTENING}}, [RADIUS, HEIGHT, TOOL_RADIUS]),
    ("ramp 4mm @0.5mm/s; hold 20s", {"of_material": {"poroelasticity": ts.Poroelasticity(0.3, 1e-6)}},
     [RADIUS, TOOL_RADIUS]),
    ("ramp 5mm", {"of_material": {"layers": (ts.Layer(5e-3, 2.0),)}}, [RADIUS, HEIGHT, TOOL_RADIUS, THICKNESS]),
    ("ramp 6mm", {"tool": EDGED, "friction": 0.3}, [HEIGHT, TOOL_RADIUS, EDGE_RADIUS]),
    ("ramp 6mm", {"tool": ROUND, "friction": "frictionless"}, [RADIUS, HEIGHT, TOOL_RADIUS]),
    ("ramp 6mm", {"tool": ROUND, "friction": 0.3}, [RADIUS, HEIGHT, TOOL_RADIUS]),
    ("ramp 6mm", {"tool": ROUND, "friction": "stick"}, [RADIUS, HEIGHT, TOOL_RADIUS]),
    ("ramp 6mm", {"tool": ts.Tool("sphere", 8e-3), "friction": 0.1}, [TOOL_RADIUS])],
    ids=["bonded plates", "plates without friction", "rubbing plates", "cycle of rubbing plates", "needle",
         "incompressible", "cycle with softening", "drainage", "layer", "rounded edge", "round, no friction",
         "round, friction", "round, stick", "sphere"])
def test_against_differences_of_simulations(text, options, paths):
    assert assert_exact(make_model(text, **options), paths) > 0.9


def test_a_tip_whose_shaft_touches_nothing():
    """The force of a cone does not depend on the radius of its shaft."""
    model = make_model("ramp 3mm", tool=ts.Tool("cone", 8e-3, half_angle=1.0), friction=0.2)
    answer = ts.sensitivities(model, [TOOL_RADIUS, RADIUS])
    assert answer.exact.all()
    assert abs(answer.values[:, 0]).max() < 1e-8 * abs(answer.values[:, 1]).max()


def test_the_force_scales_with_the_square_of_all_lengths():
    """Euler's theorem: the sum of size times derivative, the depth included, is twice the force of elastic tissue."""
    model = make_model("ramp 5mm", tool=EDGED, friction="frictionless")
    names, h = [RADIUS, HEIGHT, TOOL_RADIUS, EDGE_RADIUS], 1e-4
    answer = ts.sensitivities(model, names)
    protocol = model.experiment.protocol
    deeper, shallower = (
        ts.simulate(replace(model, experiment=replace(model.experiment, protocol=ts.Protocol(
            protocol.time, protocol.displacement * factor))), estimate_error=False).force
        for factor in (1.0 + h, 1.0 - h))
    sizes = np.array([parameters(model)[name].value for name in names])
    scaled = answer.values @ sizes + (deeper - shallower) / (2.0 * h)
    assert answer.exact.all()
    np.testing.assert_allclose(scaled[1:], 2.0 * answer.recording.force[1:], rtol=1e-8)


def test_sizes_together_with_other_parameters():
    """The derivatives do not depend on the parameters that are requested with them."""
    model = make_model("ramp 4mm", tool=ROUND, friction=0.3, of_material={"viscoelastic": PRONY})
    names = ["C10", TOOL_RADIUS, "experiment.friction", HEIGHT, "viscoelastic.terms[0].tau"]
    answer = ts.sensitivities(model, names)
    assert answer.exact.all()
    for k, name in enumerate(names):
        alone = ts.sensitivities(model, [name]).values[:, 0]
        np.testing.assert_allclose(answer.values[:, k], alone, rtol=0, atol=1e-8 * abs(alone).max())


@pytest.mark.parametrize("options", [
    {"specimen": ts.Specimen(0.04, 0.05, density=1040.0, gravity=9.81, height_is="moulded")},
    {"tool": ROUND, "friction": 0.3, "adhesion": ts.Adhesion(0.02, 0.5e-3)}], ids=["weight", "adhesion"])
def test_no_exact_derivative_with_weight_or_contact_laws(options):
    options = {"specimen": ts.Specimen(0.04, 0.05), "tool": FLAT, **options}
    experiment = ts.Experiment(protocol=ts.Protocol.ramp(1e-3, points=2), **options)
    assert not make_solver(ts.Model(experiment, make_model().material)).differentiates_geometry


def test_an_edge_of_zero_has_a_difference_of_simulations():
    """A rounding of zero is another outline."""
    assert not ts.sensitivities(make_model("ramp 1mm", points=2), [EDGE_RADIUS]).exact.any()


def test_plugin_of_a_solver_whose_derivatives_have_no_argument_for_experiments():
    """Such a method cannot receive neighbouring solvers."""
    class MaterialDerivatives(AxisymmetricSolver):
        def enable_force_derivatives(self, neighbours):
            return super().enable_force_derivatives(neighbours)

    assert not MaterialDerivatives.differentiates_geometry
    assert AxisymmetricSolver.differentiates_geometry


def test_neighbours_that_touch_other_points_are_refused():
    model = make_model("ramp 1mm", points=2)
    solver = make_solver(model)
    near, far = (make_solver(with_values(model, {TOOL_RADIUS: radius}), mesh=solver.mesh, topology=model)
                 for radius in (8.1e-3, 7.9e-3))
    far.equations.surface.anchors[:, 0] = 0.0
    with pytest.raises(ts.InputError, match="must touch the same points at the first touch"):
        shape_sensitivity.ShapeDerivative(solver.equations, (near.equations, far.equations), 2e-4)


def test_a_size_changes_the_mesh_only_by_moving_nodes():
    """Neighbouring solvers have the elements of the model, also if its mesh belongs to another geometry."""
    model = make_model("ramp 2mm", points=3)
    other = with_values(model, {TOOL_RADIUS: 6e-3})
    answer = ts.sensitivities(model, [TOOL_RADIUS], topology=other)
    width = differentiation.DIFFERENCES.simulation_width
    more, less = (ts.simulate(with_values(model, {TOOL_RADIUS: 8e-3 * (1.0 + step)}), topology=other,
                              estimate_error=False).force for step in (width, -width))
    assert answer.exact.all()
    np.testing.assert_allclose(answer.values[:, 0], (more - less) / (2.0 * width * 8e-3), rtol=1e-5)
