"""The calibration, whole: campaign files in; material files, tables and a report out."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import tissue_sim
from calibration.campaign.campaign import Campaign, load_campaign
from calibration.fit.fit import Iteration
from calibration.fit.result import CalibrationResult, read_back
from calibration.report.output_folder import SUMMARY_FILE, claim
from calibration.tasks.executors import Tasks, Workers, open_tasks
from tissue_sim.errors import ConvergenceError, InputError

#: Told what is done now, and how many of its tasks are done, and of how many.
Progress = Callable[..., None]
#: Told the campaign, the law and each solve of an inverse fit.
IterationListener = Callable[[str, str, Iteration], None]


@dataclass(frozen=True)
class Context:
    """What the work on a campaign is done with.

    Attributes:
        tasks: where its parts run. say: called with a sentence before each part, and with the number of its tasks that
            are done and of all. listen: told every solve.
        figures: whether reports get their pictures.
    """

    tasks: Tasks
    say: Progress = lambda sentence, done=0, of=0: None
    listen: IterationListener = lambda campaign, law, iteration: None
    figures: bool = True


class Recorded(Protocol):
    """A recording that a calibration reads."""

    name: str
    file: Path
    sha256: str


class Work(Protocol):
    """A campaign that has been read.

    Attributes:
        campaign: what is asked. recordings: what it reads. extra: digests of the other files that it reads.
    """

    campaign: Campaign
    recordings: Sequence[Recorded]
    extra: Sequence[str]

    def check(self, folder: Path, context: Context) -> None:
        """Refuse what cannot be fitted, before anything is written; not asked of work that is finished.

        Args:
            folder: what an earlier run of the same work kept may be read there. context: to say what is done.

        Raises:
            InputError: with file and field.
        """

    def run(self, folder: Path, work: str, context: Context) -> CalibrationResult:
        """Fit, and write everything into the folder; ``fit.json`` last, because it says that the work is finished."""


def calibrate(paths: Sequence[str | Path], output: str | Path, *, overwrite: bool = False,
              progress: Progress | None = None, listen: IterationListener | None = None,
              figures: bool = True, workers: Workers | None = None) -> list[CalibrationResult]:
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
        progress: called with a sentence before each part of the work, how many of its tasks are done, and of how many
            (0 and 0 where it has none).
        listen: called with the campaign, the law and each solve of an inverse fit.
        figures: whether the report gets its pictures.
        workers: who computes the parts of inverse fits; None: this process.

    Raises:
        InputError: anything wrong in a campaign or a recording, or `output` holds something else; nothing is written.
        ConvergenceError: no law of a campaign could be fitted; those of the other campaigns are written.
        WorkerError: a worker process dies each time that it is given a part.
    """
    output = Path(output)
    campaigns = [load_campaign(path) for path in paths]
    if not campaigns:
        raise InputError("give at least one campaign file")
    for i, campaign in enumerate(campaigns):
        if any(other.name == campaign.name for other in campaigns[:i]):
            raise InputError(f"two campaign files are called {campaign.name!r}; results go into a folder of that name, "
                             "so rename one", file=campaign.path)
    with open_tasks(workers or Workers()) as tasks:
        quiet = Context(tasks, figures=figures)
        context = Context(tasks, progress or quiet.say, listen or quiet.listen, figures)
        prepared = [_prepare(campaign) for campaign in campaigns]
        works = {item.campaign.name: _digest(item) for item in prepared}
        folders = {campaign.name: output / campaign.name if len(campaigns) > 1 else output for campaign in campaigns}
        finished = {campaign.name: None if overwrite else
                    read_back(campaign, folders[campaign.name], works[campaign.name]) for campaign in campaigns}
        for item in prepared:
            if finished[item.campaign.name] is None:
                item.check(folders[item.campaign.name], context)
        claim(output, folders, campaigns, [r for item in prepared for r in item.recordings], works, overwrite)
        results, failures = [], []
        for item in prepared:
            name = item.campaign.name
            try:
                results.append(finished[name] or item.run(folders[name], works[name], context))
            except ConvergenceError as failure:
                # The others are not to wait for it.
                failures.append(str(failure))
    if len(campaigns) > 1:
        # Here, so that importing calibration draws nothing in.
        from calibration.analytical.outputs import write_summary

        write_summary(results, output / SUMMARY_FILE)
    if failures:
        raise ConvergenceError("; ".join(failures))
    return results


def _prepare(campaign: Campaign) -> Work:
    if campaign.fit.method == "inverse_fem":
        from calibration.fit.work import InverseWork

        return InverseWork(campaign)
    from calibration.analytical.analytical import AnalyticalWork

    return AnalyticalWork(campaign)


def _digest(work: Work) -> str:
    content = [work.campaign.sha256, *(f"{r.name} {r.sha256}" for r in work.recordings), *work.extra,
               tissue_sim.__version__]
    return hashlib.sha256("\n".join(content).encode()).hexdigest()
