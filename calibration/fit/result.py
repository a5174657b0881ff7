"""Result of a calibration, and its JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from calibration.campaign.campaign import Campaign
from calibration.fit.agreement import compare_method_intervals_in_sentences
from calibration.fit.fit import Fit, Prediction, SensorNoiseRecord
from calibration.fit.self_weight import describe_self_weight
from tissue_sim.public_names import make_getattr_for_old_names

__getattr__ = make_getattr_for_old_names(__name__, {"to_json": "to_json_dictionary"})


@dataclass(frozen=True)
class CalibrationResult:
    """Result of the calibration of one campaign.

    Attributes:
        campaign: campaign.
        fits: fits of all laws, best first: usable fits before others, then by prediction error, or by BIC without
            predictions.
        predictions: for each law predictions of the held-out tests and of each test by a fit to the others.
        message: explanation of the ranking.
        output: output folder.
        digest: hash of all inputs of the result.
        noise_Pa: pooled noise of the nominal stress, Pa; None for an inverse fit.
        noise_source: ``"stated"``, ``"estimated"``, ``"resolution"`` (of the sensor) or ``"mixed"``.
        noise: noise of each test of an inverse fit.
        failures: law -> reason why it has no fit.
        usability_settings: name -> value of the limits of the usability rule that differ from the defaults.
        resumed: whether the result was read from an earlier run.
    """

    campaign: Campaign
    fits: tuple[Fit, ...]
    predictions: tuple[Prediction, ...]
    message: str
    output: Path
    digest: str
    noise_Pa: float | None = None
    noise_source: str = "stated"
    noise: tuple[SensorNoiseRecord, ...] = ()
    failures: Mapping[str, str] = field(default_factory=dict)
    usability_settings: Mapping[str, float] = field(default_factory=dict)
    resumed: bool = False

    @property
    def best(self) -> Fit:
        """First fit of the ranking; this fit may be unusable if no law is usable."""
        return self.fits[0]


def list_method_agreement_sentences(results: Sequence[CalibrationResult]) -> list[str]:
    """Return a sentence for each law on the agreement of the methods that were fitted to the same recordings."""
    return compare_method_intervals_in_sentences([(result.campaign, result.fits) for result in results])


def to_json_dictionary(results: Sequence[CalibrationResult]) -> dict[str, Any]:
    """Return the JSON object of ``calibrate --json`` and ``fit.json``.

    Several campaigns are a list under the key ``campaigns``. ``output`` is the output folder as given by the caller.
    Each ``material_file`` is relative to it, so that ``fit.json`` remains valid if the folder moves.
    """
    if len(results) != 1:
        return {"campaigns": [to_json_dictionary([result]) for result in results],
                "agreement": list_method_agreement_sentences(results)}
    result = results[0]
    return {
        "campaign": result.campaign.name, "method": result.campaign.fit.method,
        "fits": list(msgspec.to_builtins(result.fits)), "best": result.best.law, "failures": dict(result.failures),
        "predictions": list(msgspec.to_builtins(result.predictions)), "noise_Pa": result.noise_Pa,
        "noise_source": result.noise_source, "noise": list(msgspec.to_builtins(result.noise)),
        "message": result.message, "self_weight": describe_self_weight(result.campaign, result.best),
        "usability_settings": dict(result.usability_settings),
        "output": str(result.output), "work": result.digest,
    }


def decode_calibration_result(found: Mapping[str, Any], campaign: Campaign, folder: Path) -> CalibrationResult:
    """Return the result of an earlier run from the content of ``fit.json``.

    Args:
        found: content of the file.
        campaign: campaign.
        folder: output folder.

    Raises:
        KeyError, TypeError, msgspec.ValidationError: the content is incomplete or invalid.
    """
    return CalibrationResult(
        campaign, msgspec.convert(tuple(found["fits"]), tuple[Fit, ...]),
        msgspec.convert(tuple(found["predictions"]), tuple[Prediction, ...]), found["message"], folder, found["work"],
        found["noise_Pa"], found["noise_source"],
        msgspec.convert(tuple(found["noise"]), tuple[SensorNoiseRecord, ...]),
        msgspec.convert(found.get("failures", {}), dict[str, str]),
        msgspec.convert(found.get("usability_settings", {}), dict[str, int | float]), resumed=True)
