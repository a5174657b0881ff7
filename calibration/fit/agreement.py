"""Whether two methods that were given the same recordings agree, and why not."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations

from calibration.campaign.campaign import Campaign
from calibration.fit.fit import Fit

#: A campaign and its fits.
Fits = tuple[Campaign, Sequence[Fit]]


def compare_methods(results: Sequence[Fits]) -> list[str]:
    """A sentence for each parameter of a law whose 95 % intervals do not meet, and one for each law where all do, of
    campaigns of different methods that were fitted to the same recordings."""
    return [sentence for one, other in combinations(results, 2)
            if one[0].fit.method != other[0].fit.method and _files(one) == _files(other)
            for sentence in _compare(one, other)]


def _files(fits: Fits) -> frozenset:
    return frozenset(path.resolve() for test in fits[0].tests if not test.hold_out for path in test.recordings)


def _compare(one: Fits, other: Fits) -> Iterator[str]:
    theirs = {fit.law: fit for fit in other[1]}
    for mine in one[1]:
        if mine.law not in theirs:
            continue
        fit, apart, compared = theirs[mine.law], [], 0
        for name in (name for name in mine.parameters if name in fit.parameters):
            left, right = mine.intervals95.get(name), fit.intervals95.get(name)
            if left is None or right is None or left[0] == left[1] or right[0] == right[1]:
                continue
            compared += 1
            if left[1] < right[0] or right[1] < left[0]:
                apart.append(f"{mine.symbols[name]} {_interval(mine, name)} and {_interval(fit, name)}")
        names = f"{mine.law}: {_words(one[0])} and {_words(other[0])}"
        if apart:
            why = _reasons(mine, fit, one[0], other[0])
            yield f"{names} have 95 % intervals that do not meet: {'; '.join(apart)}. {why}"
        elif compared:
            yield f"{names} agree within their 95 % intervals."


def _words(campaign: Campaign) -> str:
    return f"{campaign.name} ({campaign.fit.method.replace('_fem', ' FEM')})"


def _interval(fit: Fit, name: str) -> str:
    low, high = fit.intervals95[name] or (float("nan"), float("nan"))
    return f"{low:.4g} to {high:.4g} {fit.unit(name)}".rstrip()


def _reasons(mine: Fit, fit: Fit, one: Campaign, other: Campaign) -> str:
    """What the two take for granted differently, the likeliest first."""
    reasons = []
    inverse, plain = (mine, fit) if one.fit.method == "inverse_fem" else (fit, mine)
    closed = one if plain is mine else other
    if inverse.jitter is not None and closed.fit.offset == "none":
        contact, zero = inverse.jitter.sizes
        reasons.append(f"the inverse method lets each recording have a contact offset ({contact}) and a zero ({zero}), "
                       'the analytical one takes them as recorded (offset = "fit" would not)')
    if max(mine.noise_ratio, fit.noise_ratio) > 1.5:
        reasons.append(f"the residuals are {max(mine.noise_ratio, fit.noise_ratio):.2g} times the noise, so neither "
                       "interval holds what the law is off, and each method weighs that its own way")
    if plain.covariance_from == "noise" or inverse.covariance_from == "noise":
        reasons.append("intervals that rest on the noise alone know nothing of how recordings differ")
    return f"Why: {'; '.join(reasons)}." if reasons else "Look at their windows, contacts and bulk response."
