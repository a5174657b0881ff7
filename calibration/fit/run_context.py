"""Execution of a campaign's computations: workers, progress messages, and a listener for the iterations of a fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from calibration.fit.fit import DescentEvaluation
from calibration.tasks.executors import OnDone, TaskExecutor

#: Function that receives a progress message and, optionally, the number of completed tasks and of all tasks.
Progress = Callable[..., None]
#: Function that receives the name of the campaign, the law and an iteration of an inverse fit.
IterationListener = Callable[[str, str, DescentEvaluation], None]


@dataclass(frozen=True)
class RunContext:
    """Workers and listeners for the computations of one campaign.

    Attributes:
        campaign: name of the campaign.
        tasks: executor that runs the tasks.
        progress: function that receives progress messages; None: no messages.
        listen: function that receives each iteration of an inverse fit; None: no listener.
        announce: function that receives the expected duration before a diagnosis begins; None: no announcement.
    """

    campaign: str
    tasks: TaskExecutor
    progress: Progress | None = None
    listen: IterationListener | None = None
    announce: Callable[[str], None] | None = None

    def report_progress(self, sentence: str, *counts: int) -> None:
        """Send a progress message.

        Args:
            sentence: description of the current computation.
            counts: number of completed tasks and number of all tasks; may be omitted.
        """
        if self.progress is not None:
            self.progress(f"{self.campaign}: {sentence}", *counts)

    def run_descents(self, function: Callable, laws: Sequence[str], arguments: Sequence[tuple], what: str) -> list:
        """Run descents as `run_task_for_all` does, and send their iterations to the listener.

        In this process the iterations are sent while a descent runs; from worker processes, when a descent has ended.

        Args:
            function: function that returns an object with the attribute ``history``.
            laws: law of each task.
            arguments: arguments of each task.
            what: description for progress messages.
        """
        def send_iteration(law: str, iteration: DescentEvaluation) -> None:
            """Send an iteration of a descent to the listener, if there is one."""
            if self.listen is not None:
                self.listen(self.campaign, law, iteration)

        if not self.tasks.parallel:
            # A listener cannot be sent to another process.
            arguments = [(*given, partial(send_iteration, law)) for law, given in zip(laws, arguments, strict=True)]
            return self.run_task_for_all(function, arguments, what)

        def send_history(index: int, answer: Any) -> None:
            """Send all iterations of a finished descent to the listener."""
            for iteration in answer.history:
                send_iteration(laws[index], iteration)

        return self.run_task_for_all(function, arguments, what, send_history)

    def run_task_for_all(self, function: Callable, arguments: Sequence[tuple], what: str,
                         on_done: OnDone | None = None, names: Sequence[str] = ()) -> list:
        """Run a task for each set of arguments, with progress messages.

        Args:
            function: function of the tasks.
            arguments: arguments of each task.
            what: description for progress messages.
            on_done: function that receives index and result of each completed task.
            names: names of the tasks for progress messages of sequential execution.

        Returns:
            Results in the order of `arguments`.
        """
        done: list[int] = []

        def report_task_state() -> None:
            """Send the number of finished tasks and, in sequential execution, the name of the current task."""
            running = len(done) < len(names) and not self.tasks.parallel
            self.report_progress(f"{what}: {names[len(done)]}" if running else what, len(done), len(arguments))

        def finish_task(index: int, answer: Any) -> None:
            """Pass a result to `on_done`, count the task as finished and report the progress."""
            if on_done is not None:
                on_done(index, answer)
            done.append(index)
            report_task_state()

        report_task_state()
        return self.tasks.run(function, arguments, finish_task)
