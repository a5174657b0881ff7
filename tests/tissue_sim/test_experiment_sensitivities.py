"""Exact derivatives of the force with respect to coefficients of friction, in both solvers.

They are compared with central differences of whole simulations, and for one element with a solution in complex numbers.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from force_differences import assert_exact, extrapolated_difference

import tissue_sim as ts
from tissue_sim import differentiation
from tissue_sim.fem.axisymmetric import sensitivity
from tissue_sim.fem.axisymmetric.solver import AxisymmetricSolver
from tissue_sim.fem.contact import pairs
from tissue_sim.fem.contact.pairs import RelativeContactTolerances
from tissue_sim.fem.solid import discretisation
from tissue_sim.fem.solver import FRICTION_PATHS
from tissue_sim.mesh import cylinder_mesh
from tissue_sim.mesh.elements import Q4P0
from tissue_sim.mesh.solid import create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0

PRONY = ts.Prony((ts.PronyTerm(0.3, 2.0),), "long_term")
FACES = ("experiment.friction", "experiment.friction_base")
SIZES = ("experiment.specimen.radius", "experiment.specimen.height")


@pytest.fixture(autouse=True)
def close_contact(monkeypatch):
    """Closer than a user needs: a remaining violation would show in the differences."""
    monkeypatch.setattr(pairs, "TOLERANCES", RelativeContactTolerances(needle=1e-10, plate=1e-12))
    monkeypatch.setattr(discretisation, "TOLERANCES", RelativeContactTolerances(needle=1e-9, plate=1e-10))


def material(bulk=None, **options):
    bulk = bulk or ts.Bulk("bulk_ratio", 1e4)
    return ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, bulk, **options)


def experiment(text="ramp 5mm", points=6, **options):
    specimen = options.pop("specimen", ts.Specimen(0.040, 0.070))
    return ts.Experiment(specimen, ts.Protocol.parse(text, points), **options)


@pytest.mark.slow
@pytest.mark.parametrize(("options", "text", "of_material", "paths"), [
    ({"friction": 0.1, "friction_base": 0.1}, "ramp 5mm", {}, FACES),
    ({"friction": 0.4, "friction_base": 0.2}, "ramp 5mm", {}, FACES),
    ({"friction": 0.3, "friction_base": "as_tool"}, "ramp 5mm", {}, FACES[:1]),
    ({"friction": 0.2, "friction_base": 0.2}, "ramp 6mm @0.5mm/s; hold 5s; unload 2mm; reload",
     {"viscoelastic": PRONY}, FACES),
    ({"tool": ts.Tool("round", 8e-3), "friction": 0.3}, "ramp 6mm", {}, FACES[:1])],
    ids=["slip", "slip and stick", "as tool", "cycle with a Prony term", "round needle"])
def test_axisymmetric(options, text, of_material, paths):
    assert assert_exact(ts.Model(experiment(text, **options), material(**of_material)), paths) > 0.9


def solid_model(shape, way=(0.0, 1.5, 3.0), **options):
    """Return a model, the path in mm, and its mesh."""
    protocol = ts.Protocol(np.arange(1.0 * len(way)), 1e-3 * np.array(way))
    approach = options.get("approach")
    tool = ts.Tool() if shape == "plate" else ts.Tool(shape, radius=8e-3)
    specimen = options.pop("specimen", ts.Specimen(0.04, 0.05))
    of_material = options.pop("of_material", {})
    if shape == "plate":
        mesh = create_cylinder_mesh_under_needle(0.04, 0.05, 0.024, HEX8P0, smallest=9e-3, growth=2.2, largest=20e-3,
                                                 around=2)
    else:
        mesh = create_cylinder_mesh_under_needle(0.04, 0.05, 8e-3, HEX8P0, smallest=4e-3, growth=2.5, largest=30e-3,
                                                 around=2, centre=(approach.offset if approach else 0.0, 0.0))
    return ts.Model(ts.Experiment(specimen, protocol, tool, **options), material(**of_material)), mesh


OBLIQUE = ts.Approach(5e-3, math.radians(20.0))
HEAVY = ts.Specimen(0.04, 0.05, density=1040.0, gravity=9.81, height_is="moulded")


@pytest.mark.slow
@pytest.mark.parametrize(("shape", "options", "paths"), [
    ("plate", {"friction": 0.3, "friction_base": 0.2}, FACES),
    ("plate", {"friction": 0.3, "friction_base": 0.2, "specimen": HEAVY}, FACES),
    ("plate", {"friction": 0.3, "friction_base": 0.2, "specimen": replace(HEAVY, height_is="placed")}, FACES),
    ("round", {"friction": 0.3, "approach": OBLIQUE}, FACES[:1]),
    ("round", {"friction": 0.3, "approach": OBLIQUE, "way": (0.0, 1.0, 2.0, 2.0, 1.5),
               "of_material": {"viscoelastic": PRONY}}, FACES[:1]),
    ("sphere", {"friction": 0.05, "adhesion": ts.Adhesion(0.02, 0.5e-3)}, FACES[:1])],
    ids=["plates", "plates, weight", "plates, height as placed", "oblique", "oblique with a Prony term", "adhesion"])
def test_solid(shape, options, paths):
    model, mesh = solid_model(shape, **options)
    assert assert_exact(model, paths, solver="solid", mesh=mesh) == 1.0


#: Radius of the single element, m; as large as its height, so that the element is square.
RADIUS = 0.02
#: Height of the single element, m.
HEIGHT = 0.02
#: C10 of its neo-Hookean law, Pa, as soft as tissue.
C10 = 1000.0
#: Its bulk modulus, Pa, ten times the shear modulus, so that Newton's method in the test converges quickly.
BULK_MODULUS = 2e4


def nodal_forces(displacement, radius, height):
    """Internal forces of one axisymmetric quadrilateral with one pressure, neo-Hooke, N; complex numbers are allowed.

    The nodes are (0, -H), (R, -H), (R, 0), (0, 0). W = C10 (J^(-2/3) tr FF^T - 3) + K/2 (mean J - 1)^2."""
    nodes = np.array([[0.0, -height], [radius, -height], [radius, 0.0], [0.0, 0.0]], complex)
    forces, points = np.zeros((4, 2), complex), []
    for xi in (-math.sqrt(1 / 3), math.sqrt(1 / 3)):
        for eta in (-math.sqrt(1 / 3), math.sqrt(1 / 3)):
            shapes = 0.25 * np.array([(1 - xi) * (1 - eta), (1 + xi) * (1 - eta), (1 + xi) * (1 + eta),
                                      (1 - xi) * (1 + eta)])
            rates = 0.25 * np.array([[eta - 1, xi - 1], [1 - eta, -1 - xi], [1 + eta, 1 + xi], [-1 - eta, 1 - xi]])
            jacobian, r = nodes.T @ rates, shapes @ nodes[:, 0]
            gradients, weight = rates @ np.linalg.inv(jacobian), 2 * math.pi * r * np.linalg.det(jacobian)
            F = np.eye(3, dtype=complex)
            F[:2, :2] += displacement.T @ gradients
            F[2, 2] += shapes @ displacement[:, 0] / r
            points.append((shapes / r, gradients, weight, F, np.linalg.det(F)))
    volume = sum(weight for _, _, weight, _, _ in points)
    pressure = BULK_MODULUS * (sum(weight * J for _, _, weight, _, J in points) / volume - 1.0)
    for hoop, gradients, weight, F, J in points:
        inverse = np.linalg.inv(F).T
        stress = 2 * C10 * J**(-2 / 3) * (F - (F * F).sum() / 3 * inverse) + pressure * J * inverse
        forces += weight * gradients @ stress[:2, :2].T
        forces[:, 0] += weight * hoop * stress[2, 2]
    return forces


def force_between_rubbing_plates(depth, mu, mu_base, radius=RADIUS, height=HEIGHT):
    """Force of one element whose outer nodes slip outwards on both plates, by Newton's method in complex numbers."""
    slip = np.array([1e-3, 1e-3], complex)

    def residual_and_forces(slip):
        forces = nodal_forces(np.array([[0.0, 0.0], [slip[0], 0.0], [slip[1], -depth], [0.0, -depth]]),
                              radius, height)
        # The base presses upwards, the plate downwards; friction is directed towards the axis.
        return np.array([forces[1, 0] + mu_base * forces[1, 1], forces[2, 0] - mu * forces[2, 1]]), forces

    for _ in range(20):
        tangent = np.stack([(residual_and_forces(slip + step)[0] - residual_and_forces(slip - step)[0]) / 2e-7
                            for step in 1e-7 * np.eye(2)], axis=1)
        slip = slip - np.linalg.solve(tangent, residual_and_forces(slip)[0])
    return -residual_and_forces(slip)[1][2:, 1].sum()


@pytest.mark.slow
def test_one_element_against_a_complex_step():
    """The derivative is the imaginary part of the force with the coefficient mu + i h, divided by h."""
    depths, h = (1e-3, 2e-3), 1e-20
    stated = ts.Experiment(ts.Specimen(RADIUS, HEIGHT), ts.Protocol(np.arange(3.0), np.array([0.0, *depths])),
                           friction=0.2, friction_base=0.1)
    answer = ts.sensitivities(ts.Model(stated, ts.Material("neo_hooke", {"C10": C10}, ts.Bulk("K_Pa", BULK_MODULUS))),
                              [*FACES, *SIZES], mesh=cylinder_mesh(RADIUS, HEIGHT, (1, 1), Q4P0))
    assert answer.exact.all()
    np.testing.assert_allclose(answer.recording.force[1:], [force_between_rubbing_plates(depth, 0.2, 0.1).real
                                                            for depth in depths], rtol=1e-9)
    given = np.array([0.2, 0.1, RADIUS, HEIGHT])
    np.testing.assert_allclose(answer.values[1:], [
        [force_between_rubbing_plates(depth, *(given + step)).imag / h for step in 1j * h * np.eye(4)]
        for depth in depths], rtol=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("most", [4, 0], ids=["factor of the step", "exact tangent"])
def test_both_linear_solutions(most, monkeypatch):
    """Friction and material together, with the step's last factor and with that of the exact tangent."""
    monkeypatch.setattr(sensitivity, "SETTINGS",
                        sensitivity.SensitivityReuseSettings(max_refined=most, max_refined_slip=most))
    model = ts.Model(experiment("ramp 3mm", 4, friction=0.3, friction_base=0.2), material())
    answer = ts.sensitivities(model, ["C10", *FACES])
    slope, shared = extrapolated_difference(model, FACES[1])
    assert answer.exact.all() and shared == 4
    np.testing.assert_allclose(answer.values[:, 2], slope, rtol=0, atol=1e-6 * abs(slope).max())


def test_points_at_shaft_and_face_have_their_own_friction():
    """With the same coefficient at face and shaft, the derivatives with respect to either differ."""
    tool = ts.Tool("flat", radius=8e-3, edge_radius=1.6e-3)
    model = ts.Model(experiment("ramp 3mm", 3, tool=tool, friction=0.3, friction_wall=0.3), material())
    surfaces = []

    class Surface:
        def before_first_step(self, solver):
            surfaces.append(solver.equations.surface)

        def after_sample(self, solver, factor):
            pass

    ts.simulate(model, watch=Surface(), estimate_error=False)
    on_shaft = surfaces[0].rates[:, sensitivity.ContactLinearisationColumn.ON_SHAFT]
    r = surfaces[0].places[:, 0]
    moves = surfaces[0].moves
    assert not on_shaft[moves & (r < 6e-3)].any() and on_shaft[moves & (r > 12e-3)].all()
    face, shaft = ts.sensitivities(model, ["experiment.friction", "experiment.friction_wall"]).values[-1]
    assert abs(face) > 0.0 and shaft == 0.0


def test_no_exact_derivative_without_friction_or_with_another_solver(monkeypatch):
    """At zero friction no point slips against friction; solvers of plug-ins may have no derivatives by friction."""
    smooth = ts.Model(experiment("ramp 1mm", 2, friction=0.0, friction_base=0.1), material())
    assert not ts.sensitivities(smooth, FACES[:1]).exact.any()
    rough = ts.Model(experiment("ramp 1mm", 2, friction=0.1, friction_base=0.1), material())
    exact = ts.sensitivities(rough, ["C10", *FACES])
    monkeypatch.setattr(AxisymmetricSolver, "exact_experiment_parameters", frozenset())
    answer = ts.sensitivities(rough, ["C10", *FACES])
    assert exact.exact.all() and answer.exact.tolist() == [True, False, False]
    np.testing.assert_allclose(answer.values, exact.values, rtol=1e-3, atol=1e-6 * abs(exact.values).max())
    assert differentiation.sensitivities(rough, []).values.shape == (2, 0)


def test_plugin_of_a_solver_whose_derivatives_have_no_argument_for_experiments():
    """Such a method belongs to the contract without parameters of the experiment."""
    class MaterialDerivatives(AxisymmetricSolver):
        def enable_force_derivatives(self, neighbours):
            return super().enable_force_derivatives(neighbours)

    class Unchanged(AxisymmetricSolver):
        pass

    assert MaterialDerivatives.exact_experiment_parameters == frozenset()
    assert Unchanged.exact_experiment_parameters == AxisymmetricSolver.exact_experiment_parameters == FRICTION_PATHS


def test_a_parameter_without_valid_neighbours_has_no_derivative():
    def change(value):
        if value != 1.0:
            raise ts.InputError("value must be 1")
        return value

    with pytest.raises(ts.InputError, match="value must be 1"):
        differentiation._evaluate_at_both_perturbed_values(change, 1.0, 1e-6)
