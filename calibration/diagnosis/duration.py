"""Estimate of the duration of a diagnosis from the duration of one simulation of each test."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

from calibration.fit.generalised import list_starts_with_varied_exponents
from calibration.fit.problem import GeneralisedProblem
from calibration.forward.meshes import get_solver_fit_resolutions
from calibration.forward.simulated import SimulatedTest
from calibration.forward.simulation_cache import simulate_force_or_record_failure
from tissue_sim.errors import InputError
from tissue_sim.model import Model
from tissue_sim.rig.rig import Rig


@dataclass(frozen=True)
class DiagnosisDurationSettings:
    """Range of the duration of a diagnosis, in simulations of each test.

    Attributes:
        min_simulations: simulations of a short diagnosis: no effect is missing (docs/inverse_calibration.md).
        max_simulations: simulations of a long diagnosis: friction of plates, whose simulations take longest, is among
            the fitted effects.
        min_announced: duration from which the duration is announced, s.
    """

    min_simulations: float = 40.0
    max_simulations: float = 300.0
    min_announced: float = 60.0


SETTINGS = DiagnosisDurationSettings()


def measure_solid_simulation_cpu_s_by_test(problem: GeneralisedProblem) -> dict[str, float]:
    """Measure the processor time of a simulation of each three-dimensional test, without derivatives.

    Tests with fast solvers and failed simulations are omitted.

    Args:
        problem: problem whose first start has been simulated, so that its kernels are compiled.

    Returns:
        Name of the test -> processor time, s.
    """
    found = {}
    for test in problem.tests:
        if isinstance(test, SimulatedTest) and get_solver_fit_resolutions(test.solver).slow:
            experiment = replace(test.experiment, protocol=test.motions[0].tool_protocol)
            try:
                values = problem.space.get_values_by_name(list_starts_with_varied_exponents(problem.space, 1)[0])
                material = problem.space.build_material(values, test=test.name)
                curve = simulate_force_or_record_failure(Model(experiment, material, Rig()), None, [],
                                                         get_solver_fit_resolutions(test.solver).fast, test.solver)
            except InputError:
                continue
            if not curve.problem:
                found[test.name] = curve.cpu_s
    return found


def describe_expected_duration_or_empty(seconds: Mapping[str, float]) -> str:
    """Describe the expected duration and ways to shorten it; empty for a short diagnosis.

    Args:
        seconds: name of the test -> processor time of a simulation, s, from `measure_solid_simulation_cpu_s_by_test`.
    """
    each = sum(seconds.values())
    if SETTINGS.max_simulations * each < SETTINGS.min_announced:
        return ""
    low, high = math.floor(SETTINGS.min_simulations * each / 60.0), math.ceil(SETTINGS.max_simulations * each / 60.0)
    minutes = f"{low} to {high} minutes" if low else f"up to {high} minute{'s' if high > 1 else ''}"
    return (f"expect {minutes} on one processor: a simulation of {'its tests' if len(seconds) > 1 else 'its test'} in "
            f"space takes {each:.2g} s; --workers N shares them between N processes, a smaller max_strain shortens "
            "each, and an interrupted run resumes")
