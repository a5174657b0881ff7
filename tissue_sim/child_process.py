"""Child processes: Ctrl-C is handled by the parent, and children end when the parent ends."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator


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
