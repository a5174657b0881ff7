"""Result of a diagnosis in its output folder, and its JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from calibration.campaign.campaign import Campaign
from calibration.diagnosis.diagnosis import Diagnosis
from calibration.output_folder import DIAGNOSIS_FILE, TABLES_OF_DIAGNOSIS
from tissue_sim.decode import read_json_value


@dataclass(frozen=True)
class DiagnosisResult:
    """Result of the diagnosis of one campaign.

    Attributes:
        campaign: campaign with one law.
        diagnosis: diagnosis.
        output: output folder.
        digest: hash of all inputs of the diagnosis.
        resumed: whether the result was read from an earlier run.
    """

    campaign: Campaign
    diagnosis: Diagnosis
    output: Path
    digest: str
    resumed: bool = False


def diagnosis_to_json(results: Sequence[DiagnosisResult]) -> dict[str, Any]:
    """Return the JSON object of ``diagnose --json`` and ``diagnosis.json``.

    Several campaigns are a list under the key ``campaigns``.
    """
    if len(results) != 1:
        return {"campaigns": [diagnosis_to_json([result]) for result in results]}
    result = results[0]
    return {**msgspec.to_builtins(result.diagnosis), "output": str(result.output), "work": result.digest}


def read_matching_diagnosis_or_none(campaign: Campaign, folder: Path, digest: str) -> DiagnosisResult | None:
    """Read the result of an earlier run with the same inputs.

    Args:
        campaign: campaign with one law.
        folder: output folder.
        digest: hash of all inputs.

    Returns:
        The result; None if it is missing, unreadable or incomplete, or belongs to other inputs.
    """
    try:
        found = read_json_value(folder / DIAGNOSIS_FILE, "a finished diagnosis")
        if found["work"] != digest:
            return None
        diagnosis = msgspec.convert(found, Diagnosis)
    except (OSError, ValueError, KeyError, TypeError, msgspec.ValidationError):
        return None
    if not all((folder / name).is_file() for name in (*TABLES_OF_DIAGNOSIS, *diagnosis.files.values())):
        return None
    return DiagnosisResult(campaign, diagnosis, folder, digest, resumed=True)
