"""Objects that own compiled kernels: they cannot be copied, and one thread at a time may use them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import wraps
from typing import Any, NoReturn, TypeVar, cast

from tissue_sim.errors import InputError

_Method = TypeVar("_Method", bound=Callable[..., Any])


class CopyError(InputError, TypeError):
    """An object that owns compiled kernels cannot be copied or pickled."""


class BusyError(InputError, RuntimeError):
    """Two threads called the same simulator at the same time."""


class KernelOwner:
    """Base of objects whose compiled kernels work on their arrays in place.

    A copy would share these arrays, or its kernels would still work on the arrays of the original. `copy`, `deepcopy`
    and `pickle` therefore raise `CopyError`.
    """

    #: Remedy in the message.
    copy_remedy = "Copy the Simulator that owns it with clone(), or keep its state with save() and restore()."

    def __reduce_ex__(self, protocol: object) -> NoReturn:
        raise CopyError(f"{type(self).__name__} cannot be copied or pickled: compiled kernels work on its memory. "
                        f"{self.copy_remedy}")


def make_single_thread_method(method: _Method) -> _Method:
    """Return a method that takes the reentrant lock `_guard` of its object, so that only one thread executes it.

    The returned method does not wait: it raises a `BusyError` while another thread holds the lock.
    """
    @wraps(method)
    def call_method_with_lock(self: Any, *args: Any, **kwargs: Any) -> Any:
        """Execute the method while holding the lock of its object; raise a `BusyError` if another thread holds it."""
        if not self._guard.acquire(blocking=False):
            raise make_busy_error(self)
        try:
            return method(self, *args, **kwargs)
        finally:
            self._guard.release()
    return cast("_Method", call_method_with_lock)


def make_busy_error(owner: object) -> BusyError:
    """Make the error that a second thread, the current one, called an object at the same time."""
    name = type(owner).__name__
    return BusyError(f"{name} was called from two threads at the same time ({threading.current_thread().name} came "
                     f"second). Give each thread a clone(), or let one thread call it.")
