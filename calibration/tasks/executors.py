"""Tasks of the calibration, one after the other in this process, in parallel processes, or on a dask cluster."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from calibration.tasks.errors import WorkerError
from tissue_sim.errors import InputError

if TYPE_CHECKING:
    from calibration.tasks.dask_cluster import DaskCluster
    from calibration.tasks.process_pool import ProcessPool

#: Longest wait, s: Windows delivers Ctrl-C only to a wait that comes to an end by itself.
_LONGEST_WAIT = 0.5

OnDone = Callable[[int, Any], None]


@dataclass(frozen=True)
class Workers:
    """Who computes the tasks.

    Attributes:
        count: processes; 1: this process, one task after the other.
        dask: address of a dask scheduler such as ``tcp://127.0.0.1:8786``, or its scheduler file; None: this machine.

    Raises:
        InputError: a count below one, or a count together with a cluster.
    """

    count: int = 1
    dask: str | None = None

    def __post_init__(self):
        if self.count < 1:
            raise InputError(f"{self.count} worker processes; give a whole number from 1 up", field="workers")
        if self.dask is not None and self.count > 1:
            raise InputError("a cluster brings its own workers; give either workers or dask", field="dask")


class Tasks:
    """Where tasks run: here in this process, one after the other.

    Attributes:
        parallel: whether several may run at a time.
    """

    parallel = False

    def run(self, function: Callable[..., Any], arguments: Sequence[tuple], on_done: OnDone | None = None) -> list[Any]:
        """Call the function once for each tuple of arguments.

        The function is one that a new process can import, arguments and results are such that pickle takes them. What
        was registered in this process is known where the function runs.

        Args:
            function: called as ``function(*arguments[i])``.
            arguments: one tuple per task.
            on_done: told ``(i, result)`` in this process, in the order in which the tasks end.

        Returns:
            The results in the order of the arguments.

        Raises:
            Exception: what a task raised, as it raised it; of several the first in the order of the arguments. Tasks
                that run then are finished and told, tasks that have not begun are dropped.
            WorkerError: a task has no result because its worker died each time. All others are finished and told.
        """
        results = []
        for index, task in enumerate(arguments):
            results.append(function(*task))
            if on_done is not None:
                on_done(index, results[-1])
        return results


@contextmanager
def open_tasks(workers: Workers) -> Iterator[Tasks]:
    """Where tasks run, open until the block ends: no process of it outlives the block, nor this process.

    Raises:
        InputError: the cluster does not answer, or the package for it is missing.
    """
    if workers.dask is None and workers.count == 1:
        yield Tasks()
        return
    executor: ProcessPool | DaskCluster
    if workers.dask is not None:
        from calibration.tasks.dask_cluster import DaskCluster
        executor = DaskCluster(workers.dask)
    else:
        # Only here: a calibration in one process does without multiprocessing.
        from calibration.tasks.process_pool import ProcessPool
        executor = ProcessPool(workers.count)
    try:
        yield _ParallelTasks(executor)
    finally:
        executor.close()


class _ParallelTasks(Tasks):
    parallel = True

    def __init__(self, executor: ProcessPool | DaskCluster):
        self._executor = executor

    def run(self, function: Callable[..., Any], arguments: Sequence[tuple], on_done: OnDone | None = None) -> list[Any]:
        results: dict[int, Any] = {}
        failures: dict[int, BaseException] = {}
        try:
            self._finish(function, arguments, on_done, results, failures)
        except BaseException:
            # Ctrl-C, an error of on_done, workers that die: nobody waits for what still runs.
            self._executor.stop()
            raise
        if failures:
            raise failures[min(failures)]
        return [results[index] for index in range(len(arguments))]

    def _finish(self, function, arguments, on_done, results, failures):
        """Run until every task has its place in results or failures."""
        executor = self._executor
        waiting = deque(range(len(arguments)))
        # Tasks during which a worker died: they run alone, after all others, so that they take none of them down and
        # have the memory of the machine to themselves.
        suspects: deque[int] = deque()
        deaths: Counter[int] = Counter()
        lost: list[int] = []
        running: dict[Future, int] = {}

        def start(index: int) -> None:
            running[executor.submit(function, arguments[index])] = index

        while running or ((waiting or suspects) and not failures):
            while waiting and not failures and len(running) < executor.capacity:
                start(waiting.popleft())
            if not running:
                start(suspects.popleft())
            done, _ = wait(running, timeout=_LONGEST_WAIT, return_when=FIRST_COMPLETED)
            for future in done:
                index = running.pop(future)
                if future.cancelled():
                    raise WorkerError("the connection to the workers was lost; start them again and repeat the call, "
                                      "what is finished is kept", tasks=sorted({index, *running.values(), *waiting}))
                error = future.exception()
                if isinstance(error, executor.death):
                    deaths[index] += 1
                    (lost if deaths[index] >= executor.most_deaths else suspects).append(index)
                elif error is not None:
                    failures[index] = error
                    running = {other: place for other, place in running.items() if not other.cancel()}
                else:
                    results[index] = future.result()
                    if on_done is not None:
                        on_done(index, results[index])
        if lost and not failures:
            raise WorkerError(
                f"{len(lost)} of {len(arguments)} tasks have no result, because the process that worked on them ended "
                "each time (killed, out of memory, or for a reason that it printed); the others are done, so free "
                "memory or take fewer workers, and repeat the call", tasks=sorted(lost))
