"""What goes wrong with workers."""

from __future__ import annotations

from collections.abc import Sequence


class WorkerError(RuntimeError):
    """Worker processes end before they answer: killed, out of memory, or not able to start.

    Attributes:
        tasks: indices of the tasks that have no result.
    """

    def __init__(self, message: str, *, tasks: Sequence[int] = ()):
        super().__init__(message)
        self.tasks = tuple(tasks)
