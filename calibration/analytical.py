"""The analytical calibration, whole: campaign files in; material files, tables and a report out."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

import tissue_sim
from calibration.assess import assess, predict
from calibration.campaign import Campaign, load_campaign
from calibration.fit import Fit, Prediction
from calibration.output_folder import FIT_FILE, SUMMARY_FILE, TABLES, claim
from calibration.replicates import Replicate, read_replicates
from calibration.self_weight import statement
from calibration.statistics import CURVATURE_RATIO, MODEL_ERROR_RATIO, pooled_noise
from calibration.uniaxial import fit_law
from tissue_sim.errors import InputError


@dataclass(frozen=True)
class CalibrationResult:
    """One campaign, calibrated.

    Attributes:
        campaign: what was asked.
        fits: best first, by BIC; laws that are not usable over the data come after those that are.
        predictions: of the held-out tests, for each law.
        noise_Pa: pooled standard deviation of the nominal stress.
        noise_source: ``"stated"``, ``"estimated"``, ``"resolution"`` (of the sensor) or ``"mixed"``.
        message: for people: what the ranking is worth.
        output: folder of this campaign's files. work: digest of everything that the result depends on.
        resumed: read back from an earlier run instead of computed.
    """

    campaign: Campaign
    fits: tuple[Fit, ...]
    predictions: tuple[Prediction, ...]
    noise_Pa: float
    noise_source: str
    message: str
    output: Path
    work: str
    resumed: bool = False

    @property
    def best(self) -> Fit:
        """The fit at the top of the ranking."""
        return self.fits[0]


def calibrate(paths: Sequence[str | Path], output: str | Path, *, overwrite: bool = False,
              progress: Callable[[str], None] | None = None, figures: bool = True) -> list[CalibrationResult]:
    """Fit every law of every campaign and write the results.

    ``LAW.material.json``, ``fit.json``, ``report.html``, ``curves.csv`` and ``residuals.csv`` go into `output`, or into
    one subfolder a campaign, named by its file's stem, with a ``summary.csv`` beside them when there are several. A
    campaign that is finished in `output` is read back instead of computed. ``work.json`` lists what was written; files
    that it does not list are never removed or replaced.

    Args:
        paths: campaign files.
        output: folder, created where missing.
        overwrite: replace the results of other work in `output`.
        progress: called with a sentence before each fit.
        figures: whether the report gets its pictures.

    Raises:
        InputError: anything wrong in a campaign or a recording, or `output` holds something else; nothing is written.
    """
    # Here, so that importing calibration draws nothing in.
    from calibration.outputs import write_campaign, write_summary

    output = Path(output)
    campaigns = [load_campaign(path) for path in paths]
    if not campaigns:
        raise InputError("give at least one campaign file")
    for i, campaign in enumerate(campaigns):
        if any(other.name == campaign.name for other in campaigns[:i]):
            raise InputError(f"two campaign files are called {campaign.name!r}; results go into a folder of that name, "
                             "so rename one", file=campaign.path)
    replicates = [read_replicates(campaign) for campaign in campaigns]
    for campaign, measured in zip(campaigns, replicates, strict=True):
        _check_size(campaign, measured)
    works = {campaign.name: _digest(campaign, measured)
             for campaign, measured in zip(campaigns, replicates, strict=True)}
    folders = {campaign.name: output / campaign.name if len(campaigns) > 1 else output for campaign in campaigns}
    same = claim(output, folders, campaigns, [r for measured in replicates for r in measured], works, overwrite)

    results = []
    for campaign, measured in zip(campaigns, replicates, strict=True):
        folder, work = folders[campaign.name], works[campaign.name]
        result = _read_back(campaign, folder, work) if same else None
        if result is None:
            result = _fit_all(campaign, measured, folder, work, progress)
            write_campaign(result, measured, figures=figures)
        results.append(result)
    if len(results) > 1:
        write_summary(results, output / SUMMARY_FILE)
    return results


def to_json(results: Sequence[CalibrationResult]) -> dict[str, Any]:
    """The object of ``calibrate --json`` and of ``fit.json``: one campaign plainly, several under ``campaigns``.

    ``output`` is the folder of the campaign's files as it was named in the call; each ``material_file`` is relative to
    it, so that ``fit.json`` stays true when the folder moves.
    """
    if len(results) != 1:
        return {"campaigns": [to_json([result]) for result in results]}
    result = results[0]
    return {
        "campaign": result.campaign.name, "fits": list(msgspec.to_builtins(result.fits)), "best": result.best.law,
        "predictions": list(msgspec.to_builtins(result.predictions)), "noise_Pa": result.noise_Pa,
        "noise_source": result.noise_source, "message": result.message,
        "self_weight": statement(result.campaign, result.best), "output": str(result.output), "work": result.work,
    }


def _check_size(campaign: Campaign, measured: Sequence[Replicate]) -> None:
    samples = sum(r.stress.size for r in measured if not r.test.hold_out)
    for i, name in enumerate(campaign.fit.laws):
        unknowns = len(tissue_sim.find_law(name).parameters)
        if samples <= unknowns:
            raise InputError(f"{name} has {unknowns} parameters and the tests only {samples} points; widen max_strain "
                             "or take a simpler law", file=campaign.path, field=f"fit.laws[{i}]")


def _digest(campaign: Campaign, measured: Sequence[Replicate]) -> str:
    content = [campaign.sha256, *(f"{r.name} {r.sha256}" for r in measured), tissue_sim.__version__]
    return hashlib.sha256("\n".join(content).encode()).hexdigest()


def _read_back(campaign: Campaign, folder: Path, work: str) -> CalibrationResult | None:
    """The finished result of the same work, None where there is none that can be read or a file of it is missing."""
    try:
        found = json.loads((folder / FIT_FILE).read_text(encoding="utf-8"))
        if found["work"] != work:
            return None
        files = [*TABLES, *(fit["material_file"] for fit in found["fits"] if fit["material_file"] is not None)]
        if not all((folder / name).is_file() for name in files):
            return None
        return CalibrationResult(
            campaign, msgspec.convert(tuple(found["fits"]), tuple[Fit, ...]),
            msgspec.convert(tuple(found["predictions"]), tuple[Prediction, ...]), found["noise_Pa"],
            found["noise_source"], found["message"], folder, work, resumed=True)
    except (OSError, ValueError, KeyError, TypeError, msgspec.ValidationError):
        return None


def _fit_all(campaign: Campaign, measured: Sequence[Replicate], folder: Path, work: str,
             progress: Callable[[str], None] | None) -> CalibrationResult:
    fitted = [r for r in measured if not r.test.hold_out]
    held_out = [r for r in measured if r.test.hold_out]
    fits = []
    for name in campaign.fit.laws:
        if progress is not None:
            progress(f"{campaign.name}: fitting {name} to {len(fitted)} recording{'s' if len(fitted) != 1 else ''}")
        fits.append(assess(fit_law(name, fitted, campaign.fit), fitted, campaign))
    fits.sort(key=lambda fit: (fit.status != "converged", fit.material_file is None, fit.BIC))
    predictions = [p for fit in fits for p in predict(fit.law, fit.parameters, held_out)]
    noise = pooled_noise([r.noise for r in fitted], np.repeat(np.arange(len(fitted)), [r.stress.size for r in fitted]))
    sources = {r.noise_source for r in fitted}
    source = sources.pop() if len(sources) == 1 else "mixed"
    return CalibrationResult(campaign, tuple(fits), tuple(predictions), noise, source, _ranking_message(fits, fitted),
                             folder, work)


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
