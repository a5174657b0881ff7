"""Ctrl-C and SIGTERM: programs finish their work in order, and child processes end with their parent."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
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


@contextlib.contextmanager
def child_processes_ignore_ctrl_c() -> Iterator[None]:
    """Context manager: child processes that are started inside ignore Ctrl-C; this process receives it afterwards."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # Blocked, not ignored: a Ctrl-C at this moment reaches this process afterwards.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def limit_threads_of_child_processes() -> Iterator[None]:
    """Context manager: child processes that are started inside use one thread for linear algebra.

    The number that the user sets in ``OPENBLAS_NUM_THREADS`` is kept.

    A loop at a real-time priority would otherwise wait for helper threads without that priority.
    """
    name = "OPENBLAS_NUM_THREADS"
    if name in os.environ:
        yield
        return
    os.environ[name] = "1"
    try:
        yield
    finally:
        os.environ.pop(name, None)


def ignore_ctrl_c_and_exit_with_parent(grace: float = 0.0, clean_up: Callable[[], None] | None = None) -> None:
    """In a child process: ignore Ctrl-C, and start a thread that ends the process when its parent process ends.

    Args:
        grace: time that the process has to end by itself after its parent, s.
        clean_up: called before the process is ended.

    Raises:
        RuntimeError: the process was not started by multiprocessing.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        raise RuntimeError(
            "ignore_ctrl_c_and_exit_with_parent must be called in a child process; this process has no parent. Start "
            "the process with multiprocessing.")

    def wait_for_parent_and_exit() -> None:
        # A parent that is killed cannot end its children. join() waits without using the interpreter.
        parent.join()
        time.sleep(grace)
        if clean_up is not None:
            clean_up()
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=wait_for_parent_and_exit, daemon=True).start()
