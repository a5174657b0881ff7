"""Errors of worker processes."""

from __future__ import annotations

from collections.abc import Sequence


class WorkerError(RuntimeError):
    """Worker processes ended without a result: they were killed, ran out of memory, or could not start.

    Attributes:
        tasks: indices of the tasks without a result.
    """

    def __init__(self, message: str, *, tasks: Sequence[int] = ()):
        super().__init__(message)
        self.tasks = tuple(tasks)
