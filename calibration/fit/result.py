"""One calibrated campaign, and its JSON."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from calibration.campaign.campaign import Campaign
from calibration.fit.agreement import compare_methods
from calibration.fit.fit import Fit, Prediction, SensorStatement
from calibration.fit.self_weight import statement
from calibration.output_folder import FIT_FILE, TABLES
from tissue_sim.decode import read_json


@dataclass(frozen=True)
class CalibrationResult:
    """One campaign, calibrated.

    Attributes:
        campaign: what was asked.
        fits: best first; laws that are not usable over the data come after those that are, then by how well a law
            predicts tests that it has not seen, or by BIC where there are none.
        predictions: of the held-out tests, and of each test by a fit to the others; for each law.
        message: for people: what the ranking is worth.
        output: folder of this campaign's files. digest: of everything that the result depends on.
        noise_Pa: pooled standard deviation of the nominal stress; None of an inverse fit.
        noise_source: ``"stated"``, ``"estimated"``, ``"resolution"`` (of the sensor) or ``"mixed"``.
        noise: of the sensor in each test, of an inverse fit.
        failures: law -> why it has no fit.
        resumed: read back from an earlier run instead of computed.
    """

    campaign: Campaign
    fits: tuple[Fit, ...]
    predictions: tuple[Prediction, ...]
    message: str
    output: Path
    digest: str
    noise_Pa: float | None = None
    noise_source: str = "stated"
    noise: tuple[SensorStatement, ...] = ()
    failures: Mapping[str, str] = field(default_factory=dict)
    resumed: bool = False

    @property
    def best(self) -> Fit:
        """The fit at the top of the ranking."""
        return self.fits[0]


def agreement(results: Sequence[CalibrationResult]) -> list[str]:
    """Whether methods that were given the same recordings in one call agree, a sentence for each law."""
    return compare_methods([(result.campaign, result.fits) for result in results])


def to_json(results: Sequence[CalibrationResult]) -> dict[str, Any]:
    """The object of ``calibrate --json`` and of ``fit.json``: one campaign plainly, several under ``campaigns``.

    ``output`` is the folder of the campaign's files as it was named in the call; each ``material_file`` is relative to
    it, so that ``fit.json`` stays true when the folder moves.
    """
    if len(results) != 1:
        return {"campaigns": [to_json([result]) for result in results], "agreement": agreement(results)}
    result = results[0]
    return {
        "campaign": result.campaign.name, "method": result.campaign.fit.method,
        "fits": list(msgspec.to_builtins(result.fits)), "best": result.best.law, "failures": dict(result.failures),
        "predictions": list(msgspec.to_builtins(result.predictions)), "noise_Pa": result.noise_Pa,
        "noise_source": result.noise_source, "noise": list(msgspec.to_builtins(result.noise)),
        "message": result.message, "self_weight": statement(result.campaign, result.best),
        "output": str(result.output), "work": result.digest,
    }


def read_back(campaign: Campaign, folder: Path, digest: str) -> CalibrationResult | None:
    """The finished result of the same work, None where there is none that can be read or a file of it is missing."""
    try:
        found = read_json(folder / FIT_FILE, "a finished calibration")
        if found["work"] != digest:
            return None
        files = [*TABLES, *(fit["material_file"] for fit in found["fits"] if fit["material_file"] is not None)]
        if not all((folder / name).is_file() for name in files):
            return None
        return CalibrationResult(
            campaign, msgspec.convert(tuple(found["fits"]), tuple[Fit, ...]),
            msgspec.convert(tuple(found["predictions"]), tuple[Prediction, ...]), found["message"], folder, digest,
            found["noise_Pa"], found["noise_source"],
            msgspec.convert(tuple(found["noise"]), tuple[SensorStatement, ...]),
            msgspec.convert(found.get("failures", {}), dict[str, str]), resumed=True)
    except (OSError, ValueError, KeyError, TypeError, msgspec.ValidationError):
        return None
