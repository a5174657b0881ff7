"""Another material under a tool that is in the tissue: the next step answers its force."""

from dataclasses import replace

import pytest

import tissue_sim as ts

LAW = {"C10": 1404.9, "C20": 699.4}
MATERIAL = ts.Material("reduced_polynomial_2", LAW, ts.Bulk("bulk_ratio", 1e4))
CASES = {
    "bonded": {"friction": "bonded"},
    "friction": {"friction": 0.7, "tool": ts.Tool("flat", 8e-3, 0.25e-3)},
    "frictionless": {"friction": 0.0, "tool": ts.Tool("flat", 8e-3, 1e-3)},
}


def pressed(options, material=MATERIAL, depth=6e-3, **how) -> tuple[ts.Simulator, ts.ToolForce]:
    """A simulator whose tool stands at a depth."""
    experiment = ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(depth, 2),
                               **{"tool": ts.Tool("flat", 8e-3), **options})
    sim = ts.Simulator(ts.Model(experiment, material), inertia="off", **how)
    steps = round(depth / 1e-4)
    for k in range(1, steps + 1):
        answer = sim.step(depth * k / steps, 1e-3)
    assert answer.status is ts.ForceStatus.CONVERGED
    return sim, answer


@pytest.mark.parametrize("case", CASES)
def test_forces_follow_moduli_that_change_together(case):
    sim, before = pressed(CASES[case])
    for factor in (20.0, 1.0, 0.05, 1.0, 100.0, 1.0):
        sim.set_parameters(**{name: factor * value for name, value in LAW.items()})
        answer = sim.step(6e-3, 1e-3)
        assert answer.status is ts.ForceStatus.CONVERGED
        assert answer.force == pytest.approx(factor * before.force, rel=1e-4)


@pytest.mark.parametrize("case", CASES)
def test_one_modulus_alone_is_followed_there_and_back(case):
    """C10 twentyfold and back under load: once this held 21 N for ever where 1.15 N was true."""
    sim, before = pressed(CASES[case])
    for factor in (20.0, 1.0):
        sim.set_parameters(C10=factor * LAW["C10"])
        answer = sim.step(6e-3, 1e-3)
        assert answer.status is ts.ForceStatus.CONVERGED
    # Friction remembers the way, and the way led through another material.
    assert answer.force == pytest.approx(before.force, rel=1e-3 if CASES[case]["friction"] == 0.7 else 1e-6)
    _, stiff = pressed(CASES[case], replace(MATERIAL, parameters={**LAW, "C10": 20 * LAW["C10"]}))
    sim.set_parameters(C10=20 * LAW["C10"])
    assert sim.step(6e-3, 1e-3).force == pytest.approx(stiff.force, rel=0.01)


@pytest.mark.parametrize("case", CASES)
def test_with_time_for_one_solve_a_step_it_takes_as_many_steps_as_solves(case, monkeypatch):
    """An iteration continues over steps until it has converged; a restart every ten steps never converged."""
    sim, _ = pressed(CASES[case])
    free, _ = pressed(CASES[case])
    for one in (sim, free):
        one.set_parameters(C10=3.0 * LAW["C10"], C20=0.05 * LAW["C20"])
    expected = free.step(6e-3, 1e-3)
    sim.budget = 10.0
    monkeypatch.setattr(sim._clock, "count_fitting_solves", lambda time, first=False: 1 if first else 0)
    answers = [sim.step(6e-3, 1e-3)]
    while answers[-1].status is ts.ForceStatus.LATE and len(answers) < 200:
        answers.append(sim.step(6e-3, 1e-3))
    assert answers[-1].status is ts.ForceStatus.CONVERGED
    assert answers[-1].force == pytest.approx(expected.force, rel=1e-3)
    assert len(answers) <= 2 * expected.iterations + 10


def test_a_change_while_the_mass_counts_is_answered_by_the_new_material():
    sim, before = pressed(CASES["bonded"])
    moving = ts.Simulator(sim.model, inertia="on")
    for k in range(1, 61):
        moving.step(1e-4 * k, 1e-3)
    moving.set_parameters(**{name: 0.1 * value for name, value in LAW.items()})
    answers = [moving.step(6e-3, 1e-3) for _ in range(400)]
    # An equilibrium in every tick; the sudden change of the material starts waves, while which the answers are LATE.
    assert all(answer.age == 0.0 for answer in answers)
    # What swings on in elastic tissue swings about the force of the slow test.
    forces = [answer.force for answer in answers]
    assert sum(forces) / len(forces) == pytest.approx(0.1 * before.force, rel=0.1)
    assert max(map(abs, forces)) < 0.2 * before.force


@pytest.mark.parametrize(("values", "said"), [
    ({"C10": 1e41}, "C10: must be at most 1e\\+09 Pa; got 1e\\+41 Pa"),
    ({"C20": -1e12}, "C20: must be at most 1e\\+09 Pa; got -1e\\+12 Pa"),
    ({"C10": 1e-9}, "parameters: must give a shear modulus of .*; got 2e-09 Pa"),
])
def test_what_no_tissue_has_is_refused_and_changes_nothing(values, said):
    sim, before = pressed(CASES["bonded"], depth=1e-3)
    with pytest.raises(ts.InputError, match=said):
        sim.set_parameters(**values)
    assert sim.step(1e-3, 1e-3).force == pytest.approx(before.force, rel=1e-9)
    assert sim.model.material == MATERIAL
    with pytest.raises(ts.InputError, match=said):
        ts.Simulator(replace(sim.model, material=replace(MATERIAL, parameters={**MATERIAL.parameters, **values})))
