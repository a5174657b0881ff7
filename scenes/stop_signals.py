"""Handlers of Ctrl-C and SIGTERM for programs that must finish their work in order."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any


@contextmanager
def call_stop_at_signals(stop: Callable[[], None], *, ignore_repeats: bool = False) -> Iterator[None]:
    """Call `stop` at Ctrl-C (SIGINT) and SIGTERM inside the block, and restore the previous handlers after it.

    By default the second signal has its usual effect, so that a program that hangs can still be ended.

    Args:
        stop: called in the main thread.
        ignore_repeats: call `stop` at every further signal too, and at SIGHUP (end of the session) where the platform
            has it. For programs that must bring a machine, such as a motor, to rest before they end.
    """
    previous: dict[int, Any] = {}

    def call_stop_and_restore_previous_handler(number: int, _: Any) -> None:
        """Call `stop`; unless `ignore_repeats`, restore the previous handler of this signal."""
        stop()
        if not ignore_repeats:
            signal.signal(number, previous[number])

    hang_up = [signal.SIGHUP] if ignore_repeats and hasattr(signal, "SIGHUP") else []
    for number in (signal.SIGINT, signal.SIGTERM, *hang_up):
        previous[number] = signal.signal(number, call_stop_and_restore_previous_handler)
    try:
        yield
    finally:
        for each, handler in previous.items():
            signal.signal(each, handler)
