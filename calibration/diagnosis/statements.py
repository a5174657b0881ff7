"""Conversion of scores and fits to the records of a diagnosis."""

from __future__ import annotations

import numpy as np

from calibration.diagnosis.diagnosis import CandidateResult, EffectParameter, FoundEffect
from calibration.diagnosis.evidence import FitEvidence
from calibration.diagnosis.pairs import find_regions_of_largest_force_change
from calibration.diagnosis.proposals import CatalogueScores, ScoredCandidate
from calibration.diagnosis.refits import EffectRefit, compute_odds_of_best_over_other, find_reached_bound_value_or_none
from calibration.diagnosis.verdict import VerdictWithFits, compute_explained_misfit_fraction
from calibration.effects.effect import Candidate
from calibration.fit.uncertainty import compute_marginal_uncertainty


def list_found_effects(judgement: VerdictWithFits, before: FitEvidence, after: FitEvidence) -> list[FoundEffect]:
    """Return the added effects with the parameters of the final fit.

    Args:
        judgement: verdict with the added effects.
        before: fit without effects.
        after: fit with all added effects.
    """
    found: dict[str, FoundEffect] = {}
    for each in judgement.added:
        candidate = each.proposal.candidate
        numbers = list_fitted_parameters_of_candidate(candidate, after)
        effect = candidate.effect
        if candidate.name in found:
            # A further instance of the effect, such as a second Prony term.
            numbers = [*found[candidate.name].parameters, *numbers]
        found[candidate.name] = FoundEffect(
            name=effect.name, category=effect.category, title=effect.title,
            tests=list(candidate.tests or ()) if candidate.mark else [], parameters=numbers,
            acts_in=find_regions_of_largest_force_change(each.proposal, before))
    return list(found.values())


def list_fitted_parameters_of_candidate(candidate: Candidate, evidence: FitEvidence) -> list[EffectParameter]:
    """Return the fitted parameters of a candidate with their standard errors."""
    space = evidence.problem.space
    spread = compute_marginal_uncertainty(evidence.problem, evidence.evaluation)
    errors = dict(zip(space.free, spread.standard_errors, strict=True))
    mine = {**candidate.sizes, **candidate.shape}
    numbers = []
    for each in space.unknowns:
        if each.path not in mine:
            continue
        error = float(errors.get(each.name, 0.0))
        absent = candidate.find_value_without_effect(evidence.campaign, each.path) \
            if each.path in candidate.sizes else None
        bound = find_reached_bound_value_or_none(space, evidence.estimate.theta, each.name, absent,
                                                 evidence.refit_settings.on_bound)
        numbers.append(EffectParameter(path=each.name, symbol=space.symbols[each.name], unit=each.declaration.unit,
                                       value=evidence.parameter_values[each.name], absent=absent, bound=bound,
                                       standard_error=error if np.isfinite(error) else None))
    return numbers


def list_candidate_results(proposals: CatalogueScores, judgement: VerdictWithFits,
                           before: FitEvidence) -> list[CandidateResult]:
    """Return the records of all candidates: fitted by BIC, then testable ones by score, then untestable effects."""
    refits = {each.candidate_name: each for each in judgement.refits}
    best = judgement.refits[0] if judgement.refits else None
    rows = [_make_testable_candidate_result(name, proposal, proposals, refits.get(name), best, before)
            for name, proposal in proposals.best_variant_by_candidate_name.items()]
    rows.sort(key=lambda row: (row.delta_BIC is None, -(row.delta_BIC or 0.0)))
    for name, reason in proposals.untestable.items():
        effect = proposals.effects[name.partition("@")[0]]
        rows.append(CandidateResult(name=name, effect=effect.name, category=effect.category, title=effect.title,
                                    testable=False, reason=reason, separated_by=effect.separated_by))
    return rows


def _make_testable_candidate_result(name: str, proposal: ScoredCandidate, proposals: CatalogueScores,
                                    fitted: EffectRefit | None,
                                    best: EffectRefit | None, before: FitEvidence) -> CandidateResult:
    """Return the record of a testable candidate: detectable size, score and, after a fit, its parameters."""
    effect, finite = proposal.candidate.effect, fitted is not None and np.isfinite(fitted.gain)
    # The detectable size refers to the shape parameters with the highest expected score.
    mine = [each for each in proposals.all if each.candidate.name == name]
    clearest = max(mine, key=lambda each: each.direction.reach)
    smallest = clearest.compute_effect_parameter_values(before.limits.detectable_score / clearest.direction.reach)
    after = fitted.make_evidence(before) if fitted is not None and finite else None
    prepared = clearest.candidate.make_campaign_with_prepared_tests(before.campaign)
    symbols = clearest.candidate.make_symbols_by_path(before.campaign)
    return CandidateResult(
        name=name, effect=effect.name, category=effect.category, title=effect.title, testable=True, seen_from=smallest,
        symbols={path: symbols[path] for path in smallest}, absent=clearest.absent,
        units={path: clearest.candidate.find_parameter_declaration(prepared, path).unit for path in smallest},
        twins=proposals.find_names_of_indistinguishable_candidates(name), separated_by=effect.separated_by,
        score=proposal.signed_score, p=proposal.p, estimate=proposal.compute_effect_parameter_values(),
        refitted=fitted is not None, delta_BIC=float(fitted.gain) if fitted is not None and finite else None,
        explained_percent=None if after is None
        else 100.0 * compute_explained_misfit_fraction(before.region_misfit_tests, after.region_misfit_tests),
        evidence_ratio=compute_odds_of_best_over_other(best, fitted)
        if fitted is not None and best is not None and finite else None,
        parameters=[] if after is None else list_fitted_parameters_of_candidate(proposal.candidate, after),
        on_bound=[] if fitted is None
        else [fitted.problem.space.symbols[held] for held in fitted.reached_bounds_by_effect_parameter],
        note="" if fitted is None else fitted.failure)
