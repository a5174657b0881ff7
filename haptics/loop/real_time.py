"""Request real-time features of the operating system for a loop, with a message for each refused feature."""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from enum import IntFlag

#: SCHED_FIFO priority (1 to 99): above all ordinary processes, below the threads of the kernel.
PRIORITY = 10
#: Set the timer slack of a thread (Linux, prctl.h).
_PR_SET_TIMERSLACK = 29


class MemoryLockFlags(IntFlag):
    """Flags of the system call ``mlockall``, which keeps pages of this process in memory (Linux, mman.h)."""

    #: Lock present pages in memory.
    CURRENT = 1
    #: Lock future pages in memory.
    FUTURE = 2
    #: Lock pages at their first use, because Taichi reserves much more memory than it uses.
    ON_FAULT = 4


@dataclass(frozen=True)
class RealTimeFeature:
    """Feature of the operating system or of Python that reduces delays of a loop.

    Attributes:
        name: ``SCHED_FIFO``, ``locked memory``, ``timer slack`` or ``no garbage collection``.
        obtained: whether the feature is active.
        message: reason and remedy if it is not active.
    """

    name: str
    obtained: bool
    message: str = ""


@contextmanager
def request_real_time_features(wanted: bool = True) -> Iterator[tuple[RealTimeFeature, ...]]:
    """Request real-time features for this thread and process inside a ``with`` block; release them at its end.

    Call it after memory is allocated and kernels are compiled. A refused feature raises no exception; the yielded
    features state it.

    Args:
        wanted: whether features are requested; if not, no features are yielded.

    Yields:
        The features, obtained or refused.
    """
    if not wanted:
        yield ()
        return
    with ExitStack() as undo:
        features = []
        for name, claim in _FEATURES.items():
            reason = claim(undo)
            features.append(RealTimeFeature(name, not reason, f"{name}: {reason}" if reason else ""))
        yield tuple(features)


def request_fifo_scheduling_and_get_refusal(undo: ExitStack) -> str:
    """Request SCHED_FIFO scheduling until `undo` is closed; return the reason of a refusal, or an empty string."""
    if not hasattr(os, "sched_setscheduler"):
        return f"not available on {sys.platform}; other processes may delay ticks"
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
    except OSError as error:
        return (f"{error.strerror}; 'ulimit -r' shows the highest allowed priority: add 'USER - rtprio 20' to "
                "/etc/security/limits.d/rtprio.conf and log in again (in a container: --cap-add=SYS_NICE)")
    undo.callback(os.sched_setscheduler, 0, *before)
    return ""


def _lock_memory_and_get_refusal(undo: ExitStack) -> str:
    """Lock used pages in memory until `undo` is closed; return the reason of a refusal, or an empty string."""
    if not sys.platform.startswith("linux"):
        return f"not available on {sys.platform}; swapping of memory may delay the loop"
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(MemoryLockFlags.CURRENT | MemoryLockFlags.FUTURE | MemoryLockFlags.ON_FAULT) != 0:
        return (f"{os.strerror(ctypes.get_errno())}; 'ulimit -l' shows how many kB may be locked: add 'USER - memlock "
                "unlimited' to /etc/security/limits.d/memlock.conf and log in again (in a container: --ulimit "
                "memlock=-1)")
    undo.callback(libc.munlockall)
    return ""


def _reduce_timer_slack_and_get_refusal(undo: ExitStack) -> str:
    """Reduce this thread's timer slack to 1 ns until `undo` is closed; return the reason of a refusal, or ``""``."""
    if not sys.platform.startswith("linux"):
        return f"not available on {sys.platform}; sleeps may end late"
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0) != 0:
        return os.strerror(ctypes.get_errno())
    undo.callback(libc.prctl, _PR_SET_TIMERSLACK, ctypes.c_ulong(0), 0, 0, 0)  # 0 restores the default of the thread
    return ""


def _disable_gc_and_get_empty_refusal(undo: ExitStack) -> str:
    """Collect garbage, then disable the collector until `undo` is closed; return ``""``: never refused."""
    gc.collect()
    gc.freeze()
    undo.callback(gc.unfreeze)
    if gc.isenabled():
        gc.disable()
        undo.callback(gc.enable)
    return ""


#: Features in the order of their requests; memory is locked after the garbage collection has freed it.
_FEATURES: dict[str, Callable[[ExitStack], str]] = {
    "no garbage collection": _disable_gc_and_get_empty_refusal,
    "locked memory": _lock_memory_and_get_refusal,
    "timer slack": _reduce_timer_slack_and_get_refusal,
    "SCHED_FIFO": request_fifo_scheduling_and_get_refusal,
}
