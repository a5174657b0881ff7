"""Inertia of the solid in space: waves by d'Alembert, in two directions and each element; the axisymmetric solid."""

import math

import numpy as np
import pytest
from solid_meshes import block

import tissue_sim as ts
from tissue_sim.fem.inertia import compute_lumped_volumes
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import SOLVERS, Solver, StepStatus
from tissue_sim.mesh.solid import SOLID_ELEMENTS, create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1, TET8P0, TET15P1
from tissue_sim.pose import Pose

WIDTH = 0.005
#: Height, m.
HEIGHT = 0.05
#: Density, kg/m3.
DENSITY = 1000.0
SOFT = ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("bulk_ratio", 3.0))
#: Speeds of waves along a confined column, and across a sheared one.
ALONG = math.sqrt((SOFT.bulk_modulus + 4.0 / 3.0 * SOFT.mu0) / DENSITY)
ACROSS = math.sqrt(SOFT.mu0 / DENSITY)
AMPLITUDE = 1e-6


def bump(t, rise):
    """Place, m, and velocity, m/s, of the top: a smooth bump of its velocity, then rest."""
    u = np.clip(np.asarray(t) / rise, 0.0, 1.0)
    place = AMPLITUDE * (u - 2 * np.sin(2 * np.pi * u) / (3 * np.pi) + np.sin(4 * np.pi * u) / (12 * np.pi))
    return place, AMPLITUDE / rise * (1 - np.cos(2 * np.pi * u)) ** 2 / 1.5


def closed_form(t, speed, rise):
    """Force on the top of a column on a rigid base: rho c (v(t) + 2 v(t - 2 H / c) + ...) times its area."""
    echoes = sum(2.0 * bump(t - 2 * n * HEIGHT / speed, rise)[1] for n in range(1, 20))
    return WIDTH**2 * DENSITY * speed * (bump(t, rise)[1] + echoes)


def column(element, count, held):
    """A column of elements, or of cubes of six tetrahedra; `held` are the axes along which its walls hold it."""
    line = 0.5 * WIDTH * np.array([-1.0, 1.0])
    mesh = block(line, line, np.linspace(-HEIGHT, 0.0, count + 1), element)
    x, y, _ = np.abs(mesh.nodes.T)
    everywhere = np.arange(len(mesh.nodes))
    sets = {"x": np.flatnonzero(x > 0.5 * WIDTH * (1 - 1e-9)), "y": np.flatnonzero(y > 0.5 * WIDTH * (1 - 1e-9))} if (
        held == "walls") else dict.fromkeys("yz", everywhere)
    mesh.sets.update({f"held {axis}": nodes for axis, nodes in sets.items()})
    solver = SolidSolver(mesh, SOFT, {"base": "xyz", **{f"held {axis}": axis for axis in sets}}, mesh.sets["top"],
                         start=Pose.at_depth(0.0))
    assert solver.enable_inertia(DENSITY)
    return solver


def forces(element, count, steps, *, held="walls", speed=ALONG, axis=2):
    """Return the forces on the top before the first echo returns, N, their times, s, and the closed form."""
    solver, rise = column(element, count, held), 1.5 * HEIGHT / speed
    times = np.arange(1, steps + 1) * 2.4 * rise / steps
    found = []
    for place in bump(times, rise)[0].tolist():
        way = [0.0, 0.0, 0.0]
        way[axis] = -place
        step = solver.step(Pose(tuple(way)), times[0], inertial=True)
        assert step.status is StepStatus.CONVERGED
        found.append(step.wrench[axis])
    return np.array(found), closed_form(times, speed, rise)


def relative(error, right):
    return np.sqrt(np.mean(error**2)) / np.abs(right).max()


@pytest.mark.slow
def test_waves_along_a_column_are_of_second_order_in_the_step():
    found = [forces(HEX8P0, 80, steps) for steps in (80, 160, 320)]
    errors = [relative(force - right, right) for force, right in found]
    assert errors[-1] < 5e-3, "the echoes came back, and the mesh resolves them"
    assert errors[0] / errors[1] > 3.2 and errors[1] / errors[2] > 3.2


@pytest.mark.slow
@pytest.mark.parametrize(("element", "count", "options"), [
    (HEX8P0, 60, {}), (HEX8P0, 60, {"held": "all", "speed": ACROSS, "axis": 0}), (HEX27P1, 15, {}), (TET15P1, 15, {}),
    (TET8P0, 30, {})], ids=["H8", "H8 across", "H27", "T15", "T8"])
def test_waves_in_each_element(element, count, options):
    """Without the error of the step, by Richardson's extrapolation; a column that is sheared answers aside alone."""
    (coarse, right), (fine, _) = (forces(element, count, steps, **options) for steps in (80, 160))
    error = relative((4.0 * fine[1::2] - coarse) / 3.0 - right, right)
    assert error < 0.01


@pytest.mark.parametrize("name", SOLID_ELEMENTS)
def test_lumped_masses_are_positive_and_keep_mass_and_its_middle(name):
    """Also of crooked elements, whose middle they keep to a hundredth of their size."""
    line = np.linspace(0.0, 1.0, 3)
    mesh = block(line, line, line, SOLID_ELEMENTS[name], lambda x: x + 0.08 * np.sin(5 * x[:, [1, 2, 0]]))
    points, weights = mesh.element.quadrature
    values, slopes = mesh.element.evaluate_shape_functions_and_gradients(points)
    places = mesh.nodes[mesh.connectivity]
    weights = weights * np.linalg.det(np.einsum("eai,qaj->eqij", places, slopes))
    lumped = compute_lumped_volumes(mesh, weights)
    middle = np.einsum("eq,qa,eai->i", weights, values, places) / weights.sum()
    assert lumped.min() > 0.0 and lumped.sum() == pytest.approx(weights.sum(), rel=1e-12)
    np.testing.assert_allclose(lumped @ mesh.nodes / lumped.sum(), middle, atol=5e-3)


PHANTOM = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))


def needle(friction="bonded", tool=None):
    test = ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.ramp(5e-3, 21), tool=tool or ts.Tool("flat", 8e-3),
                         friction=friction, friction_base="bonded")
    return ts.Model(test, PHANTOM)


def coarse(element=HEX8P0):
    return create_cylinder_mesh_under_needle(0.04, 0.07, 8e-3, element, smallest=2.4e-3, growth=2.2, largest=20e-3,
                                             around=2)


def simulator(**options):
    return ts.Simulator(needle(), solver="solid", mesh=coarse(), **options)


@pytest.mark.slow
def test_a_sudden_start_is_that_of_the_axisymmetric_solid():
    """50 mm/s from rest, in steps of a millisecond; quasi-static forces are a sixth to a half of these."""
    found = [ts.Simulator(needle(), inertia="on", **options) for options in
             ({}, {"solver": "solid", "mesh": coarse(HEX27P1)})]
    still = ts.Simulator(needle(), inertia="off")
    depths = np.arange(1, 7) * 50e-6
    for each in found:
        each.step(0.0, 1e-3)  # the motion begins at the surface
    expected, forces = ([each.step(depth, 1e-3) for depth in depths.tolist()] for each in found)
    slow = np.array([still.step(depth, 1e-3).force for depth in depths.tolist()])
    assert all(answer.inertial and answer.age == 0.0 for answer in forces)
    # The first forces are those of the impact, which a tick does not resolve.
    assert forces[0].status is ts.ForceStatus.LATE
    assert all(answer.status is ts.ForceStatus.CONVERGED for answer in forces[3:])
    expected, forces = (np.array([answer.force for answer in answers]) for answers in (expected, forces))
    np.testing.assert_allclose(forces, expected, atol=0.03 * expected.max())
    assert (slow / expected)[:4].max() < 0.7


def test_auto_follows_the_speed():
    sim = simulator()
    assert not any(sim.step(depth, 1e-2).inertial for depth in (2e-5, 4e-5))
    assert all(sim.step(depth, 1e-3).inertial for depth in (9e-5, 14e-5))
    # The tool that stands is followed for a tenth of a second more.
    assert sim.step(14e-5, 0.09).inertial
    at_rest = sim.step(14e-5, 0.09)
    assert not at_rest.inertial
    assert at_rest.force == pytest.approx(simulator(inertia="off").step(14e-5, 1e-3).force, rel=1e-4)


@pytest.mark.slow
def test_what_went_before_is_saved_and_let_go():
    sim = simulator(inertia="on")
    for depth in (5e-5, 1e-4, 1.5e-4):
        sim.step(depth, 1e-3)
    saved = sim.save()
    once = [sim.step(1.5e-4, 1e-3).force for _ in range(3)]
    sim.restore(saved)
    assert [sim.step(1.5e-4, 1e-3).force for _ in range(3)] == pytest.approx(once, rel=1e-9)
    assert np.ptp(once) > 0.02 * max(map(abs, once)), "it swings"
    sim.reset()
    assert sim.step(5e-5, 1e-3).force == pytest.approx(simulator(inertia="on").step(5e-5, 1e-3).force, rel=1e-6)


@pytest.mark.slow
def test_it_knows_its_own_stiffness_and_the_next_step():
    """Along, aside and in turns, by steps that are then taken."""
    sim = simulator(inertia="on", looks_ahead=True)
    for tick in range(9):
        pose = Pose((2e-5 * tick, 0.0, -5e-5 * tick))
        answer = sim.step(pose, 1e-3)
    saved = sim.save()
    stays = np.array(sim.step(pose, 1e-3).wrench)
    assert answer.ahead is not None
    scale = np.array([1.0, 1.0, 1.0, 0.01, 0.01, 0.01])
    np.testing.assert_allclose(answer.ahead.wrench, stays, atol=0.02 * np.abs(np.array(answer.wrench) - stays).max()
                               * scale.max())
    assert np.abs(np.array(answer.wrench) - stays)[[0, 2]].min() > 0.01, "far from the last force"
    for axis in (0, 2):
        sim.restore(saved)
        way = np.array(pose.position)
        way[axis] += 1e-6
        moved = np.array(sim.step(Pose(tuple(way.tolist())), 1e-3).wrench)
        slope = -(moved - stays)[axis] / 1e-6
        assert answer.ahead.stiffness_matrix[axis][axis] == pytest.approx(slope, rel=0.02)
    slow = simulator(inertia="off")
    for tick in range(1, 9):
        still = slow.step(Pose((2e-5 * tick, 0.0, -5e-5 * tick)), 1e-3)
    # At another state of the tissue, which is nearly linear still.
    np.testing.assert_allclose(np.diag(answer.stiffness_matrix)[:3], np.diag(still.stiffness_matrix)[:3], rtol=0.05)
    assert answer.step_stiffness_matrix[2][2] > 3.0 * answer.stiffness_matrix[2][2]


@pytest.mark.slow
def test_a_ball_without_friction_feels_the_mass():
    model = needle("frictionless", ts.Tool("sphere", radius=8e-3))
    last = []
    for inertia in ("auto", "off"):
        # Elements with curved sides: flat ones make the force of a ball uncertain at this depth.
        sim = ts.Simulator(model, solver="solid", mesh=coarse(HEX27P1), inertia=inertia)
        sim.step(0.0, 1e-3)  # the motion begins at the surface
        answers = [sim.step(5e-5 * tick, 1e-3) for tick in range(1, 11)]
        assert all(answer.status is ts.ForceStatus.CONVERGED for answer in answers)
        assert all(answer.inertial is (inertia == "auto") for answer in answers)
        last.append(answers[-1].force)
    assert last[0] > 1.02 * last[1]


def test_a_solver_without_mass_does_not_say_that_it_has_one():
    class Weightless(SolidSolver):
        enable_inertia = Solver.enable_inertia

    def make(model, *, resolution, mesh=None, topology=None):
        solver = make_solver(model, mesh=coarse())
        solver.__class__ = Weightless
        return solver

    SOLVERS.register(make, "weightless")
    try:
        assert not ts.Simulator(needle(), solver="weightless").step(5e-5, 1e-3).inertial
        with pytest.raises(ts.InputError, match="inertia: must be 'auto' or 'off' with the solver 'weightless'"):
            ts.Simulator(needle(), solver="weightless", inertia="on")
    finally:
        SOLVERS.unregister("weightless")
