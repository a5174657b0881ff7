"""Run calibration, diagnosis and design from campaign files to material files, tables and reports."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibration.campaign.campaign import load_campaign
from calibration.campaign.measured import read_measured_curves
from calibration.campaign.planned import PLANNED, read_or_plan_curves_of_all_tests
from calibration.output_folder import (
    PICTURE_FORMATS,
    SUMMARY_FILE,
    has_figure_files_of_all_tests,
    list_possible_calibration_file_paths,
    remove_earlier_results_and_claim_folder,
)
from calibration.tasks.executors import Workers, open_task_executor
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.public_names import make_getattr_for_old_names

__getattr__ = make_getattr_for_old_names(__name__, {"design_experiments": "evaluate_planned_experiments"})

if TYPE_CHECKING:
    from calibration.campaign.campaign import Campaign
    from calibration.diagnosis.decision_limits import DecisionLimits
    from calibration.diagnosis.design import Design
    from calibration.diagnosis.refit_settings import RefitSettings
    from calibration.diagnosis.result import DiagnosisResult
    from calibration.fit.result import CalibrationResult
    from calibration.fit.run_context import IterationListener, Progress
    from calibration.fit.usability_settings import UsabilitySettings


def calibrate(paths: Sequence[str | Path], output: str | Path, *, overwrite: bool = False,
              progress: Progress | None = None, listen: IterationListener | None = None,
              figures: bool = True, figures_format: str | None = None,
              workers: Workers | None = None,
              usability: UsabilitySettings | None = None) -> list[CalibrationResult]:
    """Fit every law of every campaign and write the results.

    ``LAW.material.json``, ``fit.json``, ``report.html``, ``curves.csv`` and ``residuals.csv`` are written to `output`.
    Several campaigns are written to subfolders named by the stems of their files, with a common ``summary.csv``. A
    campaign that is already finished in `output` is read instead of computed. An interrupted campaign continues with
    the simulations stored in its folder ``solves``. ``work.json`` lists all written files; files that it does not list
    are never removed or replaced.

    Args:
        paths: campaign files.
        output: folder of the results; created if missing.
        overwrite: whether results of other campaigns in `output` may be replaced.
        progress: called with a description of the current part, the number of its finished tasks and the number of all
            its tasks (0 and 0 for a part without tasks).
        listen: called with the campaign, the law and each solve of an inverse fit.
        figures: whether the report includes figures.
        figures_format: ``svg``, ``pdf`` or ``png`` to write each figure also as a file; None: no figure files.
        workers: worker processes for inverse fits; None: this process only.
        usability: limits of the usability rule; None: the defaults. ``fit.json`` states those that differ.

    Returns:
        The result of each campaign.

    Raises:
        InputError: a campaign or recording is invalid, or `output` contains other files; nothing is written.
        ConvergenceError: no law of a campaign could be fitted; the results of the other campaigns are written.
        WorkerError: a worker process ends each time it works on a part.

    Examples:
        >>> import numpy as np
        >>> from pathlib import Path
        >>> import tissue_sim as ts
        >>> displacement = np.linspace(0.0, 0.010, 41)
        >>> stress = ts.find_law("neo_hooke").nominal_stress(1.0 - displacement / 0.070, {"C10": 1000.0})
        >>> force = -ts.Specimen(0.040, 0.070).area * stress
        >>> ts.write_recording(ts.Recording({"displacement": displacement, "force": force}), "plates.csv")
        >>> _ = Path("study.toml").write_text('''
        ... [[specimen]]
        ... radius_mm = 40.0
        ... height_mm = 70.0
        ... [[test]]
        ... kind = "lubricated_compression"
        ... recordings = ["plates.csv"]
        ... [fit]
        ... laws = ["neo_hooke"]
        ... [noise]
        ... force_N = 0.02
        ... ''')
        >>> result, = calibrate(["study.toml"], "results", figures=False)
        >>> round(result.best.parameters["C10"], 1)
        1000.0
    """
    output = Path(output)
    _require_known_figure_format(figures_format)
    campaigns = _require_distinct_names([load_campaign(path) for path in paths])
    measured = [read_measured_curves(campaign) for campaign in campaigns]
    # Imported on use: errors in files are reported before the slow imports of the fit and of SciPy.
    from calibration.campaign_fit import CampaignFit
    from calibration.fit.result import read_earlier_result
    from calibration.fit.run_context import RunContext
    from calibration.fit.usability_settings import USABILITY
    from calibration.report.outputs import write_summary_table

    with open_task_executor(workers or Workers()) as tasks:
        fits = [CampaignFit(campaign, curves, output / campaign.name if len(campaigns) > 1 else output,
                            RunContext(campaign.name, tasks, progress, listen), usability or USABILITY)
                for campaign, curves in zip(campaigns, measured, strict=True)]
        results, failures = _run_campaigns_and_collect_failures(fits, output, read_earlier_result, overwrite, figures,
                                                                figures_format)
    if len(campaigns) > 1:
        write_summary_table(results, output / SUMMARY_FILE)
    if failures:
        raise ConvergenceError("; ".join(failures))
    return results


def diagnose(paths: Sequence[str | Path], output: str | Path, *, overwrite: bool = False,
             progress: Progress | None = None, figures: bool = True, figures_format: str | None = None,
             workers: Workers | None = None, law: str | None = None,
             announce: Callable[[str], None] | None = None,
             limits: DecisionLimits | None = None,
             refit_settings: RefitSettings | None = None) -> list[DiagnosisResult]:
    """Find and name the effects that a plain model misses in each campaign, and write the results.

    ``diagnosis.json``, ``report.html``, ``residuals.csv`` and the files that include the effects found are written to
    `output`, for several campaigns to subfolders named by the stems of their files. Finished and interrupted campaigns
    are treated as in `calibrate`.

    Args:
        paths: campaign files with ``method = "inverse_fem"``.
        output: folder of the results; created if missing.
        overwrite: whether results of other campaigns in `output` may be replaced.
        progress: receives the progress, see `calibrate`.
        figures: whether the report includes figures.
        figures_format: format of separate figure files; None: no figure files.
        workers: worker processes; None: this process only.
        law: one law of each campaign; None: its first.
        announce: called with the expected duration if it is a minute or more because of three-dimensional tests.
        limits: decision limits; None: the defaults. ``diagnosis.json`` states those that differ.
        refit_settings: settings of the fits with an effect; None: the defaults. ``diagnosis.json`` states those that
            differ.

    Returns:
        The result of each campaign.

    Raises:
        InputError: a campaign or recording is invalid, or `output` contains other files; nothing is written.
        ConvergenceError: a campaign could not be fitted; the results of the others are written.
        WorkerError: a worker process ends each time it works on a part.
    """
    output = Path(output)
    _require_known_figure_format(figures_format)
    from calibration.diagnosis.evidence import make_one_law_whole_recording_campaign

    campaigns = _require_distinct_names([make_one_law_whole_recording_campaign(load_campaign(path), law)
                                         for path in paths])
    measured = [read_measured_curves(campaign) for campaign in campaigns]
    from calibration.campaign_diagnosis import CampaignDiagnosis
    from calibration.diagnosis.decision_limits import LIMITS
    from calibration.diagnosis.effect_files import list_all_possible_diagnosis_paths
    from calibration.diagnosis.refit_settings import REFITS
    from calibration.diagnosis.result import read_matching_diagnosis_or_none
    from calibration.fit.run_context import RunContext

    with open_task_executor(workers or Workers()) as tasks:
        parts = [CampaignDiagnosis(campaign, curves, output / campaign.name if len(campaigns) > 1 else output,
                                   RunContext(campaign.name, tasks, progress, announce=announce), limits or LIMITS,
                                   refit_settings or REFITS)
                 for campaign, curves in zip(campaigns, measured, strict=True)]
        results, failures = _run_campaigns_and_collect_failures(parts, output, read_matching_diagnosis_or_none,
                                                                overwrite, figures, figures_format,
                                                                list_all_possible_diagnosis_paths)
    if failures:
        raise ConvergenceError("; ".join(failures))
    return results


def _run_campaigns_and_collect_failures(parts: Sequence[Any], output: Path, read_result: Callable[..., Any],
                                        overwrite: bool, figures: bool, figures_format: str | None,
                                        files_of: Callable[...,
                                                           list[Path]] = list_possible_calibration_file_paths) -> tuple[
                                            list[Any], list[str]]:
    """Run several campaigns, except finished ones, whose results are read; collect the messages of failed campaigns.

    Args:
        parts: a `CampaignFit` or `CampaignDiagnosis` for each campaign.
        output: folder of all results.
        read_result: returns the result of a finished campaign, or None.
        overwrite: whether finished campaigns are computed again and other results replaced.
        figures: whether the reports include figures.
        figures_format: format of separate figure files; None: no figure files.
        files_of: returns the paths of all files that may be written for a campaign.

    Returns:
        The results, and the messages of campaigns that failed.
    """
    finished = [None if overwrite or not (figures_format is None or has_figure_files_of_all_tests(
        part.campaign, part.folder, figures_format)) else read_result(part.campaign, part.folder, part.digest)
        for part in parts]
    for part, result in zip(parts, finished, strict=True):
        if result is None:
            part.check_start_values_before_writing()
    remove_earlier_results_and_claim_folder(output, {part.campaign.name: part.folder for part in parts},
                                            [part.campaign for part in parts],
                                            [recording for part in parts for recording in part.recordings],
                                            {part.campaign.name: part.digest for part in parts}, overwrite, files_of)
    results, failures = [], []
    for part, result in zip(parts, finished, strict=True):
        try:
            results.append(result or part.run(figures=figures, figures_format=figures_format))
        except ConvergenceError as failure:
            # A failed campaign does not stop the others.
            failures.append(str(failure))
    return results, failures


def evaluate_planned_experiments(path: str | Path, *, law: str | None = None, replicates: int = PLANNED.replicates,
                                 samples: int = PLANNED.samples, workers: Workers | None = None,
                                 progress: Progress | None = None) -> Design:
    """Predict what the planned experiments of a campaign will determine, without writing files.

    Planned tests state a ``protocol`` instead of recordings; ``[noise]`` states the noise of the force sensor and
    ``start`` the expected material. Tests with recordings use their recordings.

    Args:
        path: campaign file with ``method = "inverse_fem"``.
        law: one of its laws; None: its first.
        replicates: number of recordings of a planned test.
        samples: number of samples per planned recording, evenly spaced in time.
        workers: worker processes; None: this process only.
        progress: receives the progress, see `calibrate`.

    Raises:
        InputError: the campaign is invalid, a protocol is invalid or deeper than the specimen, noise or start values
            are missing, or there are too few replicates or samples.
        WorkerError: a worker process ends each time it works on a part.
    """
    from calibration.diagnosis.evidence import make_one_law_whole_recording_campaign

    campaign = make_one_law_whole_recording_campaign(load_campaign(path, planned=True), law)
    measured = read_or_plan_curves_of_all_tests(campaign, replicates, samples)
    from calibration.diagnosis.design import evaluate_experiment_design
    from calibration.fit.run_context import RunContext

    with open_task_executor(workers or Workers()) as tasks:
        return evaluate_experiment_design(campaign, measured, RunContext(campaign.name, tasks, progress))


def _require_known_figure_format(figures_format: str | None) -> None:
    """Raise an `InputError` if the format of figures is unknown."""
    if figures_format not in (None, *PICTURE_FORMATS):
        raise InputError(f"figures_format must be {', '.join(PICTURE_FORMATS)} or None; got {figures_format!r}",
                         field="figures_format")


def _require_distinct_names(campaigns: list[Campaign]) -> list[Campaign]:
    """Return the campaigns after checking that there is at least one and that their names differ."""
    if not campaigns:
        raise InputError("campaigns must contain at least one campaign file; got none")
    for i, campaign in enumerate(campaigns):
        if any(other.name == campaign.name for other in campaigns[:i]):
            raise InputError(f"names of campaign files must be different, because they name the folders of the "
                             f"results; got {campaign.name!r} twice. Rename one file", file=campaign.path)
    return campaigns
