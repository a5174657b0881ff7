"""Launch of compiled kernels with arguments that are bound by name, and objects that own such kernels.

Taichi checks and converts every argument in every call: 27 arrays take 0.25 ms. A `BoundKernel` passes its arguments
once and starts in 9 us. Taichi identifies arguments by position, so that two exchanged arrays of equal rank give a
wrong result without an error; here each array is passed to the argument of its name. The module uses private names of
Taichi 1.7.4, which pyproject pins; `tests/tissue_sim/test_launch.py` fails if they are missing.

An object that owns compiled kernels cannot be copied, and one thread at a time may use it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from functools import cache, wraps
from typing import Any, NoReturn, TypeVar, cast

import numpy as np

from tissue_sim.errors import InputError, MissingBackendError, make_hint_with_similar_or_known_words
from tissue_sim.fem.taichi.runtime import get_initialised_taichi

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


#: Kernel -> compiled kernel of Taichi, its machine code, and the function that launches it.
_COMPILED: dict[Any, tuple[Any, Any, Callable[..., None]]] = {}


class BoundKernel(KernelOwner):
    """Taichi kernel that is bound once to NumPy arrays; a call without arguments launches the kernel.

    The arrays are kept alive and must be changed in place: the kernel uses their memory addresses.

    Args:
        kernel: a `ti.kernel` whose arguments are all arrays.
        arrays: argument of the kernel -> C-contiguous array.

    Raises:
        ValueError: a name that the kernel does not have, or one that is missing; an array of another rank or type than
            the kernel says, or one that is not C-contiguous, which Taichi would copy.
        MissingBackendError: another Taichi than 1.7.4.
    """

    def __init__(self, kernel, arrays: Mapping[str, np.ndarray]):
        expected = _list_argument_ranks_widths_and_types(kernel)
        for name in arrays:
            if name not in expected:
                raise ValueError(f"arrays must be named like the arguments of the kernel; got {name!r}"
                                 f"{make_hint_with_similar_or_known_words(name, expected)}")
        if missing := [name for name in expected if name not in arrays]:
            raise ValueError(f"arrays must contain every argument of the kernel; {', '.join(missing)} missing.")
        for name, (rank, width, dtype) in expected.items():
            array = arrays[name]
            if array.ndim != rank or array.dtype != dtype or (width and array.shape[-1] != width):
                last = f" whose last axis has length {width}" if width else ""
                raise ValueError(f"{name} must be an array with {rank} axes of type {dtype}{last}; got type "
                                 f"{array.dtype} and shape {array.shape}.")
            if not array.flags.c_contiguous:
                raise ValueError(f"{name} must be C-contiguous; got strides {array.strides}. Use "
                                 "numpy.ascontiguousarray.")
        self.kernel, self.arrays = kernel, {name: arrays[name] for name in expected}
        self._start: Callable[[], None] | None = None

    @classmethod
    def bind_by_name(cls, kernel, arrays: Mapping[str, np.ndarray]) -> BoundKernel:
        """Return the kernel bound to the arrays that are named like its arguments; further arrays are ignored."""
        return cls(kernel,
                   {name: arrays[name] for name in _list_argument_ranks_widths_and_types(kernel) if name in arrays})

    def __call__(self) -> None:
        """Run the kernel. The first call compiles it, or loads it from the cache."""
        if self._start is None:
            self._start = _make_launcher_with_arrays(self.kernel, tuple(self.arrays.values()))
        self._start()


@cache
def _list_argument_ranks_widths_and_types(kernel) -> dict[str, tuple[int, int, np.dtype]]:
    """Return argument name -> (rank, length of vectors or 0, type) for the array arguments of a kernel."""
    try:
        return {argument.name: _parse_rank_width_and_dtype(argument.annotation)
                for argument in kernel._primal.arguments}
    except AttributeError as error:
        raise _unsupported_taichi_error(error) from None


def _parse_rank_width_and_dtype(annotation) -> tuple[int, int, np.dtype]:
    """Return the rank of an array, the length of its last axis for vectors (otherwise 0), and its type."""
    from_taichi = get_initialised_taichi().lang.util.to_numpy_type
    element = annotation.dtype
    if not hasattr(element, "n"):
        return annotation.ndim, 0, np.dtype(from_taichi(element))
    return annotation.ndim + 1, element.n, np.dtype(from_taichi(element.dtype))


def _make_launcher_with_arrays(kernel, arrays: tuple[np.ndarray, ...]) -> Callable[[], None]:
    """Bind arrays to the arguments of a kernel by position, and return the function that launches the kernel.

    This is `Kernel.launch_kernel` of Taichi 1.7.4, split into the part that is done once and the part of each launch.
    An ordinary call is no alternative: it accepts at most 64 arguments.
    """
    try:
        primal = kernel._primal
        if kernel not in _COMPILED:
            # Compilation depends on type and rank of the arrays only, and the kernel states these.
            compiled = primal.compiled_kernels[primal.ensure_compiled(*arrays)]
            program = get_initialised_taichi().lang.impl.get_runtime().prog
            binary = program.compile_kernel(program.config(), program.get_device_caps(), compiled)
            _COMPILED[kernel] = compiled, binary, program.launch_kernel
        compiled, binary, launch = _COMPILED[kernel]
        context = compiled.make_launch_context()
        for place, (array, argument) in enumerate(zip(arrays, primal.arguments, strict=True)):
            element_dimensions = getattr(argument.annotation.dtype, "ndim", 0)
            shape = array.shape[: array.ndim - element_dimensions]
            context.set_arg_external_array_with_shape((place,), array.ctypes.data, array.nbytes, shape, 0)
    except (AttributeError, TypeError) as error:
        raise _unsupported_taichi_error(error) from error
    return lambda: launch(binary, context)


def _unsupported_taichi_error(error: Exception) -> MissingBackendError:
    """Return the error that the installed Taichi lacks a private name that launching a kernel requires."""
    return MissingBackendError(f"taichi must be version 1.7.4, whose private functions launch the kernels; the "
                               f"installed version lacks one ({error}). To correct this, install taichi==1.7.4")
