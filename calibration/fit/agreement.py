"""Comparison of the estimates of different methods from the same recordings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

from calibration.campaign.campaign import Campaign
from calibration.fit.fit import Fit

#: Campaign with its fits.
Fits = tuple[Campaign, Sequence[Fit]]


def compare_method_intervals_in_sentences(results: Sequence[Fits]) -> list[str]:
    """Compare campaigns of different methods that were fitted to the same recordings.

    Args:
        results: campaigns with their fits.

    Returns:
        For each law a sentence: the parameters whose 95 % intervals do not overlap, with possible reasons, or the
        statement that all intervals overlap.
    """
    return [sentence for one, other in combinations(results, 2)
            if one[0].fit.method != other[0].fit.method
            and _collect_fitted_recording_paths(one) == _collect_fitted_recording_paths(other)
            for sentence in _iterate_law_comparison_sentences(one, other)]


def _collect_fitted_recording_paths(fits: Fits) -> frozenset:
    """Return the paths of all fitted recordings."""
    return frozenset(path.resolve() for test in fits[0].tests if not test.hold_out for path in test.recordings)


def _iterate_law_comparison_sentences(one: Fits, other: Fits) -> Iterator[str]:
    """Yield a sentence for each law that both campaigns fit."""
    by_law = {fit.law: fit for fit in other[1]}
    for mine in one[1]:
        if mine.law not in by_law:
            continue
        fit, apart, compared = by_law[mine.law], [], 0
        for name in (name for name in mine.parameters if name in fit.parameters):
            left, right = mine.intervals95.get(name), fit.intervals95.get(name)
            if left is None or right is None or left[0] == left[1] or right[0] == right[1]:
                continue
            compared += 1
            if left[1] < right[0] or right[1] < left[0]:
                apart.append(f"{mine.symbols[name]} {_format_interval(mine, name)} and {_format_interval(fit, name)}")
        names = f"{mine.law}: {_format_campaign_and_method(one[0])} and {_format_campaign_and_method(other[0])}"
        if apart:
            why = _explain_interval_disagreement(mine, fit, one[0], other[0])
            yield f"{names} have 95 % intervals that do not overlap: {'; '.join(apart)}. {why}"
        elif compared:
            yield f"{names} agree within their 95 % intervals."


def _format_campaign_and_method(campaign: Campaign) -> str:
    """Return name and method of a campaign, such as ``study (inverse FEM)``."""
    return f"{campaign.name} ({campaign.fit.method.replace('_fem', ' FEM')})"


def _format_interval(fit: Fit, name: str) -> str:
    """Return the 95 % interval of a parameter with its unit, such as ``1390 to 1420 Pa``."""
    low, high = fit.intervals95[name] or (float("nan"), float("nan"))
    return f"{low:.4g} to {high:.4g} {fit.get_unit_or_empty_if_dimensionless(name)}".rstrip()


def _explain_interval_disagreement(mine: Fit, fit: Fit, one: Campaign, other: Campaign) -> str:
    """Describe the different assumptions of two methods, the most likely reason of a disagreement first."""
    reasons = []
    inverse, plain = (mine, fit) if one.fit.method == "inverse_fem" else (fit, mine)
    closed = one if plain is mine else other
    if inverse.jitter is not None and closed.fit.offset == "none":
        contact, zero = inverse.jitter.contact_and_zero_jitter_texts
        reasons.append(f"the inverse method assumes a contact offset ({contact}) and a zero ({zero}) of each "
                       'recording, and the analytical one uses the recorded values unless offset = "fit"')
    if max(mine.noise_ratio, fit.noise_ratio) > 1.5:
        reasons.append(f"the residuals are {max(mine.noise_ratio, fit.noise_ratio):.2g} times the noise, so the "
                       "intervals do not include the error of the law, which the methods weight differently")
    if plain.covariance_from == "noise" or inverse.covariance_from == "noise":
        reasons.append("intervals from the noise alone do not include the scatter between recordings")
    return f"Why: {'; '.join(reasons)}." if reasons else "Compare their windows, contacts and bulk response."
