"""Design of experiments: detectable size of each effect, indistinguishable effects, and expected standard errors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import msgspec
import numpy as np

from calibration.campaign.campaign import Campaign
from calibration.campaign.measured import MeasuredCurve, make_campaign_with_scaled_offset_defaults
from calibration.campaign.planned import replace_forces_of_curves
from calibration.diagnosis.diagnosis import CandidateResult
from calibration.diagnosis.evidence import FitEvidence
from calibration.diagnosis.proposals import score_effects
from calibration.diagnosis.statements import list_candidate_results
from calibration.diagnosis.verdict import VerdictWithFits
from calibration.fit.campaign_problem import build_generalised_problem, make_stated_or_guessed_jitter
from calibration.fit.estimate import Estimate, make_test_with_mesh_correction
from calibration.fit.identifiability import find_undetermined_parameters
from calibration.fit.run_context import RunContext
from calibration.fit.uncertainty import compute_marginal_uncertainty
from calibration.forward.contract import InfeasibleError
from calibration.forward.simulation_cache import SimulationCache
from tissue_sim.errors import InputError


class PlannedTestSummary(msgspec.Struct, frozen=True, kw_only=True):
    """Summary of a planned test: recordings, samples, largest depth and force, duration.

    Attributes:
        name: name of the test.
        recordings: number of recordings.
        samples: number of samples of the longest recording.
        depth_mm: largest displacement, mm.
        force_N: largest expected force, N.
        duration_s: duration of the longest recording, s; None without time.
    """

    name: str
    recordings: int
    samples: int
    depth_mm: float
    force_N: float
    duration_s: float | None = None


class Design(msgspec.Struct, frozen=True, kw_only=True):
    """Expected information of the planned experiments of a campaign.

    Attributes:
        campaign: name of the campaign.
        law: name of the law.
        candidates: all effects; testable ones first.
        parameters: name -> assumed value, SI.
        symbols: name -> symbol.
        units: name -> SI unit.
        standard_errors: name -> expected standard error, SI; None if the experiments do not determine the parameter, 0
            if it is fixed.
        noise_N: root mean square of the sensors' noise, N.
        tests: planned tests.
    """

    campaign: str
    law: str
    candidates: list[CandidateResult]
    parameters: dict[str, float]
    symbols: dict[str, str]
    units: dict[str, str]
    standard_errors: dict[str, float | None]
    noise_N: float
    tests: list[PlannedTestSummary]


def simulate_noise_free_evidence(campaign: Campaign, measured: Mapping[str, tuple[MeasuredCurve, ...]],
                                 solves: SimulationCache) -> FitEvidence:
    """Return the evidence of noise-free recordings of a material with the starting values of the campaign.

    Args:
        campaign: campaign from `calibration.diagnosis.evidence.make_one_law_whole_recording_campaign`.
        measured: test -> recordings, of which only the motions are used.
        solves: cache of simulations.

    Raises:
        InputError: a parameter has no starting value, or the simulation fails at the starting values.
    """
    campaign = make_campaign_with_scaled_offset_defaults(campaign, measured)
    law = campaign.fit.laws[0]
    problem = build_generalised_problem(law, campaign, measured, solves)
    space = problem.space
    if missing := [name for name in space.free if name not in space.start]:
        raise InputError(f"fit.start must give the material of a design; state {', '.join(missing)}",
                         file=campaign.path, field="fit.start")
    theta = np.array([space.start[name] for name in space.free])
    known = {}
    try:
        for test in problem.tests:
            answer = test.solve(space, theta, solves)
            known[test.name] = replace_forces_of_curves(test.measured,
                                                        [test.evaluate_force_and_derivatives(answer, number, 0.0)[0]
                                                         for number in range(len(test.measured))])
    except InfeasibleError as failure:
        raise InputError(f"the tests cannot be simulated with this start ({failure}); state another start or a smaller "
                         "depth", file=campaign.path, field="fit.start") from None
    # The default scatter between recordings is proportional to the force, which is known only now.
    jitter = make_stated_or_guessed_jitter(campaign, [curve for curves in known.values() for curve in curves])
    # A fit will correct the mesh; the forces of a design are those of the fast mesh, with the error after a correction.
    mesh_error = tuple(make_test_with_mesh_correction(test, space, theta, solves)[2] for test in problem.tests)
    problem = replace(problem, tests=tuple(replace(test, measured=known[test.name]) for test in problem.tests),
                      jitter=jitter, mesh_error=mesh_error)
    evaluation = problem.evaluate(theta)
    estimate = Estimate(1, theta, evaluation.penalised_sum_of_squares, True, "", (), {}, 0.0, problem=problem)
    return FitEvidence(campaign, {**measured, **known}, estimate)


def evaluate_experiment_design(campaign: Campaign, measured: Mapping[str, tuple[MeasuredCurve, ...]],
                               context: RunContext, solves: SimulationCache | None = None) -> Design:
    """Compute the expected information of planned experiments.

    Args:
        campaign: see `simulate_noise_free_evidence`.
        measured: see `simulate_noise_free_evidence`.
        context: workers and listeners.
        solves: cache of simulations; None: a new one.

    Raises:
        InputError: see `simulate_noise_free_evidence`.
    """
    evidence = simulate_noise_free_evidence(campaign, measured, solves or SimulationCache())
    proposals = score_effects(evidence, context)
    nothing = VerdictWithFits("NONE", [], (), [], evidence)
    rows = [msgspec.structs.replace(row, score=None, p=None, estimate={})
            for row in list_candidate_results(proposals, nothing, evidence)]
    rows.sort(key=lambda row: not row.testable)
    problem = evidence.problem
    spread = compute_marginal_uncertainty(problem, evidence.evaluation)
    open_names = find_undetermined_parameters(problem.space, spread)
    space = problem.space
    errors = {**dict.fromkeys(evidence.parameter_values, 0.0),
              **{name: float(error) if np.isfinite(error) and name not in open_names else None
                 for name, error in zip(space.free, spread.standard_errors, strict=True)}}
    noise = float(np.sqrt(np.mean([curve.noise.deviation**2 for curve in problem.measured])))
    return Design(campaign=campaign.name, law=campaign.fit.laws[0], candidates=rows,
                  parameters=evidence.parameter_values, symbols=space.symbols,
                  units={each.name: each.declaration.unit for each in space.unknowns}, standard_errors=errors,
                  noise_N=noise, tests=[_summarise_planned_test(test.name, test.measured) for test in problem.tests])


def _summarise_planned_test(name: str, curves: Sequence[MeasuredCurve]) -> PlannedTestSummary:
    """Summarise the recordings of a planned test."""
    clocks = [curve.sample_times[-1] - curve.sample_times[0] for curve in curves
              if curve.time is not None]
    return PlannedTestSummary(
        name=name, recordings=len(curves), samples=max(curve.force.size for curve in curves),
        depth_mm=1e3 * max(float(curve.displacement.max()) for curve in curves),
        force_N=max(float(curve.force.max()) for curve in curves), duration_s=float(max(clocks)) if clocks else None)
