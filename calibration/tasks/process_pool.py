"""Worker processes on this machine."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.context import SpawnContext
from typing import Any

from calibration.tasks.executors import WorkerError
from tissue_sim.child_process import follow_parent, start_without_ctrl_c

#: One thread per worker: native libraries that each take every core slow each other down.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS",
            "NUMEXPR_NUM_THREADS")
_FALSE_STARTS = 3


class ProcessPool:
    """Worker processes, each an executor of its own: one that dies takes its own task with it and no other."""

    death = BrokenProcessPool
    deaths_in_a_row = 3

    def __init__(self, count: int):
        self.capacity = count
        self._workers: list[_Worker] = []
        self._false_starts = 0

    def submit(self, function: Callable[..., Any], arguments: tuple) -> Future:
        """Start a task on a free worker; there is one while fewer tasks run than the capacity.

        Raises:
            WorkerError: processes end before they can take a task.
        """
        while True:
            worker = next((worker for worker in self._workers if worker.free), None)
            if worker is None:
                worker = _Worker()
                self._workers.append(worker)
            try:
                return worker.submit(function, arguments)
            except BrokenProcessPool as death:
                self._workers.remove(worker)
                worker.close()
                self._false_starts = 0 if worker.began else self._false_starts + 1
                if self._false_starts == _FALSE_STARTS:
                    raise WorkerError(
                        "worker processes end before they take a task; a script that starts them must do so under "
                        "\"if __name__ == '__main__':\", otherwise see what they printed, or use one worker") from death

    def stop(self) -> None:
        """Kill the workers; the next task starts new ones."""
        for worker in self._workers:
            worker.kill()
        self.close()

    def close(self) -> None:
        """Let the workers end; waits for the tasks that run."""
        while self._workers:
            self._workers[-1].close()
            self._workers.pop()


class _Worker:
    """One process, started by its first task."""

    def __init__(self):
        self._context = _RememberingContext()
        # Spawned, not forked: Taichi and the threads of this process do not survive a fork.
        self._executor = ProcessPoolExecutor(1, mp_context=self._context)
        self._ready: Future | None = None
        self._task: Future | None = None

    @property
    def free(self) -> bool:
        return self._task is None or self._task.done()

    @property
    def began(self) -> bool:
        return self._ready is not None and self._ready.done() and self._ready.exception() is None

    def submit(self, function: Callable[..., Any], arguments: tuple) -> Future:
        with _start_conditions():
            if self._ready is None:
                self._ready = self._executor.submit(follow_parent)
            self._task = self._executor.submit(function, *arguments)
        return self._task

    def kill(self) -> None:
        for process in self._context.processes:
            process.kill()

    def close(self) -> None:
        self._executor.shutdown(wait=True, cancel_futures=True)


class _RememberingContext(SpawnContext):
    """The spawn context with its processes at hand: before Python 3.14 no executor kills its own."""

    def __init__(self):
        super().__init__()
        self.processes: list[multiprocessing.process.BaseProcess] = []

    def Process(self, *args, **kwargs):
        process = super().Process(*args, **kwargs)
        self.processes.append(process)
        return process


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
