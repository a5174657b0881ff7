"""Run tasks of a job serially in this process, in parallel processes, on a dask cluster, or with a plug-in."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol

from tissue_sim.errors import InputError, WorkerError
from tissue_sim.registry import Registry

#: Longest wait for a task, s; Windows delivers Ctrl-C only between waits.
_LONGEST_WAIT = 0.5

#: Called with the index and the result of a finished task.
OnDone = Callable[[int, Any], None]


@dataclass(frozen=True)
class Workers:
    """Selection of the workers that run tasks: local processes, a dask cluster, or the executor of a plug-in.

    Attributes:
        count: number of workers; 1 without an executor: tasks run serially in this process.
        dask: address of a dask scheduler such as ``tcp://127.0.0.1:8786``, or its scheduler file; None: this machine.
        executor: name in `EXECUTORS`; None: ``"dask"`` with an address, otherwise ``"processes"``.

    Raises:
        InputError: `count` is below 1, `dask` is stated with `count` or another executor, or the executor is unknown.
    """

    count: int = 1
    dask: str | None = None
    executor: str | None = None

    def __post_init__(self):
        if self.count < 1:
            raise InputError(f"workers must be at least 1; got {self.count}", field="workers")
        if self.dask is not None and self.count > 1:
            raise InputError("dask and workers exclude each other, because a cluster has its own workers; state one of "
                             "them", field="dask")
        if self.dask is not None and self.executor not in (None, "dask"):
            raise InputError(f"dask requires the executor 'dask' or none; got {self.executor!r}. State one of them",
                             field="dask")
        if self.executor is not None:
            EXECUTORS.find(self.executor, field="executor")


class Executor(Protocol):
    """Workers that run single tasks; `open_task_executor` distributes the tasks of a job to them.

    Attributes:
        capacity: number of tasks that are submitted at a time; `math.inf` for a queue of any length.
        death: type of the exception in the future of a task whose worker ended.
        most_deaths: number of worker failures during a task after which the task is given up.
    """

    capacity: float
    death: type[BaseException]
    most_deaths: int

    def submit(self, function: Callable[..., Any], arguments: tuple) -> Future:
        """Start ``function(*arguments)`` and return its future.

        An executor in other processes sends ``tissue_sim.bounded.pack_task(function, arguments)`` and calls
        ``run_packed_task`` there, so that plug-ins are registered in the workers too.
        """

    def abandon_tasks(self) -> None:
        """Discard all tasks and their results, if possible at once; new tasks can be submitted afterwards."""

    def close(self) -> None:
        """End the workers that this executor has started."""


#: Name -> function that opens the executor for a selection of workers.
EXECUTORS: Registry[Callable[[Workers], Executor]] = Registry(
    "executor", "tissue_sim.executors", {"processes": "calibration.tasks.process_pool:open_process_pool",
                                         "dask": "calibration.tasks.dask_cluster:connect_to_dask_cluster"},
    accepts=callable, expected="a function of calibration.Workers that returns an Executor", is_used_in_tasks=False)


class TaskExecutor:
    """Executor that runs tasks serially in this process.

    Attributes:
        parallel: whether several tasks run at a time.
    """

    parallel = False

    def run(self, function: Callable[..., Any], arguments: Sequence[tuple], on_done: OnDone | None = None) -> list[Any]:
        """Call the function once for each tuple of arguments; here one call after the other in this process.

        Subclasses call it in other processes. The function must be importable in a new process; arguments and results
        must be picklable. Plug-ins registered in this process are also registered where the function runs.

        Args:
            function: called as ``function(*arguments[i])``.
            arguments: one tuple per task.
            on_done: called as ``on_done(i, result)`` in this process, in the order in which the tasks finish.

        Returns:
            The results in the order of the arguments.

        Raises:
            Exception: the exception of a task; of several the first in the order of the arguments. Running tasks are
                finished and reported to `on_done`, other tasks are cancelled.
            WorkerError: the worker of a task ended in each attempt. All other tasks are finished and reported.
        """
        results = []
        for index, task in enumerate(arguments):
            results.append(function(*task))
            if on_done is not None:
                on_done(index, results[-1])
        return results


@contextmanager
def open_task_executor(workers: Workers) -> Iterator[TaskExecutor]:
    """Yield an executor for tasks; all its processes end with the ``with`` block or with this process.

    Raises:
        InputError: the cluster does not answer, or its package is missing.
    """
    if workers.executor is None and workers.dask is None and workers.count == 1:
        yield TaskExecutor()
        return
    name = workers.executor or ("processes" if workers.dask is None else "dask")
    executor = EXECUTORS[name](workers)
    try:
        yield _ParallelTaskExecutor(executor)
    finally:
        executor.close()


class _ParallelTaskExecutor(TaskExecutor):
    """Executor that distributes tasks to parallel workers."""

    parallel = True

    def __init__(self, executor: Executor):
        self._executor = executor

    def run(self, function: Callable[..., Any], arguments: Sequence[tuple], on_done: OnDone | None = None) -> list[Any]:
        """Call the function once for each tuple of arguments, in parallel; see `TaskExecutor.run`."""
        results: dict[int, Any] = {}
        failures: dict[int, BaseException] = {}
        try:
            self._run_and_collect_until_first_failure(function, arguments, on_done, results, failures)
        except BaseException:
            # Ctrl-C, an error of on_done, or failed workers: running tasks are abandoned.
            self._executor.abandon_tasks()
            raise
        if failures:
            raise failures[min(failures)]
        return [results[index] for index in range(len(arguments))]

    def _run_and_collect_until_first_failure(self, function, arguments, on_done, results, failures):
        """Run the tasks until all are finished or one raises an exception; store the exception and start no more tasks.

        Args:
            function: called as ``function(*arguments[i])``.
            arguments: one tuple per task.
            on_done: called as ``on_done(i, result)`` after each finished task; may be None.
            results: receives index -> result.
            failures: receives index -> exception.

        Raises:
            WorkerError: a task ended its process in each attempt, or the connection to the workers was lost.
        """
        executor = self._executor
        waiting = deque(range(len(arguments)))
        # Tasks whose worker ended run again alone after all others, so that they have the whole memory and a failure
        # affects no other task.
        suspects: deque[int] = deque()
        deaths: Counter[int] = Counter()
        lost: list[int] = []
        running: dict[Future, int] = {}

        def submit_task(index: int) -> None:
            """Submit the task with this index to the workers."""
            running[executor.submit(function, arguments[index])] = index

        while running or ((waiting or suspects) and not failures):
            while waiting and not failures and len(running) < executor.capacity:
                submit_task(waiting.popleft())
            if not running:
                submit_task(suspects.popleft())
            done, _ = wait(running, timeout=_LONGEST_WAIT, return_when=FIRST_COMPLETED)
            for future in done:
                index = running.pop(future)
                if future.cancelled():
                    raise WorkerError("the connection to the workers was lost; start the workers again and repeat the "
                                      "call, which continues with the stored results",
                                      tasks=sorted({index, *running.values(), *waiting}))
                error = future.exception()
                if isinstance(error, executor.death):
                    deaths[index] += 1
                    (lost if deaths[index] >= executor.most_deaths else suspects).append(index)
                elif error is not None:
                    failures[index] = error
                    running = {other: number for other, number in running.items() if not other.cancel()}
                else:
                    results[index] = future.result()
                    if on_done is not None:
                        on_done(index, results[index])
        if lost and not failures:
            raise WorkerError(
                f"{len(lost)} of {len(arguments)} tasks have no result, because their process ended in each attempt "
                "(killed, out of memory, or for a reason that it printed); the other tasks are finished. Free memory "
                "or use fewer workers, and repeat the call", tasks=sorted(lost))
