"""Write the result files of a diagnosed campaign."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

from msgspec.structs import replace

from calibration.campaign.campaign import Campaign
from calibration.campaign.measured import MeasuredCurve
from calibration.diagnosis.diagnosis import DiagnosisStage
from calibration.diagnosis.evidence import FitEvidence
from calibration.diagnosis.result import DiagnosisResult, diagnosis_to_json
from calibration.effects.effect import Effect
from calibration.output_folder import DIAGNOSIS_FILE, list_possible_diagnosis_result_paths
from calibration.report.diagnosis_page import build_diagnosis_page
from calibration.report.drawing import FigureEmbedder
from calibration.report.effect_files import list_possible_effect_file_paths, write_effect_files_and_get_diagnosis
from calibration.report.outputs import format_csv_table
from tissue_sim.atomic_write import write_text
from tissue_sim.laws import LAWS


def list_all_possible_diagnosis_paths(campaign: Campaign, folder: Path) -> list[Path]:
    """Return the paths of all files that the diagnosis of a campaign may write.

    Material files of all laws are included, because an effect may require a more general law than the campaign states.
    """
    return [*list_possible_diagnosis_result_paths(campaign, folder),
            *list_possible_effect_file_paths(campaign, sorted(LAWS), folder)]


def write_diagnosis_and_get_result(result: DiagnosisResult, before: FitEvidence, after: FitEvidence | None,
                                   effects: Mapping[str, Effect],
                                   measured: Mapping[str, Sequence[MeasuredCurve]], *, figures: bool = True,
                                   figures_format: str | None = None) -> DiagnosisResult:
    """Write all result files of a diagnosis.

    ``diagnosis.json`` is written last, because its existence marks the campaign as finished.

    Args:
        result: the result of the diagnosis.
        before: the fit without the added effects.
        after: the fit with the added effects; None if no effect was added.
        effects: catalogue of effects by name.
        measured: all recordings of each test.
        figures: whether the report includes figures.
        figures_format: ``svg``, ``pdf`` or ``png`` to write each figure also as a file; None: no figure files.

    Returns:
        The result with the names of the written files and the time of this step.
    """
    began = time.monotonic()
    diagnosis = write_effect_files_and_get_diagnosis(result.diagnosis, after, result.output)
    write_text(result.output / "residuals.csv", _format_before_and_after_residual_table(before, after))
    pictures = FigureEmbedder(result.output, figures_format) if figures else None
    write_text(result.output / "report.html",
               build_diagnosis_page(diagnosis, before, after, effects, measured, pictures))
    stages = [*diagnosis.stages, DiagnosisStage(name="report", wall_s=time.monotonic() - began)]
    result = DiagnosisResult(result.campaign, replace(diagnosis, stages=stages), result.output, result.digest)
    text = json.dumps(diagnosis_to_json([result]), indent=2, ensure_ascii=False, allow_nan=False)
    write_text(result.output / DIAGNOSIS_FILE, text + "\n")
    return result


def _format_before_and_after_residual_table(before: FitEvidence, after: FitEvidence | None) -> str:
    """Return a CSV table of all samples: measured force, and forces of the models without and with the added effects.

    The model forces include the contact offset and the force zero of each recording.

    Forces are in N; for recordings of stress the values are in Pa and the displacement is a strain.
    """
    rows = []
    forces = [before.evaluation.force, before.evaluation.force if after is None else after.evaluation.force]
    for curve, samples in zip(before.problem.measured, before.problem.rows, strict=True):
        factor = 1.0 if curve.test.specimen is None else 1e3
        for i, force in enumerate(curve.force):
            models = [float(force_of[samples][i]) for force_of in forces]
            rows.append([curve.name, None if curve.segment is None else str(curve.segment[i]),
                         None if curve.time is None else float(curve.time[i]), factor * float(curve.displacement[i]),
                         float(force), models[0], None if after is None else models[1], curve.noise.deviation])
    return format_csv_table(["replicate", "segment", "time [s]", "displacement [mm]", "measured [N]",
                             "model before [N]", "model after [N]", "noise [N]"], rows)
