"""Ctrl-C and SIGTERM as a wish to end, for programs that have something to finish."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def stopped_by_signals(stop: Callable[[], None], *, patient: bool = False) -> Iterator[None]:
    """Ctrl-C and SIGTERM call `stop`; a second one does what it always does.

    Args:
        stop: called in the main thread.
        patient: whatever ends first must be ended in order, such as a motor: the end of the session counts, too, and
            further signals are no other wish.
    """
    before: dict[int, Any] = {}

    def stop_once(number: int, _: Any) -> None:
        stop()
        if not patient:
            signal.signal(number, before[number])

    hang_up = [signal.SIGHUP] if patient and hasattr(signal, "SIGHUP") else []
    for number in (signal.SIGINT, signal.SIGTERM, *hang_up):
        before[number] = signal.signal(number, stop_once)
    try:
        yield
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)
