"""One diagnosed campaign in its folder, and its JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from calibration.campaign.campaign import Campaign
from calibration.diagnosis.diagnosis import Diagnosis
from calibration.output_folder import DIAGNOSIS_FILE, TABLES_OF_DIAGNOSIS
from tissue_sim.decode import read_json


@dataclass(frozen=True)
class DiagnosisResult:
    """One campaign, diagnosed.

    Attributes:
        campaign: what was asked, with one law. diagnosis: the answer.
        output: folder of its files. digest: of everything that the answer depends on.
        resumed: read back from an earlier run instead of computed.
    """

    campaign: Campaign
    diagnosis: Diagnosis
    output: Path
    digest: str
    resumed: bool = False


def diagnosis_to_json(results: Sequence[DiagnosisResult]) -> dict[str, Any]:
    """The object of ``diagnose --json`` and ``diagnosis.json``: one campaign plainly, several under ``campaigns``."""
    if len(results) != 1:
        return {"campaigns": [diagnosis_to_json([result]) for result in results]}
    result = results[0]
    return {**msgspec.to_builtins(result.diagnosis), "output": str(result.output), "work": result.digest}


def read_diagnosis(campaign: Campaign, folder: Path, digest: str) -> DiagnosisResult | None:
    """The finished diagnosis of the same work, None where there is none that can be read or a file of it is missing."""
    try:
        found = read_json(folder / DIAGNOSIS_FILE, "a finished diagnosis")
        if found["work"] != digest:
            return None
        diagnosis = msgspec.convert(found, Diagnosis)
    except (OSError, ValueError, KeyError, TypeError, msgspec.ValidationError):
        return None
    if not all((folder / name).is_file() for name in (*TABLES_OF_DIAGNOSIS, *diagnosis.files.values())):
        return None
    return DiagnosisResult(campaign, diagnosis, folder, digest, resumed=True)
