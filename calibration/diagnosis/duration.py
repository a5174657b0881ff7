"""How long a diagnosis takes, from how long one simulation of each of its tests does."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from calibration.fit.problem import Problem
from calibration.fit.starts import starts
from calibration.forward.meshes import meshes_of
from calibration.forward.simulated import SimulatedTest
from calibration.forward.simulation_cache import simulate_curve
from tissue_sim.errors import InputError
from tissue_sim.model import Model
from tissue_sim.rig.rig import Rig

#: A diagnosis takes as long as so many simulations of each test: where nothing is missing, and where plates with
#: friction, whose simulations are the longest, are among what is fitted (docs/inverse_calibration.md).
FEWEST, MOST = 40.0, 300.0
#: Shorter ones are not worth a word, s.
_WORTH_A_WORD = 60.0


def seconds_of_each(problem: Problem) -> dict[str, float]:
    """Processor seconds that a simulation of each test in space takes, without derivatives; tests of other solvers are
    left out, and what does not get through.

    Args:
        problem: whose kernels are loaded: its first start has been simulated.
    """
    found = {}
    for test in problem.tests:
        if isinstance(test, SimulatedTest) and meshes_of(test.solver).slow:
            experiment = replace(test.experiment, protocol=test.motions[0].protocol)
            try:
                material = problem.space.material(problem.space.values(starts(problem.space, 1)[0]), test=test.name)
                curve = simulate_curve(Model(experiment, material, Rig()), None, [], meshes_of(test.solver).fast,
                                       test.solver)
            except InputError:
                continue
            if not curve.problem:
                found[test.name] = curve.cpu_s
    return found


def in_words(seconds: Mapping[str, float]) -> str:
    """What to expect, and how to make it shorter; empty where it is not worth a word.

    Args:
        seconds: of each test, see `seconds_of_each`.
    """
    each = sum(seconds.values())
    if MOST * each < _WORTH_A_WORD:
        return ""
    low, high = math.floor(FEWEST * each / 60.0), math.ceil(MOST * each / 60.0)
    minutes = f"{low} to {high} minutes" if low else f"up to {high} minute{'s' if high > 1 else ''}"
    return (f"expect {minutes} on one processor: a simulation of {'its tests' if len(seconds) > 1 else 'its test'} in "
            f"space takes {each:.2g} s; --workers N shares them between N processes, a smaller max_strain shortens "
            "each, and a run that is stopped goes on where it was")
