"""Result of a diagnosis in its output folder, and its JSON."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from calibration.campaign.campaign import Campaign
from calibration.diagnosis.diagnosis import Diagnosis


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
