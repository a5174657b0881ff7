"""Functions for test_executors.py, which a worker process imports by name: it cannot import the test module."""

import os
import signal
from pathlib import Path

from waiting import wait_until

from tissue_sim.errors import ConvergenceError, InputError


def add(left, right):
    return left + right


def environment(*names):
    return {name: os.environ.get(name) for name in names}


def meet(folder, *names):
    """Variables of this process, once a second process works in parallel."""
    Path(folder, str(os.getpid())).touch()
    wait_until(lambda: len(list(Path(folder).iterdir())) >= 2)
    return environment(*names)


def die():
    # SIGTERM ends a process at once too, and exists on every platform.
    os.kill(os.getpid(), getattr(signal, "SIGKILL", signal.SIGTERM))


def die_first(marker, value):
    """Kill this process, unless the marker says that it happened before."""
    marker = Path(marker)
    if not marker.exists():
        marker.touch()
        die()
    return value


def log_then(log, name, fatal):
    """A line in a log, then the end of this process or the name."""
    with Path(log).open("a") as stream:
        stream.write(f"{name}\n")
    if fatal:
        die()
    return name


def refuse(kind, marker=None):
    if marker is not None:
        Path(marker).touch()
    if kind == "input":
        raise InputError("is not positive", file="a.toml", line=3, field="test[0].radius")
    if kind == "convergence":
        raise ConvergenceError("stopped", depth=0.004)
    return kind


def wait_for(marker, value):
    """The value, once the marker is there."""
    wait_until(Path(marker).exists)
    return value


def call(function, *arguments):
    return function(*arguments)


def nested(pair):
    return pair[0], pair[1]


def interrupted(value):
    """The value, in spite of a Ctrl-C."""
    signal.raise_signal(signal.SIGINT)
    return value


def hold(folder):
    """Report the process number, then wait until the process is terminated."""
    Path(folder, str(os.getpid())).touch()
    wait_for(Path(folder, "never"), None)


if __name__ == "__main__":
    # A program of two workers that hold on, for Ctrl-C.
    import sys

    from calibration.tasks.executors import Workers, open_task_executor

    # A shell that starts the tests in the background has it ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with open_task_executor(Workers(2)) as tasks:
            tasks.run(hold, [(sys.argv[1],)] * 4)
    except KeyboardInterrupt:
        sys.exit(42)
