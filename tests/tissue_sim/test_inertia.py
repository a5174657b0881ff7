"""Inertia against d'Alembert's solution of the wave equation, and where the simulator uses it."""

from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.axisymmetric.solver import AxisymmetricSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh import cylinder_mesh
from tissue_sim.mesh.elements import Q9P1

#: Radius, m.
RADIUS = 0.01
#: Height, m.
HEIGHT = 0.05
#: Density, kg/m3.
DENSITY = 1000.0
SOFT = ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("bulk_ratio", 3.0))
#: P-wave modulus of a confined column, and the speed of its waves.
MODULUS = SOFT.bulk_modulus + 4.0 / 3.0 * SOFT.mu0
SPEED = np.sqrt(MODULUS / DENSITY)
RISE = 0.02
AMPLITUDE = 1e-6


def velocity(t):
    """Velocity of the top, m/s: a smooth bump, then rest."""
    t = np.asarray(t)
    return np.where((t > 0) & (t < RISE), AMPLITUDE / RISE * (1 - np.cos(2 * np.pi * t / RISE))**2 / 1.5, 0.0)


def place(t):
    u = np.clip(t / RISE, 0.0, 1.0)
    return AMPLITUDE * (u - 2 * np.sin(2 * np.pi * u) / (3 * np.pi) + np.sin(4 * np.pi * u) / (12 * np.pi))


def closed_form(t):
    """Force on the top of a column on a rigid base: rho c (v(t) + 2 v(t - 2 H / c) + ...) times its area."""
    echoes = sum(2.0 * velocity(t - 2 * n * HEIGHT / SPEED) for n in range(1, 20))
    return np.pi * RADIUS**2 * DENSITY * SPEED * (velocity(t) + echoes)


def confined_column() -> AxisymmetricSolver:
    mesh = cylinder_mesh(RADIUS, HEIGHT, (1, 40), Q9P1)
    solver = AxisymmetricSolver(mesh, SOFT, {"base": "z", "side": "r"}, {"top": "z"})
    solver.enable_inertia(DENSITY)
    return solver


def column(steps, end=0.06):
    """Times and forces of the confined column in a number of equal steps."""
    solver = confined_column()
    times, forces = np.arange(1, steps + 1) * end / steps, []
    for t in times:
        step = solver.step(float(place(t)), end / steps, inertial=True)
        assert step.status is StepStatus.CONVERGED
        forces.append(step.force)
    return times, np.array(forces)


def test_waves_in_a_column():
    errors = []
    for steps in (200, 400, 800):
        times, forces = column(steps)
        right = closed_form(times)
        errors.append(np.sqrt(np.mean((forces - right)**2)) / np.abs(right).max())
    assert errors[-1] < 1e-3, "the echoes came back, and the mesh resolves them"
    assert errors[0] / errors[1] > 3.5 and errors[1] / errors[2] > 3.5, "second order in the step"


def test_a_change_of_the_step_does_no_harm():
    """Steps of unequal length, as a loop has them."""
    rng = np.random.default_rng(0)
    solver = confined_column()
    t, worst = 0.0, 0.0
    while t < 0.06:
        dt = float(rng.choice([1e-4, 1.5e-4, 2e-4]))
        t += dt
        step = solver.step(float(place(t)), dt, inertial=True)
        worst = max(worst, abs(step.force - closed_form(t)))
    assert worst < 0.03 * np.abs(closed_form(np.linspace(0, 0.06, 600))).max()


@pytest.fixture(scope="module")
def model():
    test = ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(5e-3, 21), tool=ts.Tool("flat", 0.008))
    return ts.Model(test, ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4},
                                      ts.Bulk("bulk_ratio", 1e4)))


def drive(sim, speed, dt=1e-3, end=5e-3):
    return [sim.step(float(depth), dt) for depth in np.arange(1, round(end / speed / dt) + 1) * speed * dt]


def test_auto_follows_the_speed(model):
    sim = ts.Simulator(model)
    assert not any(answer.inertial for answer in drive(sim, 0.004, dt=2.5e-2))
    sim.reset()
    first, *others = drive(sim, 0.05)
    # Where the tool was before its first pose is not known, so that the first step has no speed.
    assert not first.inertial and all(answer.inertial for answer in others)
    for _ in range(300):
        at_rest = sim.step(5e-3, 1e-3)
    assert not at_rest.inertial
    still = ts.Simulator(model, inertia="off").step(5e-3, 1e-3)
    assert at_rest.force == pytest.approx(still.force, rel=1e-4)


def test_steps_of_a_millisecond_resolve_a_sudden_start(model):
    """50 mm/s from rest: against steps a fifth as long, from a fifth of the way on; and it is not quasi-static."""
    coarse = np.array([answer.force for answer in drive(ts.Simulator(model, inertia="on"), 0.05)])
    fine = np.array([answer.force for answer in drive(ts.Simulator(model, inertia="on"), 0.05, dt=2e-4)])[4::5]
    still = np.array([answer.force for answer in drive(ts.Simulator(model, inertia="off"), 0.05)])
    late = slice(len(coarse) // 5, None)
    assert np.abs(coarse - fine)[late].max() < 0.04 * fine.max()
    assert (fine / still - 1)[len(coarse) // 10] > 0.1


def test_density_where_nobody_said(model):
    assert ts.Simulator(model).density == 1000.0
    dense = replace(model, material=replace(model.material, density=1200.0))
    assert ts.Simulator(dense).density == 1200.0


def test_it_knows_what_the_next_step_answers():
    """The needle on its way, by steps that are then taken: one in which it stays, and one a micrometre further."""
    silicone = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
    needle = ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(0.01), tool=ts.Tool("flat", 0.008))
    sim = ts.Simulator(ts.Model(needle, silicone), inertia="on", looks_ahead=True)
    compared = []
    for tick in range(130):
        depth = 3e-3 * (1 - np.cos(2 * np.pi * tick / 200))
        answer = sim.step(depth, 1e-3)
        if tick in (20, 60, 90, 110):
            saved = sim.save()
            stays = sim.step(depth, 1e-3).force
            sim.restore(saved)
            further = sim.step(depth + 1e-6, 1e-3).force
            sim.restore(saved)
            assert answer.ahead is not None
            compared.append((answer.force, stays, answer.ahead.wrench[2], (further - stays) / 1e-6,
                             answer.ahead.stiffness_matrix[2][2]))
    assert ts.Simulator(ts.Model(needle, silicone), inertia="on").step(1e-3, 1e-3).ahead is None, "not requested"
    now, stays, said, slope, stiffness = np.array(compared).T
    np.testing.assert_allclose(said, stays, atol=3e-3)
    np.testing.assert_allclose(stiffness, slope, rtol=0.02)
    assert np.abs(stays - now).min() > 0.08, "what is held against it: far from the last force"


def test_a_step_without_mass_is_no_motion_to_go_on_from():
    """A column that swings is set at rest by one step without mass; with mass it then stays there."""
    solver = confined_column()
    for _ in range(20):
        solver.step(AMPLITUDE, 1e-3, inertial=True)
    rest = solver.step(AMPLITUDE, 1e-3).force
    after = [solver.step(AMPLITUDE, 1e-3, inertial=True).force for _ in range(20)]
    np.testing.assert_allclose(after, rest, rtol=1e-6)
