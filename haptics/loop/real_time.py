"""What an operating system can do for a loop that must not be late, and a line for each thing that it refuses."""

from __future__ import annotations

import ctypes
import gc
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

#: Among the real-time priorities 1 to 99: above every ordinary process, below the kernel's own threads.
PRIORITY = 10
#: From Linux's mman.h and prctl.h. Pages are locked as they are first used: Taichi reserves far more than it uses.
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_PR_SET_TIMERSLACK = 29


@dataclass(frozen=True)
class RealTimeFeature:
    """One thing that helps a loop to be in time.

    Attributes:
        name: ``SCHED_FIFO``, ``locked memory``, ``timer slack`` or ``no garbage collection``.
        obtained: whether it holds.
        message: where it does not: why, and how to get it.
    """

    name: str
    obtained: bool
    message: str = ""


@contextmanager
def real_time(wanted: bool = True, priority: int = PRIORITY) -> Iterator[tuple[RealTimeFeature, ...]]:
    """Ask for real time for this thread and process while inside; everything is undone at the end.

    Call it when memory is allocated and kernels are compiled. Nothing is raised where something is refused: ask the
    features.

    Args:
        wanted: False asks for nothing, and there are no features.
        priority: of SCHED_FIFO, 1 to 99.
    """
    if not wanted:
        yield ()
        return
    with ExitStack() as undo:
        features = []
        for name, claim in _FEATURES.items():
            reason = claim(undo, priority)
            features.append(RealTimeFeature(name, not reason, f"{name}: {reason}" if reason else ""))
        yield tuple(features)


def claim_fifo(undo: ExitStack, priority: int) -> str:
    """Run before every ordinary process, until `undo` is closed; returns why not."""
    if not hasattr(os, "sched_setscheduler"):
        return f"not available on {sys.platform}; ticks wait for other processes of an ordinary priority"
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        return (f"{error.strerror}; 'ulimit -r' says up to which priority this user may go: add 'USER - rtprio 20' to "
                "/etc/security/limits.d/rtprio.conf and log in again (in a container: --cap-add=SYS_NICE)")
    undo.callback(os.sched_setscheduler, 0, *before)
    return ""


def _locked_memory(undo: ExitStack, _: int) -> str:
    """Keep every page that was used in memory; returns why not."""
    if not sys.platform.startswith("linux"):
        return f"not available on {sys.platform}; a computer that runs out of memory stops the loop for a while"
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) != 0:
        return (f"{os.strerror(ctypes.get_errno())}; 'ulimit -l' says how many kB this user may lock: add 'USER - "
                "memlock unlimited' to /etc/security/limits.d/memlock.conf and log in again (in a container: "
                "--ulimit memlock=-1)")
    undo.callback(libc.munlockall)
    return ""


def _timer_slack(undo: ExitStack, _: int) -> str:
    """Wake this thread when its sleep ends, and not up to 50 us later; SCHED_FIFO brings it along. Returns why not."""
    if not sys.platform.startswith("linux"):
        return f"not available on {sys.platform}; a sleep ends as late as the system likes"
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(1), 0, 0, 0) != 0:
        return os.strerror(ctypes.get_errno())
    undo.callback(libc.prctl, _PR_SET_TIMERSLACK, ctypes.c_ulong(0), 0, 0, 0)  # 0: what the thread began with
    return ""


def _no_collection(undo: ExitStack, _: int) -> str:
    """Look for no cycles of garbage while it matters; what is there now is taken to stay. Never refused."""
    gc.collect()
    gc.freeze()
    undo.callback(gc.unfreeze)
    if gc.isenabled():
        gc.disable()
        undo.callback(gc.enable)
    return ""


#: In this order: memory is locked after the collection has cleared it.
_FEATURES: dict[str, Callable[[ExitStack, int], str]] = {
    "no garbage collection": _no_collection,
    "locked memory": _locked_memory,
    "timer slack": _timer_slack,
    "SCHED_FIFO": claim_fifo,
}
