"""Waiting for a state of another thread or process that gives no event to wait for."""

import time
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")
#: Longest wait, s; generous for a busy machine.
PATIENCE = 600.0
#: Time between two evaluations of the condition, s: short against a test, long against an evaluation.
INTERVAL = 5e-3


def wait_until(condition: Callable[[], T], event: object = "the condition", seconds: float = PATIENCE) -> T:
    """Evaluate a condition until it is true, and return its value.

    Args:
        condition: function without arguments.
        event: description of the awaited state for the message, or a function that returns it.
        seconds: longest wait, s.

    Raises:
        AssertionError: the condition is still false after this time.
    """
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, f"waited {seconds:g} s for {event() if callable(event) else event}"
        time.sleep(INTERVAL)
    return found


def wait_for_value(read: Callable[[], T], is_wanted: Callable[[T], bool], seconds: float = PATIENCE) -> T:
    """Read a value until it satisfies a condition, and return it.

    Raises:
        AssertionError: the last value does not satisfy the condition after this time; the message contains the value.
    """
    value = None

    def is_there() -> bool:
        nonlocal value
        value = read()
        return is_wanted(value)

    wait_until(is_there, lambda: f"another value than {value}", seconds)
    return value
