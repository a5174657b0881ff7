"""Jobs on campaigns: the interface of a fit, a diagnosis, a design or a plug-in, and the function that runs jobs.

`run_jobs` runs any list of jobs of one kind. It checks the output folder, reads the results of finished jobs, checks
the other jobs before it writes a file, claims the output folder, and runs the jobs. A job distributes its tasks with
`calibration.fit.run_context.RunContext`: in this process, in worker processes or on a cluster.

A run may end at any time, by Ctrl-C, by `kill` or by a power failure. Each simulation is stored as soon as it is
finished, and each file is written atomically, the file with the result last. Therefore the same call resumes: it reads
finished jobs, and repeats an unfinished job with its stored simulations.

An exception of the progress listener cancels a job in this process: running tasks of workers are abandoned, and the
exception is raised. A job in another process is cancelled by the end of this process, such as
`Executor.abandon_tasks` of a `calibration.tasks.process_pool.ProcessPool`.
"""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import cache, cached_property
from pathlib import Path
from typing import Any, ClassVar

import msgspec

from calibration.campaign.campaign import Campaign
from calibration.campaign.measured import MeasuredCurve, compute_input_and_version_digest
from calibration.effects.effect import CATALOGUE
from calibration.fit.run_context import RunContext
from calibration.forward.simulation_cache import SimulationCache, hash_content_and_source_code
from calibration.output_folder import (
    SOLVES,
    SUMMARY_FILE,
    check_output_folder,
    remove_earlier_results_and_claim_folder,
)
from tissue_sim.decode import read_json_value
from tissue_sim.errors import ConvergenceError
from tissue_sim.files import write_text
from tissue_sim.registry import Registry


class Job(ABC):
    """One computation on a campaign and its recordings, with files as the result.

    A subclass states `kind` and `result_file` and implements `run` and `decode_result`. The other methods have
    defaults; a job without a check or a summary keeps the empty ones.

    Args:
        campaign: the campaign.
        measured: recordings of each test.
        folder: folder of the results; None: the job writes no files.
        context: task executor and progress messages.

    Attributes:
        kind: name of the kind of job.
        result_file: name of the JSON file of the result. The job writes it last; the file marks the job as finished.
        stores_simulations: whether simulations are stored in the folder, so that an interrupted job resumes.
        writes_files: whether the job has a folder.
        recordings: all recordings.
        settings: name -> value of options that affect the result; they are part of `digest`.
        solves: cache of simulations.
    """

    kind: ClassVar[str]
    result_file: ClassVar[str]
    stores_simulations = True

    def __init__(self, campaign: Campaign, measured: Mapping[str, tuple[MeasuredCurve, ...]], folder: Path | None,
                 context: RunContext):
        self.campaign, self.measured, self.context = campaign, measured, context
        self.folder, self.writes_files = folder or Path(), folder is not None
        self.recordings = [curve for curves in measured.values() for curve in curves]
        self.settings: dict[str, Any] = {}
        self.solves = SimulationCache()

    @cached_property
    def digest(self) -> str:
        """Digest of all inputs on which the result depends: campaign, recordings, settings and source code."""
        return hash_content_and_source_code(
            self.kind, compute_input_and_version_digest(self.campaign, self.recordings, self.settings),
            list(self.campaign.fit.laws), sorted(CATALOGUE), _hash_calibration_source_code())

    def list_possible_files(self) -> list[Path]:
        """Return the paths of all files that the job may write, except stored simulations."""
        return [self.folder / self.result_file]

    def check_before_writing(self) -> None:  # noqa: B027 (optional: a job without a check keeps this method)
        """Check that the job can run; it must not write files.

        Stored simulations of an earlier run are available in `solves`.

        Raises:
            InputError: the job cannot run; the error states file and field.
        """

    @abstractmethod
    def run(self) -> Any:
        """Compute the result, write all files and return the result.

        Raises:
            ConvergenceError: the job has no result; `run_jobs` continues with the other jobs.
        """

    @abstractmethod
    def decode_result(self, found: Mapping[str, Any]) -> tuple[Any, Sequence[str]]:
        """Convert the content of `result_file` to the result of `run`.

        Args:
            found: content of the JSON file.

        Returns:
            The result, and the names of all files in the folder without which the job counts as unfinished.
        """

    def write_result_file(self, content: Mapping[str, Any]) -> None:
        """Write `result_file` with the digest of the job; call it after all other files are written.

        Args:
            content: result as JSON values.
        """
        text = json.dumps({**content, "work": self.digest}, indent=2, ensure_ascii=False, allow_nan=False)
        write_text(self.folder / self.result_file, text + "\n")

    def read_finished_result_or_none(self) -> Any | None:
        """Return the result of an earlier run with the same inputs; None if it is missing, incomplete or unreadable."""
        try:
            found = read_json_value(self.folder / self.result_file, f"the result of a finished {self.kind}")
            if found["work"] != self.digest:
                return None
            result, files = self.decode_result(found)
        except (OSError, ValueError, KeyError, TypeError, msgspec.ValidationError):
            return None
        return result if all((self.folder / name).is_file() for name in files) else None

    @classmethod  # noqa: B027 (optional: a job without a common table keeps this method)
    def write_summary(cls, results: Sequence[Any], path: Path) -> None:
        """Write a table of the results of several jobs; by default no table.

        Args:
            results: results of `run`, without those of failed jobs.
            path: path of the table, ``summary.csv`` in the output folder.
        """


#: Kind -> class of the job.
JOBS: Registry[type[Job]] = Registry(
    "job", "tissue_sim.calibration_jobs", {
        "fit": "calibration.campaign_fit:CampaignFit", "diagnosis": "calibration.campaign_diagnosis:CampaignDiagnosis",
        "design": "calibration.campaign_design:CampaignDesign"},
    accepts=lambda kind: isinstance(kind, type) and issubclass(kind, Job),
    expected="a class that derives from calibration.job.Job", named_by="kind")


def run_jobs(jobs: Sequence[Job], output: Path | None, *, overwrite: bool = False) -> list[Any]:
    """Run jobs of one kind, except finished jobs, whose results are read.

    All jobs are checked before a file is written. A job that does not converge does not stop the others.

    Args:
        jobs: jobs with different names of their campaigns.
        output: folder of all results; None: nothing is read or written.
        overwrite: whether finished jobs run again and results of other campaigns in `output` are replaced.

    Returns:
        Results in the order of `jobs`.

    Raises:
        InputError: a job cannot run, or `output` contains other files; nothing is written.
        ConvergenceError: a job has no result; the results of the other jobs are written.
        WorkerError: a worker process ends each time it works on a task.
    """
    if output is not None:
        # Checks of jobs may take minutes.
        check_output_folder(*_list_folder_contents(jobs, output), overwrite=overwrite)
    finished = [None if overwrite or output is None else job.read_finished_result_or_none() for job in jobs]
    for job, result in zip(jobs, finished, strict=True):
        if result is None:
            if output is not None:
                job.solves.set_read_folder(job.folder / SOLVES)
            job.check_before_writing()
    if output is not None:
        remove_earlier_results_and_claim_folder(*_list_folder_contents(jobs, output), overwrite=overwrite)
    results, failures = [], []
    for job, result in zip(jobs, finished, strict=True):
        if result is None and output is not None and job.stores_simulations:
            job.solves.write_curves_and_use_folder(job.folder / SOLVES)
        try:
            results.append(job.run() if result is None else result)
        except ConvergenceError as failure:
            failures.append(str(failure))
    if output is not None and len(jobs) > 1:
        jobs[0].write_summary(results, output / SUMMARY_FILE)
    if failures:
        raise ConvergenceError("; ".join(failures))
    return results


def _list_folder_contents(jobs: Sequence[Job], output: Path) -> tuple[
        Path, dict[str, str], list[Path], list[Path], list[Path]]:
    """Return the arguments of `check_output_folder` and `remove_earlier_results_and_claim_folder`.

    Returns:
        (output folder, name of the campaign -> digest, folders of the jobs, files that the jobs may write, inputs).
    """
    # Planned recordings have no file.
    files = {recording.file for job in jobs for recording in job.recordings if recording.file.name}
    return (output, {job.campaign.name: job.digest for job in jobs}, [job.folder for job in jobs],
            [path for job in jobs for path in job.list_possible_files()],
            [*(job.campaign.path for job in jobs), *files, *(path.with_suffix(".json") for path in files)])


@cache
def _hash_calibration_source_code() -> str:
    """Return the SHA-256 digest of source code and templates of the package `calibration`, which affect the result."""
    digest = hashlib.sha256()
    for path in sorted(path for kind in ("*.py", "*.html", "*.css") for path in Path(__file__).parent.rglob(kind)):
        digest.update(path.read_bytes())
    return digest.hexdigest()
