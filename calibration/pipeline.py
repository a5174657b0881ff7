"""Calibration, diagnosis and design, whole: campaign files in; material files, tables and reports out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from calibration.campaign.campaign import load_campaign
from calibration.campaign.measured import read_measured
from calibration.campaign.planned import REPLICATES, SAMPLES, read_planned
from calibration.output_folder import PICTURE_FORMATS, SUMMARY_FILE, claim, pictures_written, result_files
from calibration.tasks.executors import Workers, open_tasks
from tissue_sim.errors import ConvergenceError, InputError

if TYPE_CHECKING:
    from calibration.campaign.campaign import Campaign
    from calibration.diagnosis.design import Design
    from calibration.diagnosis.result import DiagnosisResult
    from calibration.fit.result import CalibrationResult
    from calibration.fit.run_context import IterationListener, Progress


def calibrate(paths: Sequence[str | Path], output: str | Path, *, overwrite: bool = False,
              progress: Progress | None = None, listen: IterationListener | None = None,
              figures: bool = True, figures_format: str | None = None,
              workers: Workers | None = None) -> list[CalibrationResult]:
    """Fit every law of every campaign and write the results.

    ``LAW.material.json``, ``fit.json``, ``report.html``, ``curves.csv`` and ``residuals.csv`` go into `output`, or into
    one subfolder a campaign, named by its file's stem, with a ``summary.csv`` beside them when there are several. A
    campaign that is finished in `output` is read back instead of computed; of one that is not, the simulations that
    were done are found in its folder ``solves``. ``work.json`` lists what was written; files that it does not list are
    never removed or replaced.

    Args:
        paths: campaign files.
        output: folder, created where missing.
        overwrite: replace the results of other work in `output`.
        progress: called with a sentence before each part, how many of its tasks are done, and of how many (0 and 0
            where it has none).
        listen: called with the campaign, the law and each solve of an inverse fit.
        figures: whether the report gets its pictures.
        figures_format: ``svg``, ``pdf`` or ``png``: each picture is also a file beside the report; None: no files.
        workers: who computes the parts of inverse fits; None: this process.

    Raises:
        InputError: anything wrong in a campaign or a recording, or `output` holds something else; nothing is written.
        ConvergenceError: no law of a campaign could be fitted; those of the other campaigns are written.
        WorkerError: a worker process dies each time that it is given a part.
    """
    output = Path(output)
    _check_format(figures_format)
    campaigns = _distinct([load_campaign(path) for path in paths])
    measured = [read_measured(campaign) for campaign in campaigns]
    # On use: what is wrong in a file is said at once, before the fit and all of scipy are there.
    from calibration.campaign_fit import CampaignFit
    from calibration.fit.result import read_back
    from calibration.fit.run_context import RunContext
    from calibration.report.outputs import write_summary

    with open_tasks(workers or Workers()) as tasks:
        fits = [CampaignFit(campaign, curves, output / campaign.name if len(campaigns) > 1 else output,
                            RunContext(campaign.name, tasks, progress, listen))
                for campaign, curves in zip(campaigns, measured, strict=True)]
        results, failures = _run(fits, output, read_back, overwrite, figures, figures_format)
    if len(campaigns) > 1:
        write_summary(results, output / SUMMARY_FILE)
    if failures:
        raise ConvergenceError("; ".join(failures))
    return results


def diagnose(paths: Sequence[str | Path], output: str | Path, *, overwrite: bool = False,
             progress: Progress | None = None, figures: bool = True, figures_format: str | None = None,
             workers: Workers | None = None, law: str | None = None,
             announce: Callable[[str], None] | None = None) -> list[DiagnosisResult]:
    """Find what a plain model misses in every campaign, name it, and write the results.

    ``diagnosis.json``, ``report.html``, ``residuals.csv`` and the files that carry what was found go into `output`, or
    into one subfolder a campaign, named by its file's stem. Folders are resumed as those of `calibrate` are.

    Args:
        paths: campaign files, of ``method = "inverse_fem"``. law: one of each campaign; None: its first.
        output, overwrite, progress, figures, figures_format, workers: as in `calibrate`.
        announce: called with how long to expect, where tests in space make it a minute or more.

    Raises:
        InputError: anything wrong in a campaign or a recording, or `output` holds something else; nothing is written.
        ConvergenceError: a campaign could not be fitted; the others are written.
        WorkerError: a worker process dies each time that it is given a part.
    """
    output = Path(output)
    _check_format(figures_format)
    from calibration.diagnosis.evidence import whole_campaign

    campaigns = _distinct([whole_campaign(load_campaign(path), law) for path in paths])
    measured = [read_measured(campaign) for campaign in campaigns]
    from calibration.campaign_diagnosis import CampaignDiagnosis
    from calibration.diagnosis.result import read_diagnosis
    from calibration.fit.run_context import RunContext
    from calibration.report.diagnosis_outputs import files_of_diagnosis

    with open_tasks(workers or Workers()) as tasks:
        parts = [CampaignDiagnosis(campaign, curves, output / campaign.name if len(campaigns) > 1 else output,
                                   RunContext(campaign.name, tasks, progress, announce=announce))
                 for campaign, curves in zip(campaigns, measured, strict=True)]
        results, failures = _run(parts, output, read_diagnosis, overwrite, figures, figures_format, files_of_diagnosis)
    if failures:
        raise ConvergenceError("; ".join(failures))
    return results


def _run(parts: Sequence[Any], output: Path, read_back: Callable[..., Any], overwrite: bool, figures: bool,
         figures_format: str | None, files_of: Callable[..., list[Path]] = result_files) -> tuple[list[Any], list[str]]:
    """Results of campaigns that have been read, and why others have none; what is finished is read back.

    Args:
        parts: `CampaignFit` or `CampaignDiagnosis`, one a campaign. read_back: finished result of a campaign, or None.
        files_of: every file that may be written for a campaign.
    """
    finished = [None if overwrite or not (figures_format is None or pictures_written(
        part.campaign, part.folder, figures_format)) else read_back(part.campaign, part.folder, part.digest)
        for part in parts]
    for part, result in zip(parts, finished, strict=True):
        if result is None:
            part.check()
    claim(output, {part.campaign.name: part.folder for part in parts}, [part.campaign for part in parts],
          [recording for part in parts for recording in part.recordings],
          {part.campaign.name: part.digest for part in parts}, overwrite, files_of)
    results, failures = [], []
    for part, result in zip(parts, finished, strict=True):
        try:
            results.append(result or part.run(figures=figures, figures_format=figures_format))
        except ConvergenceError as failure:
            # The others are not to wait for it.
            failures.append(str(failure))
    return results, failures


def design_experiments(path: str | Path, *, law: str | None = None, replicates: int = REPLICATES,
                       samples: int = SAMPLES, workers: Workers | None = None,
                       progress: Progress | None = None) -> Design:
    """What the experiments of a campaign could tell, before any of them is done; nothing is written.

    Its tests state a ``protocol`` in place of recordings, ``[noise]`` the force sensor's, and ``start`` a material to
    expect. A test that has recordings counts with these.

    Args:
        path: of the campaign file, of ``method = "inverse_fem"``. law: one of its laws; None: its first.
        replicates, samples: recordings of a planned test, and samples of each, evenly in time.
        workers, progress: as in `calibrate`.

    Raises:
        InputError: anything wrong in the campaign, a protocol that is none or deeper than the specimen, no noise or no
            start stated, no recording or too few samples.
        WorkerError: a worker process dies each time that it is given a part.
    """
    from calibration.diagnosis.evidence import whole_campaign

    campaign = whole_campaign(load_campaign(path, planned=True), law)
    measured = read_planned(campaign, replicates, samples)
    from calibration.diagnosis.design import design
    from calibration.fit.run_context import RunContext

    with open_tasks(workers or Workers()) as tasks:
        return design(campaign, measured, RunContext(campaign.name, tasks, progress))


def _check_format(figures_format: str | None) -> None:
    if figures_format not in (None, *PICTURE_FORMATS):
        raise InputError(f"pictures are written as {', '.join(PICTURE_FORMATS)}, not as {figures_format!r}",
                         field="figures_format")


def _distinct(campaigns: list[Campaign]) -> list[Campaign]:
    """The campaigns, which must be some, of different names."""
    if not campaigns:
        raise InputError("give at least one campaign file")
    for i, campaign in enumerate(campaigns):
        if any(other.name == campaign.name for other in campaigns[:i]):
            raise InputError(f"two campaign files are called {campaign.name!r}; results go into a folder of that name, "
                             "so rename one", file=campaign.path)
    return campaigns
