"""Random models that once stopped or answered wrongly: each reaches its end, in equilibrium by other means than the
solver's (`benchmarks/random_models`)."""

from types import SimpleNamespace

import pytest

import tissue_sim as ts

#: Seeds that stopped or crashed while contact was watched at Gauss points everywhere and springs were its forces, on
#: the fast and on the accurate mesh, and those whose forces changed by more than 3 % with mesh or step. From 4134 on:
#: where a creep gave up while the tissue was still on its way.
FAST = (8, 14, 21, 31, 64, 101, 118, 130, 160, 183, 186, 191, 192, 203, 206, 267, 320, 333, 371, 376, 378, 387,
        23, 36, 37, 108)
ACCURATE = (6, 14, 21, 23, 24, 31, 48, 69, 77, 81, 92, 117, 119, 120, 4134, 4165, 4232)


@pytest.fixture(scope="module")
def random(benchmark_module):
    """``model``, ``draw``, ``check`` and ``motion`` of the benchmark."""
    generator, check, motion = (benchmark_module(f"random_models.{name}")
                                for name in ("generator", "equilibrium_check", "motion"))
    return SimpleNamespace(model=lambda seed: generator.build(generator.draw(seed)), check=check.EquilibriumCheck,
                           draw=generator.draw, motion=motion)


@pytest.mark.slow
@pytest.mark.parametrize(("resolution", "seed"), [("fast", seed) for seed in FAST]
                         + [("accurate", seed) for seed in ACCURATE])
def test_reaches_its_end_in_equilibrium(random, resolution, seed):
    model = random.model(seed)
    check = random.check(model)
    found = check.finish(ts.simulate(model, resolution=resolution, watch=check, estimate_error=False))
    assert not found.faults


def test_the_check_sees_what_is_no_equilibrium(random):
    """One node out of contact, displaced by 0.01 % of the height from its equilibrium."""
    class Kicked(random.check):
        def check(self, state, *rest):
            node = 2 * self.section.connectivity[0, -1]
            super().check(state + 1e-4 * self.model.experiment.specimen.height * (range(state.size) == node), *rest)

    model = random.model(64)
    check = Kicked(model)
    ts.simulate(model, watch=check)
    assert {"residual"} <= set(check.found.faults)


def test_a_run_of_the_benchmark_gives_its_figures(benchmark_module):
    """One model, with its check and in quarter steps."""
    runs, tables = (benchmark_module(f"random_models.{name}") for name in ("runs", "tables"))
    model = benchmark_module("random_models.generator").draw(64)
    entry = {"seed": 64, "stratum": runs.stratum(model)} | runs.run(model, "fast")
    figures = tables.figures([entry | {"quarter": runs.run_quarter(model, "fast", entry)}])
    assert figures["in_all"]["end"] == 1 and not figures["failures"] and figures["quarter"]["compared"] == 1
    assert 0.0 < figures["quarter"]["largest"] < 0.03 and not figures["quarter"]["unknown"]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [15, 23, 62, 95])
def test_nothing_is_made_of_nothing(random, seed):
    """Tissue gives back no more than was put in."""
    recording = ts.simulate(random.model(seed))
    force, place = recording.force, recording.displacement
    steps = 0.5 * (force[1:] + force[:-1]) * (place[1:] - place[:-1])
    assert steps.sum() > -1e-6 * abs(steps).sum()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [4, 23, 30, 98, 110])
def test_derivatives_with_moduli_add_up_to_the_force(random, seed):
    """At fixed K/mu the force is of first degree in them. A base with friction under a needle hardly presses at its rim
    (4, 110); a bonded face with a rounded edge holds more and more (23, 98)."""
    model = random.model(seed)
    law, values = model.material.energy_law, model.material.parameters
    moduli = [name for name in law.parameters if law.units[name] == "Pa"]
    answer = ts.sensitivities(model, moduli)
    force = answer.recording.force
    assert abs(answer.values @ [values[name] for name in moduli] - force).max() < 1e-8 * abs(force).max()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [31, 35, 46])
def test_every_tick_of_an_irregular_motion_is_in_equilibrium(random, seed):
    """Where faces tear off or a layer under plates slides Newton's iteration alone finds none."""
    found = random.motion.motion(random.draw(seed), "realtime")
    assert found["status"] == "end" and not found["nan"]
    assert found["statuses"] == {"converged": found["ticks"]} and found["after_the_jump"] == "converged"
    assert not found["faults"] and found["recovered"] <= random.motion.AS_NEW
