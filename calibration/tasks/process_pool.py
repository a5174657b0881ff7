"""Worker processes on this machine."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from typing import Any

from calibration.tasks.errors import WorkerError
from tissue_sim.child_process import follow_parent, start_without_ctrl_c
from tissue_sim.packing import pack, run_packed

#: One thread per worker: native libraries that each take every core slow each other down.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS",
            "NUMEXPR_NUM_THREADS")


class ProcessPool:
    """Processes that are started by the first task, and again by the next one after some have died.

    A process that dies takes the tasks with it that run in the others at that moment.

    Attributes:
        capacity: tasks that it takes at a time. death: what the future of a task holds when its worker died.
        most_deaths: of workers during one task, after which it is given up.
    """

    death = BrokenProcessPool
    most_deaths = 3

    def __init__(self, count: int):
        self.capacity = count
        self._executor: ProcessPoolExecutor | None = None

    def submit(self, function: Callable[..., Any], arguments: tuple) -> Future:
        """Start a task.

        Raises:
            WorkerError: processes end before they can take a task.
        """
        task = pack(function, arguments)
        if self._executor is not None:
            try:
                return self._executor.submit(run_packed, task)
            except BrokenProcessPool:
                self.close()
        return self._start().submit(run_packed, task)

    def _start(self) -> ProcessPoolExecutor:
        # Spawned, not forked: Taichi and the threads of this process do not survive a fork.
        self._executor = ProcessPoolExecutor(self.capacity, multiprocessing.get_context("spawn"), follow_parent)
        # All processes now and none later: one that starts while another dies is neither ended nor noticed, and the
        # executor waits for it for ever; and all have to start under the same conditions.
        self._executor._safe_to_dynamically_spawn_children = False  # type: ignore[attr-defined]
        try:
            with _start_conditions():
                first = self._executor.submit(os.getpid)
            first.result()
            return self._executor
        except BrokenProcessPool as death:
            self.close()
            raise WorkerError(
                "worker processes end before they take a task; a script that starts them must do so under "
                "\"if __name__ == '__main__':\", otherwise see what they printed, or use one worker") from death

    def stop(self) -> None:
        """Kill the processes; the next task starts new ones."""
        if self._executor is not None:
            # Before Python 3.14 an executor has no method for it.
            for process in list((self._executor._processes or {}).values()):
                process.kill()
        self.close()

    def close(self) -> None:
        """Let the processes end; waits for the tasks that run."""
        executor, self._executor = self._executor, None
        if executor is not None:
            executor.shutdown(wait=True, cancel_futures=True)


@contextlib.contextmanager
def _start_conditions() -> Iterator[None]:
    """What a process inherits when it starts: one native thread, and no part in Ctrl-C, which its parent handles."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        with start_without_ctrl_c():
            yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
