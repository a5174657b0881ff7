"""What planned experiments could tell: which effects they would show, from which size on, and which are twins there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import msgspec
import numpy as np

from calibration.campaign.campaign import Campaign
from calibration.campaign.measured import MeasuredCurve, scale_offsets
from calibration.campaign.parameter_space import ParameterSpace
from calibration.campaign.planned import with_forces
from calibration.diagnosis.diagnosis import CandidateStatement
from calibration.diagnosis.evidence import Evidence
from calibration.diagnosis.proposals import propose
from calibration.diagnosis.statements import candidate_statements
from calibration.diagnosis.verdict import Judgement
from calibration.fit.campaign_problem import build_problem, first_jitter
from calibration.fit.estimate import Estimate
from calibration.fit.identifiability import not_identifiable
from calibration.fit.problem import Problem
from calibration.fit.steps import Steps
from calibration.fit.uncertainty import assess_uncertainty
from calibration.forward.contract import ForwardTest, InfeasibleError
from calibration.forward.forms import remainder
from calibration.forward.meshes import FAST_REMAINDERS, REMAINDERS
from calibration.forward.solves import Solves
from tissue_sim.errors import InputError


class PlannedTest(msgspec.Struct, frozen=True, kw_only=True):
    """A test as it would be done.

    Attributes:
        name: of the test. recordings: how many. samples: of one. depth_mm, force_N: the largest. duration_s: of one
            recording; None without time.
    """

    name: str
    recordings: int
    samples: int
    depth_mm: float
    force_N: float
    duration_s: float | None = None


class Design(msgspec.Struct, frozen=True, kw_only=True):
    """What the experiments of a campaign could tell, before any of them is done.

    Attributes:
        campaign, law: names. candidates: the catalogue; what can be shown first, the smallest share of its usual size
            first. parameters: name -> value at which it was asked, SI. symbols, units: name -> symbol, SI unit.
            standard_errors: that they would have; None where these experiments leave them open, 0 of one that is
            fixed. noise_N: of the sensors. tests: what is planned.
    """

    campaign: str
    law: str
    candidates: list[CandidateStatement]
    parameters: dict[str, float]
    symbols: dict[str, str]
    units: dict[str, str]
    standard_errors: dict[str, float | None]
    noise_N: float
    tests: list[PlannedTest]


def expected_evidence(campaign: Campaign, measured: Mapping[str, tuple[MeasuredCurve, ...]],
                      solves: Solves) -> Evidence:
    """The evidence of recordings that a plain material at the stated start would give, without their noise.

    Args:
        campaign: see `calibration.diagnosis.evidence.whole_campaign`. measured: motions of all recordings; their force
            does not matter.

    Raises:
        InputError: no start for a parameter of the law, or one at which the tests do not get through.
    """
    campaign = scale_offsets(campaign, measured)
    law = campaign.fit.laws[0]
    problem = build_problem(law, campaign, measured, solves)
    space = problem.space
    if missing := [name for name in space.free if name not in space.start]:
        raise InputError(f"a design needs a material to begin with; state {', '.join(missing)}", file=campaign.path,
                         field="fit.start")
    theta = np.array([space.start[name] for name in space.free])
    known = {}
    try:
        for test in problem.tests:
            answer = test.solve(space, theta, solves)
            known[test.name] = with_forces(test.measured, [test.evaluate(answer, number, 0.0)[0]
                                                            for number in range(len(test.measured))])
    except InfeasibleError as failure:
        raise InputError(f"a material of this start does not get through the tests ({failure}); take another one, or "
                         "less depth", file=campaign.path, field="fit.start") from None
    # A scatter that nobody states goes with the force, which is known now.
    jitter = first_jitter(campaign, [curve for curves in known.values() for curve in curves])
    problem = Problem(space, tuple(replace(test, measured=known[test.name]) for test in problem.tests), solves,
                      jitter, tuple(_left_by_meshes(test, space, theta, solves) for test in problem.tests))
    evaluation = problem.evaluate(theta)
    estimate = Estimate(1, theta, evaluation.error, True, "", (), {}, 0.0, problem=problem)
    return Evidence(campaign, {**measured, **known}, estimate)


def _left_by_meshes(test: ForwardTest, space: ParameterSpace, theta: np.ndarray, solves: Solves) -> float:
    """What a fit would not know of the error of its meshes, see `calibration.forward.forms.remainder`."""
    corrected = replace(test)
    try:
        corrected.refine(space, theta, solves)
    except InfeasibleError:
        return remainder(test, FAST_REMAINDERS)
    return remainder(corrected, REMAINDERS)


def design(campaign: Campaign, measured: Mapping[str, tuple[MeasuredCurve, ...]], steps: Steps,
           solves: Solves | None = None) -> Design:
    """What these experiments could tell.

    Args:
        campaign, measured: as `expected_evidence`. steps: where the simulations run, and who is told.

    Raises:
        InputError: as `expected_evidence`.
    """
    evidence = expected_evidence(campaign, measured, solves or Solves())
    proposals = propose(evidence, steps)
    nothing = Judgement("NONE", [], (), [], evidence)
    rows = [msgspec.structs.replace(row, score=None, p=None, estimate={})
            for row in candidate_statements(proposals, nothing, evidence)]
    rows.sort(key=lambda row: not row.testable)
    problem = evidence.problem
    spread = assess_uncertainty(problem, evidence.evaluation)
    open_names = not_identifiable(problem.space, spread)
    space = problem.space
    errors = {**dict.fromkeys(evidence.values, 0.0),
              **{name: float(error) if np.isfinite(error) and name not in open_names else None
                 for name, error in zip(space.free, spread.standard_errors, strict=True)}}
    noise = float(np.sqrt(np.mean([curve.noise.deviation**2 for curve in problem.measured])))
    return Design(campaign=campaign.name, law=campaign.fit.laws[0], candidates=rows, parameters=evidence.values,
                  symbols=space.symbols,
                  units={each.name: each.declaration.unit for each in space.unknowns}, standard_errors=errors,
                  noise_N=noise, tests=[_planned(test.name, test.measured) for test in problem.tests])


def _planned(name: str, curves: Sequence[MeasuredCurve]) -> PlannedTest:
    clocks = [curve.clock[-1] - curve.clock[0] for curve in curves if curve.time is not None]
    return PlannedTest(
        name=name, recordings=len(curves), samples=max(curve.force.size for curve in curves),
        depth_mm=1e3 * max(float(curve.displacement.max()) for curve in curves),
        force_N=max(float(curve.force.max()) for curve in curves), duration_s=float(max(clocks)) if clocks else None)
