"""The analytical calibration of a campaign: closed forms of homogeneous tests, fitted law by law."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import tissue_sim
from calibration.analytical.assess import assess, predict
from calibration.analytical.replicates import Replicate, read_replicates
from calibration.analytical.uniaxial import fit_law
from calibration.campaign.campaign import Campaign
from calibration.fit.fit import Fit
from calibration.fit.result import CalibrationResult
from calibration.statistics.statistics import CURVATURE_RATIO, MODEL_ERROR_RATIO, pooled_noise
from tissue_sim.errors import InputError

if TYPE_CHECKING:
    from calibration.pipeline import Context


class AnalyticalWork:
    """A campaign whose tests have closed forms; see `calibration.pipeline.Work`.

    Raises:
        InputError: what `read_replicates` refuses.
    """

    extra = ()

    def __init__(self, campaign: Campaign):
        self.campaign = campaign
        self.recordings = read_replicates(campaign)

    def check(self, folder: Path, context: Context) -> None:
        """Refuse laws with more parameters than the tests have samples."""
        _check_size(self.campaign, self.recordings)

    def run(self, folder: Path, work: str, context: Context) -> CalibrationResult:
        """Fit all laws and write everything."""
        from calibration.analytical.outputs import write_campaign

        result = _fit_all(self.campaign, self.recordings, folder, work, context.say)
        write_campaign(result, self.recordings, figures=context.figures)
        return result


def _check_size(campaign: Campaign, measured: Sequence[Replicate]) -> None:
    samples = sum(r.stress.size for r in measured if not r.test.hold_out)
    for i, name in enumerate(campaign.fit.laws):
        unknowns = len(tissue_sim.find_law(name).parameters)
        if samples <= unknowns:
            raise InputError(f"{name} has {unknowns} parameters and the tests only {samples} points; widen max_strain "
                             "or take a simpler law", file=campaign.path, field=f"fit.laws[{i}]")


def _fit_all(campaign: Campaign, measured: Sequence[Replicate], folder: Path, work: str,
             say: Callable[[str], None]) -> CalibrationResult:
    fitted = [r for r in measured if not r.test.hold_out]
    held_out = [r for r in measured if r.test.hold_out]
    fits = []
    for name in campaign.fit.laws:
        say(f"{campaign.name}: fitting {name} to {len(fitted)} recording{'s' if len(fitted) != 1 else ''}")
        fits.append(assess(fit_law(name, fitted, campaign.fit), fitted, campaign))
    fits.sort(key=lambda fit: (fit.status != "converged", fit.material_file is None, fit.BIC))
    predictions = [p for fit in fits for p in predict(fit.law, fit.parameters, held_out)]
    noise = pooled_noise([r.noise for r in fitted], np.repeat(np.arange(len(fitted)), [r.stress.size for r in fitted]))
    sources = {r.noise_source for r in fitted}
    source = sources.pop() if len(sources) == 1 else "mixed"
    return CalibrationResult(campaign, tuple(fits), tuple(predictions), _ranking_message(fits, fitted), folder, work,
                             noise, source)


def _ranking_message(fits: Sequence[Fit], fitted: Sequence[Replicate]) -> str:
    best = fits[0]
    if best.status != "converged":
        return f"No law is usable over the data; the first is {best.law}: {best.message}."
    unusable = [f"{fit.law} ({fit.unusable})" for fit in fits if fit.status != "converged" and fit.BIC < best.BIC]
    lower = f" Lower BIC, but not usable: {', '.join(unusable)}." if unusable else ""
    return f"Best of the laws that are usable over the data: {best.law}{_worth(fits, fitted)}.{lower}"


def _worth(fits: Sequence[Fit], fitted: Sequence[Replicate]) -> str:
    """What the first place is worth, as the end of a sentence."""
    best = fits[0]
    if best.noise_ratio > MODEL_ERROR_RATIO:
        return (f"; its residuals are {best.noise_ratio:.3g} times the noise, so model error dominates and the ranking "
                "says which law is least wrong over this range, not which one is right")
    guessed = [r for r in fitted if r.noise_source == "estimated"]
    if best.noise_ratio < CURVATURE_RATIO and guessed:
        key = "force_N" if guessed[0].mechanical else "nominal_stress_Pa"
        return (f"; its residuals are {best.noise_ratio:.2g} times the noise, which could not be estimated from "
                f"samples so coarse or smooth: state {key} in [noise]")
    rivals = [fit.law for fit in fits[1:] if fit.status == "converged" and fit.BIC - best.BIC < 10]
    if rivals:
        return f"; {', '.join(rivals)} within 10 of its BIC, so these data do not decide between them"
    return f"; its residuals are {best.noise_ratio:.2g} times the noise"
