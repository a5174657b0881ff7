"""Run tasks in worker processes on this machine."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from calibration.tasks.executors import Workers
from tissue_sim.bounded import pack_task, run_packed_task
from tissue_sim.errors import WorkerError
from tissue_sim.signals import child_processes_ignore_ctrl_c, ignore_ctrl_c_and_exit_with_parent

#: Environment variables that limit native libraries to one thread per worker; more threads would compete for the cores.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS",
            "NUMEXPR_NUM_THREADS")


class ProcessPool:
    """Pool of worker processes, started by the first task and restarted by the next task after a process has ended.

    If a process ends unexpectedly, the running tasks of all processes fail.

    Attributes:
        capacity: number of tasks that run at a time.
        death: type of the exception in the future of a task whose worker ended.
        most_deaths: number of worker failures during a task after which the task is given up.
    """

    death: type[BaseException] = BrokenProcessPool
    most_deaths = 3

    def __init__(self, count: int):
        self.capacity: float = count
        self._count = count
        self._executor: ProcessPoolExecutor | None = None

    def submit(self, function: Callable[..., Any], arguments: tuple) -> Future:
        """Send a task to a worker process and return its future.

        Raises:
            WorkerError: the processes end before they accept a task.
        """
        task = pack_task(function, arguments)
        if self._executor is not None:
            try:
                return self._executor.submit(run_packed_task, task)
            except BrokenProcessPool:
                self.close()
        return self._start_processes_and_wait_for_first().submit(run_packed_task, task)

    def _start_processes_and_wait_for_first(self) -> ProcessPoolExecutor:
        """Start all processes of the pool, wait until the first one works, and return their executor.

        Raises:
            WorkerError: the processes end before they accept a task.
        """
        # Spawned, not forked: Taichi and the threads of this process do not survive a fork.
        self._executor = ProcessPoolExecutor(self._count, multiprocessing.get_context("spawn"),
                                             ignore_ctrl_c_and_exit_with_parent)
        # Start all processes now: the executor would wait forever for a process that starts while another one ends, and
        # all processes must inherit the same environment.
        self._executor._safe_to_dynamically_spawn_children = False  # type: ignore[attr-defined]
        try:
            with _set_worker_start_environment():
                first = self._executor.submit(os.getpid)
            first.result()
            return self._executor
        except BrokenProcessPool as death:
            self.close()
            raise WorkerError(
                "worker processes ended before they accepted a task; in a script start them under "
                "\"if __name__ == '__main__':\". Otherwise check their printed errors, or use one worker") from death

    def abandon_tasks(self) -> None:
        """Kill the processes with their running tasks; the next task starts new processes."""
        if self._executor is not None:
            # Before Python 3.14 an executor has no method for it.
            for process in list((self._executor._processes or {}).values()):
                process.kill()
        self.close()

    def close(self) -> None:
        """End the processes after their running tasks; tasks that have not started are cancelled."""
        executor, self._executor = self._executor, None
        if executor is not None:
            executor.shutdown(wait=True, cancel_futures=True)


def open_process_pool(workers: Workers) -> ProcessPool:
    """Return a pool of ``workers.count`` processes."""
    return ProcessPool(workers.count)


@contextlib.contextmanager
def _set_worker_start_environment() -> Iterator[None]:
    """Set the environment for starting processes: one native thread, and Ctrl-C handled by the parent only."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        with child_processes_ignore_ctrl_c():
            yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
