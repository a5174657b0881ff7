"""What processes that this program starts have in common: Ctrl-C is their parent's, and they end when it does."""

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
    """A process that starts inside takes no part in Ctrl-C."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    # Blocked, not ignored: a Ctrl-C in this moment reaches this process afterwards.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def start_with_one_thread() -> Iterator[None]:
    """Linear algebra in a process that starts inside takes one thread, unless the user says otherwise: a loop at a
    real-time priority would wait for helpers that have none."""
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
    """Called in the new process: leave Ctrl-C to the parent, and end when that is gone.

    Args:
        grace: how long this process has then to end by itself, s.
        clean_up: called before the process is ended.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        raise RuntimeError("this process has no parent; call follow_parent in a process that multiprocessing started")

    def wait() -> None:
        # A parent that is killed cannot end its children; this waits without taking a turn of the interpreter.
        parent.join()
        time.sleep(grace)
        if clean_up is not None:
            clean_up()
        os._exit(1)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=wait, daemon=True).start()
