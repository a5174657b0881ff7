"""Where Newton's iteration finds no equilibrium, the tissue creeps there: over as many steps as the budget makes of it,
flagged, and with a way back."""

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.solver import Step, StepStatus

MATERIAL = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
MODEL = ts.Model(ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(4e-3, 2), tool=ts.Tool("flat", 8e-3, 1e-3),
                               friction=0.3), MATERIAL)
#: Where the iteration is made to fail, m.
BARRED = 3e-3


class Barred:
    """A simulator whose solver finds no equilibrium from `BARRED` on by itself."""

    def __init__(self, monkeypatch, **how):
        self.simulator = ts.Simulator(MODEL, resolution="realtime_63", inertia="off", **how)
        self.simulator.warm_up()
        self.solver = self.simulator._solver
        for k in range(1, 30):
            self.last = self.simulator.step(1e-4 * k, 1e-3)
            while self.last.status is not ts.ForceStatus.CONVERGED:
                self.last = self.simulator.step(1e-4 * k, 1e-3)
        step, self.barred_from = type(self.solver).step, BARRED

        def fail(pose, dt=0.0, **options):
            return Step.from_axial_force(StepStatus.DIVERGED, 1, 1.0, np.nan) if pose.depth >= self.barred_from \
                else step(self.solver, pose, dt, **options)

        monkeypatch.setattr(self.solver, "step", fail)


@pytest.fixture
def expected() -> float:
    new = ts.Simulator(MODEL, inertia="off")
    for k in range(1, 31):
        answer = new.step(1e-4 * k, 1e-3)
    return answer.force


def test_arrives_at_the_same_force(monkeypatch, expected):
    answer = Barred(monkeypatch).simulator.step(BARRED, 1e-3)
    assert answer.status is ts.ForceStatus.CONVERGED and answer.depth == BARRED
    assert answer.force == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("bound", [{"budget": 1e-3}, {"max_solves": 4}], ids=["time", "number"])
def test_within_a_bound_it_goes_on_from_step_to_step(monkeypatch, expected, bound):
    """All the while the force is that of the last equilibrium, carried on, and not that of a drag."""
    barred = Barred(monkeypatch, **bound)
    answers = [barred.simulator.step(BARRED, 1e-3)]
    while answers[-1].status is ts.ForceStatus.LATE and len(answers) < 2000:
        answers.append(barred.simulator.step(BARRED, 1e-3))
    *late, last = answers
    assert last.status is ts.ForceStatus.CONVERGED and last.force == pytest.approx(expected, rel=1e-4)
    assert late and all(answer.status is ts.ForceStatus.LATE and answer.age > 0.0 for answer in late)
    assert all(answer.iterations < (barred.simulator.max_solves or 99) for answer in answers)
    assert [answer.depth for answer in late] == [barred.last.depth] * len(late)
    assert [answer.force for answer in late] == pytest.approx([late[0].force] * len(late))
    assert late[0].force == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("leave", [lambda one: one.save(), lambda one: one.reset(),
                                   lambda one: one.set_parameters(C10=1404.9)], ids=["save", "reset", "parameters"])
def test_who_leaves_on_the_way_is_back_at_the_last_equilibrium(monkeypatch, leave):
    barred = Barred(monkeypatch)
    equilibrium = barred.solver.state
    creep, left = type(barred.solver).iterate_steps_with_damping, []

    def follow(*arguments, **options):
        for step in creep(barred.solver, *arguments, **options):
            if step.status is StepStatus.CONVERGED and not left:
                assert np.abs(barred.solver.state - equilibrium).max() > 0.0
                left.append(True)
                raise KeyboardInterrupt
            yield step

    monkeypatch.setattr(barred.solver, "iterate_steps_with_damping", follow)
    with pytest.raises(KeyboardInterrupt):
        barred.simulator.step(BARRED, 1e-3)
    leave(barred.simulator)
    if len(barred.solver.committed.depths) > 1:
        np.testing.assert_array_equal(barred.solver.state, equilibrium)
    assert barred.solver.depth in (0.0, barred.last.depth)
    monkeypatch.undo()
    again = barred.simulator.step(barred.last.depth, 1e-3)
    assert again.status is ts.ForceStatus.CONVERGED


def test_after_a_creep_in_a_hold_the_tool_moves_on(monkeypatch):
    """A hold has no motion to cut into increments, and increments of a later motion have positive length."""
    barred = Barred(monkeypatch)
    barred.barred_from = 0.0
    held = barred.simulator.step(barred.last.depth, 1e-3)
    assert held.status is ts.ForceStatus.CONVERGED and held.force == pytest.approx(barred.last.force, rel=1e-4)
    barred.barred_from = BARRED
    on = barred.simulator.step(barred.last.depth + 0.5e-4, 1e-3)
    assert on.status is ts.ForceStatus.CONVERGED and on.force > held.force and on.iterations < 50


def test_where_no_creep_helps_it_stops_and_says_so(monkeypatch):
    """A solver that cannot creep yields no step."""
    barred = Barred(monkeypatch)
    monkeypatch.setattr(barred.solver, "iterate_steps_with_damping", lambda *arguments, **options: iter(()))
    answer = barred.simulator.step(BARRED, 1e-3)
    assert answer.status is ts.ForceStatus.STOPPED and answer.depth < BARRED


def test_where_nothing_helps_it_stops_however_little_fits_into_a_step(monkeypatch):
    """Pressed again once, not in every step: otherwise every step would be late."""
    barred = Barred(monkeypatch, max_solves=4)
    monkeypatch.setattr(barred.solver, "iterate_steps_with_damping", lambda *arguments, **options: iter(()))
    answers = [barred.simulator.step(BARRED, 1e-3)]
    while answers[-1].status is ts.ForceStatus.LATE and len(answers) < 500:
        answers.append(barred.simulator.step(BARRED, 1e-3))
    assert answers[-1].status is ts.ForceStatus.STOPPED and len(answers) > 10
    barred.barred_from = 1.0
    back = [barred.simulator.step(2e-3, 1e-3) for _ in range(20)]
    assert back[-1].status is ts.ForceStatus.CONVERGED
