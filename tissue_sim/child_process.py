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
def start_without_ctrl_c() -> Iterator[None]:
    """Context in which started processes ignore Ctrl-C."""
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
def start_with_one_thread() -> Iterator[None]:
    """Context in which started processes use one thread for linear algebra, unless the user sets another number.

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


def follow_parent(grace: float = 0.0, clean_up: Callable[[], None] | None = None) -> None:
    """Ignore Ctrl-C and end this process when its parent ends; to be called in a child process.

    Args:
        grace: time that the process has to end by itself after its parent, s.
        clean_up: called before the process is ended.

    Raises:
        RuntimeError: the process was not started by multiprocessing.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        raise RuntimeError("this process has no parent; call follow_parent in a process that multiprocessing started")

    def wait() -> None:
        # A parent that is killed cannot end its children. join() waits without using the interpreter.
        parent.join()
        time.sleep(grace)
        if clean_up is not None:
            clean_up()
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=wait, daemon=True).start()
