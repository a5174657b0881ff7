"""Run calibration, diagnosis and design from campaign files to material files, tables and reports."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibration.campaign.campaign import load_campaign
from calibration.campaign.measured import read_measured_curves
from calibration.campaign.planned import PLANNED, read_or_plan_curves_of_all_tests
from calibration.output_folder import PICTURE_FORMATS
from calibration.tasks.executors import Workers, open_task_executor
from tissue_sim.errors import InputError
from tissue_sim.public_names import make_getattr_for_old_names

__getattr__ = make_getattr_for_old_names(__name__, {"design_experiments": "evaluate_planned_experiments"})

if TYPE_CHECKING:
    from calibration.campaign.campaign import Campaign
    from calibration.diagnosis.design import Design
    from calibration.diagnosis.diagnosis import DiagnosisResult
    from calibration.diagnosis.evidence import Measured
    from calibration.diagnosis.settings import DecisionLimits, RefitSettings
    from calibration.fit.result import CalibrationResult
    from calibration.fit.run_context import IterationListener, Progress
    from calibration.fit.usability import UsabilitySettings


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
    _require_known_figure_format(figures_format)
    return run_campaign_jobs("fit", paths, output, overwrite=overwrite, workers=workers, progress=progress,
                             listen=listen, options={"limits": usability, "figures": figures,
                                                     "figures_format": figures_format})


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
    _require_known_figure_format(figures_format)
    from calibration.diagnosis.evidence import make_one_law_whole_recording_campaign

    return run_campaign_jobs("diagnosis", paths, output, overwrite=overwrite, workers=workers, progress=progress,
                             announce=announce,
                             load=lambda path: make_one_law_whole_recording_campaign(load_campaign(path), law),
                             options={"limits": limits, "refit_settings": refit_settings, "figures": figures,
                                      "figures_format": figures_format})


def evaluate_planned_experiments(path: str | Path, *, law: str | None = None, replicates: int = PLANNED.replicates,
                                 samples: int = PLANNED.samples, workers: Workers | None = None,
                                 progress: Progress | None = None, output: str | Path | None = None,
                                 overwrite: bool = False, figures: bool = True,
                                 figures_format: str | None = None) -> Design:
    """Predict what the planned experiments of a campaign will determine.

    Planned tests state a ``protocol`` instead of recordings; ``[noise]`` states the noise of the force sensor and
    ``start`` the expected material. Tests with recordings use their recordings.

    With an output folder, ``design.json`` and ``report.html`` are written; finished and interrupted designs are treated
    as in `calibrate`.

    Args:
        path: campaign file with ``method = "inverse_fem"``.
        law: one of its laws; None: its first.
        replicates: number of recordings of a planned test.
        samples: number of samples per planned recording, evenly spaced in time.
        workers: worker processes; None: this process only.
        progress: receives the progress, see `calibrate`.
        output: folder of the results, created if missing; None: nothing is written.
        overwrite: whether results of other campaigns in `output` may be replaced.
        figures: whether the report includes figures.
        figures_format: format of separate figure files; None: no figure files.

    Raises:
        InputError: the campaign is invalid, a protocol is invalid or deeper than the specimen, noise or start values
            are missing, there are too few replicates or samples, or `output` contains other files; nothing is written.
        WorkerError: a worker process ends each time it works on a part.
    """
    _require_known_figure_format(figures_format)
    from calibration.diagnosis.evidence import make_one_law_whole_recording_campaign

    design, = run_campaign_jobs(
        "design", [path], output, overwrite=overwrite, workers=workers, progress=progress,
        options={"figures": figures, "figures_format": figures_format},
        load=lambda path: make_one_law_whole_recording_campaign(load_campaign(path, planned=True), law),
        read=lambda campaign: read_or_plan_curves_of_all_tests(campaign, replicates, samples))
    return design


def run_campaign_jobs(kind: str, paths: Sequence[str | Path], output: str | Path | None, *, overwrite: bool = False,
                      workers: Workers | None = None, progress: Progress | None = None,
                      listen: IterationListener | None = None, announce: Callable[[str], None] | None = None,
                      load: Callable[[str | Path], Campaign] = load_campaign,
                      read: Callable[[Campaign], Measured] = read_measured_curves,
                      options: Mapping[str, Any] | None = None) -> list[Any]:
    """Run one job on each campaign: a fit, a diagnosis, a design or a kind of job that a plug-in registers.

    Finished jobs are read from `output`, and interrupted jobs continue with their stored simulations; see
    `calibration.job.run_jobs`. Several campaigns are written to subfolders named by the stems of their files.

    Args:
        kind: name in `calibration.job.JOBS`.
        paths: campaign files.
        output: folder of the results; None: nothing is written.
        overwrite: whether results of other campaigns in `output` may be replaced.
        workers: worker processes; None: this process only.
        progress: receives the progress, see `calibrate`.
        listen: receives each solve of an inverse fit, see `calibrate`.
        announce: receives the expected duration, see `diagnose`.
        load: function that reads a campaign file.
        read: function that returns the recordings of each test of a campaign.
        options: further keyword arguments of the class of the job; None: none.

    Returns:
        The result of each job.

    Raises:
        InputError: the kind is unknown, a campaign or recording is invalid, or `output` contains other files; nothing
            is written.
        ConvergenceError: a job has no result; the results of the other jobs are written.
        WorkerError: a worker process ends each time it works on a task.
    """
    campaigns = _require_distinct_names([load(path) for path in paths])
    measured = [read(campaign) for campaign in campaigns]
    # Imported on use: errors in files are reported before the slow imports of the fit and of SciPy.
    from calibration.fit.run_context import RunContext
    from calibration.job import JOBS, run_jobs

    job, root = JOBS.find(kind), None if output is None else Path(output)
    with open_task_executor(workers or Workers()) as tasks:
        return run_jobs([job(campaign, curves, root / campaign.name if root and len(campaigns) > 1 else root,
                             RunContext(campaign.name, tasks, progress, listen, announce), **(options or {}))
                         for campaign, curves in zip(campaigns, measured, strict=True)], root, overwrite=overwrite)


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
