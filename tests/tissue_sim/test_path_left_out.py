"""Equilibria that are not those of the tool's own path: tissue that rubs or relaxes, pressed again from above."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh.solid import create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0
from tissue_sim.pose import Pose

#: Length of a step, s.
DT = 1e-3
#: Radius of the ball, m.
RADIUS = 8e-3
#: Deepest position of the ball, m.
DEPTH = 1e-3


def model(friction, prony=None):
    material = ts.Material("neo_hooke", {"C10": 2000.0}, ts.Bulk("bulk_ratio", 1e3), viscoelastic=prony)
    experiment = ts.Experiment(ts.Specimen(0.030, 0.020), ts.Protocol.ramp(2e-3, 2), friction=friction,
                               tool=ts.Tool("round", radius=RADIUS))
    return ts.Model(experiment, material)


@pytest.fixture
def pressed():
    """Make a simulator of a ball that was at `DEPTH` and is at `start`; no more part has an equilibrium until the ball
    is pressed again from above."""
    def make(friction, prony=None, *, start=0.5 * DEPTH):
        simulator = ts.Simulator(model(friction, prony), resolution="realtime_20", inertia="off")
        if start is not None:
            for depth in (0.0, DEPTH, start):
                assert simulator.step(depth, DT).status is ts.ForceStatus.CONVERGED
        solver = simulator._solver
        solve, press_again, is_lifted = solver.step, solver.reset_to_first_touch, []

        def step(*given, **options):
            found = solve(*given, **options)
            return found if is_lifted else replace(found, status=StepStatus.DIVERGED)

        def reset_to_first_touch():
            is_lifted.append(True)
            press_again()

        solver.step, solver.reset_to_first_touch = step, reset_to_first_touch
        solver.iterate_steps_with_damping = no_creep
        return simulator
    return make


def no_creep(*given, **options):
    """A damped path that finds no equilibrium."""
    return iter(())


@pytest.mark.parametrize(("friction", "prony"), [(0.3, None), (
    "frictionless", ts.Prony((ts.PronyTerm(g=0.3, tau=0.02),)))])
def test_an_equilibrium_after_another_path_is_late_until_the_tissue_has_forgotten_it(pressed, friction, prony):
    simulator = pressed(friction, prony)
    answers = [simulator.step(DEPTH, DT) for _ in range(5)]
    assert {answer.status for answer in answers} == {ts.ForceStatus.LATE}
    assert all(answer.age == 0.0 and answer.force > 0.0 and answer.force_error is None for answer in answers)
    for _ in range(200):
        answer = simulator.step(-1e-3, DT)
    assert answer.status is ts.ForceStatus.CONVERGED
    assert simulator.step(DEPTH, DT).status is ts.ForceStatus.CONVERGED


def test_a_saved_state_keeps_that_its_path_is_incomplete(pressed):
    simulator = pressed(0.3)
    simulator.step(DEPTH, DT)
    saved = simulator.save()
    simulator.reset()
    assert simulator.step(DEPTH, DT).status is ts.ForceStatus.CONVERGED
    simulator.restore(saved)
    assert simulator.step(DEPTH, DT).status is ts.ForceStatus.LATE


@pytest.mark.parametrize(("friction", "start"), [("frictionless", 0.5 * DEPTH), (0.3, None), (0.3, DEPTH)])
def test_a_path_straight_down_or_without_friction_may_be_repeated(pressed, friction, start):
    """Elastic tissue; a first step has no path."""
    assert pressed(friction, start=start).step(1.2 * DEPTH, DT).status is ts.ForceStatus.CONVERGED


def minimum_jerk(keys, counts):
    """Poses along straight lines between positions, m, in these numbers of steps, at rest at each of them."""
    lines = []
    for (start, end), count in zip(pairwise(map(np.array, keys)), counts, strict=True):
        s = np.linspace(0.0, 1.0, count + 1)[1:, None]
        lines.append(start + (end - start) * (10.0 * s**3 - 15.0 * s**4 + 6.0 * s**5))
    return [Pose(tuple(position)) for position in np.concatenate(lines).tolist()]


@pytest.mark.slow
def test_friction_of_nodes_that_hardly_slip_may_turn(monkeypatch):
    """The tool turns round slowly: Newton's method converges, and the tool is not pressed again from above."""
    mesh = create_cylinder_mesh_under_needle(0.030, 0.020, RADIUS, HEX8P0, smallest=0.45 * RADIUS, growth=2.4,
                                             largest=3.0 * RADIUS,
                                             around=2)
    simulator = ts.Simulator(model(0.3), solver="solid", mesh=mesh, inertia="off")
    restarts, press_again = [], SolidSolver.reset_to_first_touch
    monkeypatch.setattr(SolidSolver, "reset_to_first_touch", lambda solver: restarts.append(press_again(solver)))
    keys = [(0.0, 0.0, 0.0), (-1e-4, 7e-4, -1e-3), (-4e-4, -7e-4, -1.5e-3), (-3e-4, 3e-4, -1e-3)]
    poses = minimum_jerk(keys, (19, 24, 17))
    answers = [simulator.step(pose, DT) for pose in (Pose(keys[0]), *poses)]
    assert not restarts
    assert max(answer.iterations for answer in answers) < 20
    turn = np.subtract(answers[44].force_vector, answers[43].force_vector)
    assert np.linalg.norm(turn) < 0.01 * answers[43].force, "the tool moves by 1 um"
