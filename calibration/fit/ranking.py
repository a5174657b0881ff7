"""Which law to prefer: the one that predicts tests that it has not seen."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace

from calibration.campaign.measured import MeasuredCurve
from calibration.fit.curves import TestCurves
from calibration.fit.fit import Fit, Prediction
from calibration.fit.regions import name_misfits
from calibration.statistics.statistics import CURVATURE_RATIO, MODEL_ERROR_RATIO

#: Laws whose predictions differ by less than this share are not told apart by them.
ALIKE = 0.1
#: A prediction error, in %, that nobody would call a prediction.
FAR_OFF = 10.0

Fitted = tuple[Fit, list[Prediction], Sequence[TestCurves]]


def rank(fitted: Sequence[Fitted], *,
         by_prediction: bool) -> tuple[list[Fit], list[Prediction], dict[str, Sequence[TestCurves]]]:
    """Fits, predictions and curves, best law first.

    Usable laws first, then those with a material, then by the root mean square of the prediction errors in % over all
    tests that were held out (where there are any) or left out one at a time; by BIC where nothing is predicted, or
    where that is not asked for.
    """
    told = {p.test for _, predictions, _ in fitted for p in predictions if p.percent is not None}
    if by_prediction:
        fitted = [(replace(fit, left_out=_score([p for p in predictions if p.test in told])), predictions, curves)
                  for fit, predictions, curves in fitted]

    def order(item: Fitted):
        fit = item[0]
        return (fit.status != "converged", fit.material_file is None, fit.left_out is None,
                fit.BIC if fit.left_out is None else fit.left_out)

    fitted = sorted(fitted, key=order)
    return ([fit for fit, _, _ in fitted], [p for _, predictions, _ in fitted for p in predictions],
            {fit.law: curves for fit, _, curves in fitted})


def _score(predictions: Sequence[Prediction]) -> float | None:
    """Root mean square error in %; a test that this law does not predict, but another does, counts as 100 %."""
    held_out = [p for p in predictions if not p.fitted]
    errors = [100.0 if p.percent is None else p.percent for p in held_out or predictions]
    return float(np.sqrt(np.mean(np.square(errors)))) if errors else None


def prediction_message(fits: Sequence[Fit], predictions: Sequence[Prediction]) -> str:
    """What the first place is worth where laws are ranked by prediction."""
    best = fits[0]
    if best.status != "converged":
        return f"No law is usable over the data; the first is {best.law}: {best.message}."
    parts = []
    if held := [name for name in best.on_bound if name in best.parameters]:
        parts.append(f"{best.law} is held by the bounds of {best.in_symbols(held)}: widen them in fit.bounds, or do "
                     "not trust it")
    if best.left_out is not None:
        mine = [p for p in predictions if p.law == best.law]
        held_out = [p for p in mine if not p.fitted]
        shown = held_out or mine
        words = ", ".join(_words(p) for p in shown)
        what = "held-out tests" if held_out else "each test from the others"
        if best.left_out > FAR_OFF:
            parts.append(f"no law predicts {what}; the least wrong is {best.law}: {words}" if len(fits) > 1 else
                         f"{best.law} does not predict {what}: {words}")
        else:
            parts.append(f"{best.law} predicts {what} best: {words}" if len(fits) > 1 else
                         f"{best.law} predicts {what}: {words}")
        rivals = [fit.law for fit in fits[1:] if fit.status == "converged" and fit.left_out is not None
                  and fit.left_out <= (1 + ALIKE) * best.left_out]
        if rivals:
            parts.append(f"{', '.join(rivals)} within {ALIKE:.0%} of its prediction error, so these tests do not "
                         "decide between them")
    else:
        parts.append(f"{best.law} has the lowest BIC; with a single test there is nothing to predict, so this does not "
                     "say which law is right: add a test of another kind" if len(fits) > 1 else
                     f"{best.law} was fitted to a single test, so nothing is known of how it predicts another")
    if bad := name_misfits(best.regions):
        parts.append(f"it leaves a smooth misfit in {bad}, so something is missing in the model")
    if best.not_identifiable:
        parts.append(f"the tests do not determine {best.in_symbols(best.not_identifiable)}"
                     + (f"; {best.suggestions[0].test} would" if best.suggestions else ""))
    known = {fit.law for fit in fits}
    sentences = (part if part.split()[0].rstrip(",") in known else part[0].upper() + part[1:] for part in parts)
    return f"{'. '.join(sentences)}."


def bic_message(fits: Sequence[Fit], fitted: Sequence[MeasuredCurve]) -> str:
    """What the first place is worth where laws are ranked by BIC.

    Args:
        fits: best first. fitted: the recordings that they were fitted to.
    """
    best = fits[0]
    if best.status != "converged":
        return f"No law is usable over the data; the first is {best.law}: {best.message}."
    unusable = [f"{fit.law} ({fit.unusable})" for fit in fits if fit.status != "converged" and fit.BIC < best.BIC]
    lower = f" Lower BIC, but not usable: {', '.join(unusable)}." if unusable else ""
    return f"Best of the laws that are usable over the data: {best.law}{_worth(fits, fitted)}.{lower}"


def _worth(fits: Sequence[Fit], fitted: Sequence[MeasuredCurve]) -> str:
    """What the first place by BIC is worth, as the end of a sentence."""
    best = fits[0]
    if best.noise_ratio > MODEL_ERROR_RATIO:
        return (f"; its residuals are {best.noise_ratio:.3g} times the noise, so model error dominates and the ranking "
                "says which law is least wrong over this range, not which one is right")
    guessed = [curve for curve in fitted if curve.noise.source == "estimated"]
    if best.noise_ratio < CURVATURE_RATIO and guessed:
        key = "nominal_stress_Pa" if guessed[0].stressed else "force_N"
        return (f"; its residuals are {best.noise_ratio:.2g} times the noise, which could not be estimated from "
                f"samples so coarse or smooth: state {key} in [noise]")
    rivals = [fit.law for fit in fits[1:] if fit.status == "converged" and fit.BIC - best.BIC < 10]
    if rivals:
        return f"; {', '.join(rivals)} within 10 of its BIC, so these data do not decide between them"
    return f"; its residuals are {best.noise_ratio:.2g} times the noise"


def _words(prediction: Prediction) -> str:
    if prediction.percent is None:
        return f"{prediction.test} not ({prediction.note})"
    force = "" if prediction.RMSE_N is None else f"{prediction.RMSE_N:.3g} N, "
    return f"{prediction.test} within {force}{float(f'{prediction.percent:.2g}'):g} %"
