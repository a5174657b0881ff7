"""Ctrl-C and SIGTERM as a wish to end, for programs that have something to finish."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def stopped_by_signals(stop: Callable[[], None]) -> Iterator[None]:
    """Ctrl-C and SIGTERM call `stop`; a second one does what it always does."""
    before: dict[int, Any] = {}

    def stop_once(number: int, _: Any) -> None:
        stop()
        signal.signal(number, before[number])

    for number in (signal.SIGINT, signal.SIGTERM):
        before[number] = signal.signal(number, stop_once)
    try:
        yield
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)
