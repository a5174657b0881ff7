"""The work of a step is bounded by a number of linear solutions; what does not fit is done in the next steps."""

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.axisymmetric import newton
from tissue_sim.fem.axisymmetric.equations import EquilibriumEquations
from tissue_sim.fem.solver import StepStatus
from tissue_sim.tool_force import extrapolate_wrench

MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
#: Specimen.
SPECIMEN = ts.Specimen(0.040, 0.070)
#: Length of a tick, s.
TICK = 1e-3
MOST = 5
CONVERGED = ts.ForceStatus.CONVERGED
LATE = ts.ForceStatus.LATE


def model(friction=0.4, edge=0.25e-3) -> ts.Model:
    return ts.Model(ts.Experiment(SPECIMEN, ts.Protocol.ramp(8e-3, 2), tool=ts.Tool("flat", 8e-3, edge),
                                  friction=friction), MATERIAL)


def simulator(how=None, **options) -> ts.Simulator:
    made = ts.Simulator(model(), resolution="realtime_35", **{"inertia": "off", **options, **(how or {})})
    made.warm_up()
    return made


#: Into the tissue at up to 100 mm/s and out again, where the face separates, and in again.
WAY = [8e-3 * np.sin(np.pi * k / 240) ** 2 - 0.2e-3 for k in range(1, 301)]


@pytest.fixture
def work(monkeypatch) -> list[int]:
    """Linear solutions of all kernel starts so far, those of the stiffness included, in its only entry."""
    counted, solve, evaluate = [
        0], EquilibriumEquations.solve_equilibrium, EquilibriumEquations.launch_on_exact_equilibrium_tangent

    def count_solve(self, *arguments, **options):
        solve(self, *arguments, **options)
        is_converged = self.report[newton.StepReportIndex.STATUS] == StepStatus.CONVERGED
        counted[0] += int(self.report[newton.StepReportIndex.ITERATIONS]) + is_converged

    def count_evaluation(self, *arguments, **options):
        evaluate(self, *arguments, **options)
        counted[0] += 1

    monkeypatch.setattr(EquilibriumEquations, "solve_equilibrium", count_solve)
    monkeypatch.setattr(EquilibriumEquations, "launch_on_exact_equilibrium_tangent", count_evaluation)
    return counted


@pytest.mark.parametrize("inertia", ["off", "on"])
def test_no_step_takes_more_and_the_next_equilibrium_is_the_right_one(work, inertia):
    free, bound = simulator(inertia=inertia), simulator(inertia=inertia, max_solves=MOST)
    expected, answers, solutions, reserved = [], [], [], 0
    for depth in WAY:
        work[0] = 0
        expected.append(free.step(depth, TICK))
        solutions.append(work[0])
        work[0] = 0
        answers.append(bound.step(depth, TICK))
        # The stiffness of an inertial step may take one reserved solution.
        has_new_stiffness = answers[-1].inertial and answers[-1].stiffness_age == 0.0
        assert work[0] <= MOST + has_new_stiffness and answers[-1].iterations < MOST
        reserved += work[0] > MOST
    assert reserved <= len(WAY) / 10 + 1, "a reserved solution in every tenth step at most"
    # Equilibria of this time; those of an impact are LATE even without a bound, since a tick does not resolve it.
    late = np.array([answer.age > 0.0 for answer in answers])
    assert max(solutions) > MOST and late.any(), "else nothing is tested"
    assert all(answer.age == 0.0 for answer in expected) and late.mean() < 0.1
    apart = np.array([abs(one.force - other.force) for one, other in zip(answers, expected, strict=True)])
    largest = max(answer.force for answer in expected)
    assert apart[~late].max() < 0.01 * largest


def test_contact_settles_within_a_solution():
    """At 50 mm/s in and out again 4 solutions and the stiffness are enough, where each change of points that stick,
    slip, touch or part took a separate one (7), and the forces are those of far smaller residuals."""
    way = [*range(1, 201), *range(199, -1, -1)]
    bound, exact = (ts.Simulator(model(0.7), inertia="off", **options) for options in ({"max_solves": 5},
                                                                                       {"tolerance": 1e-9}))
    for simulator in (bound, exact):
        simulator.warm_up()
    answers = [bound.step(0.05e-3 * k, TICK) for k in way]
    assert {answer.status for answer in answers} == {CONVERGED}
    expected = np.array([exact.step(0.05e-3 * k, TICK).force for k in way])
    np.testing.assert_allclose([answer.force for answer in answers], expected, rtol=0.0, atol=1e-6 * expected.max())


def test_a_late_answer_is_the_last_equilibrium_carried_on():
    bound, last = simulator(max_solves=MOST), None
    for k, depth in enumerate(WAY):
        answer = bound.step(depth, TICK)
        if answer.status is LATE:
            assert answer.age > 0.0
            if answer.pose == last.pose:
                assert answer.age == pytest.approx(last.age + TICK) and last.stiffness == answer.stiffness
                if last.status is CONVERGED:
                    way = (0.0, 0.0, WAY[k - 1] - depth, 0.0, 0.0, 0.0)
                    assert answer.force == pytest.approx(
                        max(0.0, extrapolate_wrench(last.wrench, last.stiffness_matrix, way)[2]))
        last = answer
    assert last.status is CONVERGED and last.age == 0.0


def test_the_same_motion_gives_the_same_forces_bit_for_bit():
    one = simulator(max_solves=MOST)
    first = [(answer.force, answer.status) for answer in (one.step(depth, TICK) for depth in WAY)]
    one.reset()
    assert [(answer.force, answer.status) for answer in (one.step(depth, TICK) for depth in WAY)] == first


def test_a_budget_is_a_number_of_solutions_once_it_is_known_what_they_take():
    made = ts.Simulator(model(), resolution="realtime_20", budget=0.8e-3)
    assert made.max_solves is None
    made.warm_up()
    assert made.max_solves == max(3, int(0.8e-3 / made._solve))
    made.budget = 1e-9
    assert made.max_solves == 3
    made.budget = None
    assert made.max_solves is None
    assert simulator(max_solves=7, budget=1.0).max_solves == 7


@pytest.mark.parametrize("most", [2, 0, -3, 4.5, "7"])
def test_no_step_ends_in_less_than_three(most):
    with pytest.raises(ts.InputError, match=r"max_solves.*at least 3"):
        simulator(max_solves=most)


@pytest.mark.parametrize("friction", [0.0, 0.4, "stick"])
@pytest.mark.parametrize("share", [1, 2])
def test_an_iteration_that_was_ended_goes_on_as_if_it_had_not_been(friction, share):
    """Its states of contact, how often they may change, and the curvature that its tangent has, are kept."""
    def pressed():
        sim = ts.Simulator(model(friction, 1e-3), resolution="realtime_35", inertia="off")
        for k in range(1, 31):
            sim.step(1e-4 * k, TICK)
        sim.set_parameters(C10=3.0 * MATERIAL.parameters["C10"], C20=0.05 * MATERIAL.parameters["C20"])
        return sim._solver

    at, options = ts.Pose.at_depth(3.1e-3), {"tolerance": 1e-6, "predictor_order": 0}
    expected = pressed().step(at, TICK, max_iterations=40, **options)
    solver, ended = pressed(), 0
    step = solver.step(at, TICK, max_iterations=share, **options)
    solves = step.iterations
    while step.status is StepStatus.SLOW and solves < 80:
        step, ended = solver.step(at, TICK, max_iterations=share, resumes=True, **options), ended + 1
        solves += step.iterations
    assert step.status is expected.status is StepStatus.CONVERGED and ended
    # Each restart computes a tangent, whereas an uninterrupted iteration uses some tangents twice.
    assert solves <= expected.iterations + 1
    assert step.force == pytest.approx(expected.force, rel=1e-5)
