"""An effect at the points from one file: a Maxwell branch, which must be the built-in Prony term.

A neo-Hooke law of (1 - g) C10 with a parallel branch of shear modulus 2 g C10 equals a law of C10 with the Prony term
(g, tau): both use the same recursion for the same isochoric second Piola-Kirchhoff stress.
"""

import json
import subprocess
import sys
from itertools import pairwise

import numpy as np
import pytest

import tissue_sim as ts
from scenes.cli import main
from tissue_sim.errors import InputError
from tissue_sim.fem.axisymmetric.discretisation import build_mesh, build_solver_on_mesh, find_element_layer_indices
from tissue_sim.fem.axisymmetric.solver import AxisymmetricSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.material.effect import EFFECTS
from tissue_sim.mesh import cylinder_mesh
from tissue_sim.mesh.elements import Q4P0, Q9P1
from tissue_sim.parameters import get_parameter_value

#: Parameter of the law, Pa.
C10 = 1500.0
#: Relaxing fraction, 1.
G = 0.3
#: Relaxation time, s.
TAU = 2.0
BULK = ts.Bulk("K_Pa", 3e7)
#: Radius, m.
RADIUS = 0.04
#: Height, m.
HEIGHT = 0.07
PATH = ts.Protocol.parse("ramp 6mm @0.6mm/s; hold 5s; unload", points=7)


@pytest.fixture
def branch(plugin, registers):
    return registers(EFFECTS, plugin("maxwell_branch").MaxwellBranch)


def material(branch, **options) -> ts.Material:
    return ts.Material("neo_hooke", {"C10": (1 - G) * C10}, BULK, effects=[branch(2 * G * C10, TAU)], **options)


def built_in(**options) -> ts.Material:
    return ts.Material("neo_hooke", {"C10": C10}, BULK, viscoelastic=ts.Prony((ts.PronyTerm(G, TAU),)), **options)


def model(stuff, friction="bonded", protocol=PATH):
    return ts.Model(ts.Experiment(ts.Specimen(RADIUS, HEIGHT), protocol, friction=friction, friction_base=friction),
                    stuff)


def needle(stuff):
    return ts.Model(ts.Experiment(ts.Specimen(RADIUS, HEIGHT), PATH, tool=ts.Tool("flat", radius=8e-3)), stuff)


def test_formula_on_plain_numbers(branch):
    """In three dimensions the tangent is symmetric and equals the derivative of the stress."""
    rng = np.random.default_rng(0)
    for dt in (0.0, 1e-7, 0.4, 1e30):
        F = np.eye(3) + 0.2 * rng.normal(size=(3, 3))
        C = (F.T @ F)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        state, effect = rng.normal(size=12).tolist(), branch(100.0, TAU)
        _, tangent, after = effect.response(C.tolist(), state, dt)
        numeric = np.zeros((6, 6))
        for k in range(6):
            kick = 1e-6 * (np.arange(6) == k) * (1.0 if k > 2 else 2.0)
            more, less = (np.array(effect.response((C + way * kick).tolist(), state, dt)[0]) for way in (1, -1))
            numeric[:, k] = (more - less) / 2e-6
        np.testing.assert_allclose(tangent, numeric, atol=1e-6 * abs(numeric).max() + 1e-8)
        np.testing.assert_allclose(tangent, np.transpose(tangent), atol=1e-12 * np.abs(tangent).max())
        assert np.isfinite(after).all()


@pytest.mark.slow
@pytest.mark.parametrize(("make", "tolerance"), [
    (lambda stuff: model(stuff, "frictionless"), 1e-8), (model, 1e-8), (needle, 1e-6)],
    ids=["homogeneous", "bonded", "needle"])
def test_branch_is_the_built_in_term(branch, make, tolerance):
    """To the tolerance of the equilibrium (1e-9 of the reactions), through ramp, hold and unloading; that of a needle's
    contact is coarser, and its springs are measured by the law's shear modulus, which the two do not share."""
    plugin, own = (ts.simulate(make(stuff), fields=True) for stuff in (material(branch), built_in()))
    np.testing.assert_allclose(plugin.force, own.force, rtol=0, atol=tolerance * own.force.max())
    elastic = ts.simulate(make(ts.Material("neo_hooke", {"C10": C10}, BULK))).force
    assert abs(own.force - elastic).max() > 0.1 * elastic.max(), "it relaxes"
    for sample in (3, 9, -2):
        for name in ("von_mises", "cauchy_zz"):
            field = own.fields.at_points(name, sample)
            np.testing.assert_allclose(plugin.fields.at_points(name, sample), field, rtol=0,
                                       atol=100 * tolerance * abs(field).max())


@pytest.mark.slow
def test_layers_scale_it_as_the_law(branch):
    layers = (ts.Layer(0.004, 3.0),)
    plugin, own = (ts.simulate(model(stuff)).force
                   for stuff in (material(branch, layers=layers), built_in(layers=layers)))
    np.testing.assert_allclose(plugin, own, atol=1e-8 * own.max())


@pytest.mark.slow
@pytest.mark.parametrize("element", [Q9P1, Q4P0], ids=lambda e: e.name)
def test_tangent_is_the_derivative_of_the_residual(branch, element):
    """Every column of the condensed tangent equals differences of nodal forces, as in test_memory.py."""
    mesh = cylinder_mesh(RADIUS, HEIGHT, (2, 2), element)
    stuff = material(branch, layers=(ts.Layer(HEIGHT / 2, 2.5),))
    layers = find_element_layer_indices(mesh, stuff.layers)
    solver = AxisymmetricSolver(mesh, stuff, {"base": "rz"}, {"top": "rz"}, element_layers=layers)
    for depth, dt in ((5e-3, 0.5), (10e-3, 1.0), (8e-3, 0.3)):
        assert solver.step(depth, dt).status is StepStatus.CONVERGED
    equations, lower = solver.equations, solver.equations.assemble_committed_tangent()
    equation, free = equations.equation, equations.free
    tangent = np.zeros((free, free))
    for d in range(lower.shape[0]):
        i = np.arange(free - d)
        tangent[i + d, i] = tangent[i, i + d] = lower[d, : free - d]
    freedoms, states = 2 * len(mesh.nodes), equations.effects.states.copy()
    assert abs(states).max() > 10.0
    shared = np.unique(mesh.connectivity[:, : element.boundary_nodes])
    everything_held = type(mesh)(element, mesh.nodes, mesh.connectivity, {**mesh.sets, "shared": shared})

    def nodal_forces(displacement):
        held = AxisymmetricSolver(everything_held, stuff, {"shared": "rz"}, {}, element_layers=layers)
        held.equations.effects.states[:] = states
        held.equations.direction[:] = displacement / depth
        assert held.step(depth, 0.0, tolerance=1e-13).status is StepStatus.CONVERGED
        return held.equations.residual[held.equations.equation]

    h, displacement = 1e-7, solver.state[:freedoms]
    unknowns = np.flatnonzero((equation >= 0) & (equation < free))
    numeric = np.zeros_like(tangent)
    for dof in unknowns:
        kick = h * (np.arange(freedoms) == dof)
        column = (nodal_forces(displacement + kick) - nodal_forces(displacement - kick)) / (2 * h)
        numeric[equation[unknowns], equation[dof]] = column[unknowns]
    assert abs(tangent - numeric).max() < 1e-7 * abs(tangent).max()


@pytest.mark.slow
def test_newton_converges_quadratically(branch):
    m = model(material(branch))
    solver = build_solver_on_mesh(m, build_mesh(m.experiment))
    assert solver.step(4e-3, 0.5).status is StepStatus.CONVERGED
    saved, residuals = solver.save(), []
    for most in range(1, 5):
        solver.restore(saved)
        residuals.append(solver.step(5e-3, 0.5, tolerance=1e-13, max_iterations=most, predictor_order=0).residual)
    falling = [r for r in residuals if r > 1e-9]
    assert len(falling) >= 3 or residuals[-1] < 1e-9
    for before, after in pairwise(falling):
        assert after < 30.0 * before**2 or after < 1e-2 * before


@pytest.mark.slow
def test_simulator_remembers_saves_and_restores(branch):
    """Step by step the forces of the built-in term, and bit for bit the same again from a saved state."""
    plugin, own = (ts.Simulator(needle(stuff), inertia="off", tolerance=1e-9)
                   for stuff in (material(branch), built_in()))
    way = [2e-5 * k for k in range(1, 60)] + [1.2e-3] * 40 + [1.2e-3 - 2e-5 * k for k in range(1, 30)]
    forces = [(plugin.step(depth, 0.02).force, own.step(depth, 0.02).force) for depth in way]
    np.testing.assert_allclose(*np.transpose(forces), rtol=1e-6)
    saved = plugin.save()
    once = [plugin.step(depth, 0.02).force for depth in way]
    plugin.restore(saved)
    assert [plugin.step(depth, 0.02).force for depth in way] == once
    plugin.reset()
    assert plugin.step(way[0], 0.02).force == pytest.approx(forces[0][0], rel=1e-9)


@pytest.mark.slow
def test_its_parameters_are_those_of_the_model(branch, tmp_path):
    """Parameters are set by path, in a material file, and while the simulator runs."""
    stuff = material(branch)
    assert get_parameter_value(stuff, "effects.maxwell_branch.tau") == TAU
    ts.write_material_file(ts.MaterialFile.of(stuff), tmp_path / "m.material.json")
    assert ts.load_material(tmp_path / "m.material.json").effects == stuff.effects
    sim = ts.Simulator(needle(stuff), inertia="off")
    force = sim.step(1e-3, 0.0).force
    sim.reset()
    sim.set_parameters(**{"effects.maxwell_branch.mu": 0.0})
    assert sim.step(1e-3, 0.0).force == pytest.approx((1 - G) * force, rel=1e-3)


@pytest.mark.slow
def test_sensitivities_are_differences_and_say_so(branch):
    plugin = ts.sensitivities(model(material(branch)), ["effects.maxwell_branch.tau"])
    own = ts.sensitivities(model(built_in()), ["viscoelastic.terms[0].tau"])
    assert not plugin.exact[0] and own.exact[0]
    np.testing.assert_allclose(plugin.values, own.values, atol=1e-4 * abs(own.values).max())


STIFFENER = """
from dataclasses import dataclass
from tissue_sim.material.effect import PointEffect
from tissue_sim.parameters import parameter

@dataclass(frozen=True)
class Stiffener(PointEffect):
    name = "stiffener"
    modulus: float = parameter("E", "Pa", key="modulus_Pa", absent=0.0)

    def response(self, C, state, dt):
        k = {factor} * self.modulus
        S = [0.5 * k * (C[i] - (i < 3)) for i in range(3)] + [0.5 * k * C[i] for i in range(3, 6)]
        return S, [[k * (1.0 if i < 3 else 0.5) * (i == j) for j in range(6)] for i in range(6)], state
"""
FORCES = """
import sys
from importlib import import_module
import tissue_sim as ts
from tissue_sim.mesh.elements import Q4P0
from tissue_sim.mesh import cylinder_mesh
experiment = ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.ramp(1e-3, 2))
for module in sys.argv[1:]:
    material = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("K_Pa", 3e7),
                           effects=[import_module(module).Stiffener(1000.0)])
    recording = ts.simulate(ts.Model(experiment, material), mesh=cylinder_mesh(0.04, 0.07, (2, 2), Q4P0))
    print(repr(float(recording.force[-1])))
"""


@pytest.mark.slow
def test_two_plugins_of_one_name_are_two_kernels(tmp_path):
    """Another content is another kernel, in one process and among the kernels that are kept on disk."""
    def write(module, factor):
        (tmp_path / f"{module}.py").write_text(STIFFENER.format(factor=factor), encoding="utf-8")

    def forces(*modules):
        process = subprocess.run([sys.executable, "-c", FORCES, *modules], cwd=tmp_path, check=True,
                                 capture_output=True, text=True)
        return [float(line) for line in process.stdout.split()]

    write("one", 1.0)
    soft, = forces("one")
    write("one", 3.0)
    write("other", 1.0)
    stiff, again = forces("one", "other")
    assert again == soft and stiff > 1.1 * soft


@pytest.mark.parametrize(("line", "message"), [
    ("k = self.modulus if C[0] > 1.0 else 0.0", r"cannot branch on a number .*numpy\.where"),
    ("import numpy; k = numpy.arctan(C[0])", r"cannot use numpy\.arctan"),
    ("k = self.modulus; state = [k]",
     "and 0 state variables, as many as `rest` has; got 6 stresses, 6 rows and 1 state"),
])
def test_what_a_kernel_cannot_do_is_refused(line, message):
    names = {}
    exec(STIFFENER.replace("k = {factor} * self.modulus", line), names)
    stuff = ts.Material("neo_hooke", {"C10": C10}, BULK, effects=[names["Stiffener"](1000.0)])
    with pytest.raises(InputError, match=message) as caught:
        ts.simulate(model(stuff))
    assert caught.value.field == "effects.stiffener"


def test_closed_forms_leave_it_to_the_elements(branch):
    with pytest.raises(InputError, match="closed forms do not include effects") as caught:
        ts.nominal_stress_history(material(branch), [0.0, 1.0], [1.0, 0.9])
    assert caught.value.field == "effects.maxwell_branch"


def test_a_name_is_taken_once(branch):
    with pytest.raises(InputError, match="taken by another effect of the tissue"):
        EFFECTS.register(type("Other", (branch,), {}))


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_a_campaign_fits_it(branch, tmp_path):
    """Modulus, stress and time of the branch from a ramp and a hold between glued plates."""
    recording = ts.simulate(model(material(branch), protocol=ts.Protocol.parse("ramp 6mm @3mm/s; hold 8s", points=61)))
    time = np.linspace(0.0, recording.time[-1], 101)
    noise = np.random.default_rng(4).normal(0.0, 2e-3, time.size)
    ts.write_recording(ts.Recording({
        "time": time, "displacement": np.interp(time, recording.time, recording.displacement),
        "force": np.interp(time, recording.time, recording.force) + noise}), tmp_path / "plates.csv")
    (tmp_path / "c.toml").write_text("""
[[specimen]]
radius_mm = 40.0
height_mm = 70.0
[[test]]
kind = "bonded_compression"
recordings = ["plates.csv"]
[fit]
method = "inverse_fem"
laws = ["neo_hooke"]
starts = 1
start = { C10 = 1300.0, "effects.maxwell_branch.mu_Pa" = 500.0, "effects.maxwell_branch.tau_s" = 4.0 }
fixed = { "bulk.K_Pa" = 3e7 }
[noise]
force_N = 0.002
contact_jitter_mm = 0.0
zero_jitter_N = 0.0
""", encoding="utf-8")
    assert main(["calibrate", str(tmp_path / "c.toml"), "-o", str(tmp_path / "out")]) == 0
    fit, = json.loads((tmp_path / "out" / "fit.json").read_text(encoding="utf-8"))["fits"]
    assert fit["parameters"] == pytest.approx({"C10": (1 - G) * C10, "effects.maxwell_branch.mu": 2 * G * C10,
                                               "effects.maxwell_branch.tau": TAU, "bulk.K_Pa": 3e7}, rel=0.02)
    calibrated = ts.load_material(tmp_path / "out" / fit["material_file"])
    assert calibrated.effects["maxwell_branch"].tau == fit["parameters"]["effects.maxwell_branch.tau"]
