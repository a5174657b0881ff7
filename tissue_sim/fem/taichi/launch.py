"""Starting a compiled kernel thousands of times a second, its arguments bound by name.

Taichi checks and converts every argument on every call: 27 arrays cost 0.25 ms. A `BoundKernel` hands its arguments
over once and starts in 9 us. Taichi tells arguments apart by their place, so that two exchanged arrays of one rank give
a wrong answer and no error; here each goes to the argument of its name. It uses private names of Taichi 1.7.4, which
pyproject pins; `tests/tissue_sim/test_launch.py` fails when they are gone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

import numpy as np

from tissue_sim.errors import MissingBackendError, nearest
from tissue_sim.fem.taichi.runtime import initialise
from tissue_sim.kernel_owner import KernelOwner

#: Kernel -> what Taichi has made of it, its machine code, and what starts that.
_COMPILED: dict[Any, tuple[Any, Any, Callable[..., None]]] = {}


class BoundKernel(KernelOwner):
    """A Taichi kernel with numpy arrays as its arguments, bound once.

    The arrays are kept alive and must be changed in place: the kernel sees them where they were when it was bound.

    Args:
        kernel: a `ti.kernel` whose arguments are all arrays.
        arrays: argument of the kernel -> C-contiguous array.

    Raises:
        ValueError: a name that the kernel does not have, or one that is missing; an array of another rank or type than
            the kernel says, or one that is not C-contiguous, which Taichi would copy.
        MissingBackendError: another Taichi than 1.7.4.
    """

    def __init__(self, kernel, arrays: Mapping[str, np.ndarray]):
        expected = _arguments(kernel)
        for name in arrays:
            if name not in expected:
                raise ValueError(f"the kernel has no argument {name!r}{nearest(name, expected)}")
        if missing := [name for name in expected if name not in arrays]:
            raise ValueError(f"the kernel's arguments {', '.join(missing)} are missing")
        for name, (rank, width, dtype) in expected.items():
            array = arrays[name]
            if array.ndim != rank or array.dtype != dtype or (width and array.shape[-1] != width):
                last = f" whose last axis is {width} long" if width else ""
                raise ValueError(f"{name}: expected {rank} axes of {dtype}{last}, got {array.dtype} of shape "
                                 f"{array.shape}")
            if not array.flags.c_contiguous:
                raise ValueError(f"{name}: every array must be C-contiguous")
        self.kernel, self.arrays = kernel, {name: arrays[name] for name in expected}
        self._start: Callable[[], None] | None = None

    @classmethod
    def of(cls, kernel, arrays: Mapping[str, np.ndarray]) -> BoundKernel:
        """With those of many arrays that the kernel has arguments for."""
        return cls(kernel, {name: arrays[name] for name in _arguments(kernel) if name in arrays})

    def is_of(self, kernel, arrays: Mapping[str, np.ndarray]) -> bool:
        """Whether it starts this kernel on these arrays already: binding anew costs a millisecond."""
        return kernel is self.kernel and all(
            array.ctypes.data == arrays[name].ctypes.data and array.shape == arrays[name].shape
            for name, array in self.arrays.items())

    def __call__(self) -> None:
        """Run the kernel to its end. The first call compiles it, or loads it from the cache."""
        if self._start is None:
            self._start = _bind(self.kernel, tuple(self.arrays.values()))
        self._start()


@cache
def _arguments(kernel) -> dict[str, tuple[int, int, np.dtype]]:
    """Name -> what an array must be, of each argument of a kernel."""
    try:
        return {argument.name: _expected(argument.annotation) for argument in kernel._primal.arguments}
    except AttributeError as error:
        raise _other_taichi(error) from None


def _expected(annotation) -> tuple[int, int, np.dtype]:
    """Axes that an array must have, length of the last one where it is a vector (else 0), and type."""
    from_taichi = initialise().lang.util.to_numpy_type
    element = annotation.dtype
    if not hasattr(element, "n"):
        return annotation.ndim, 0, np.dtype(from_taichi(element))
    return annotation.ndim + 1, element.n, np.dtype(from_taichi(element.dtype))


def _bind(kernel, arrays: tuple[np.ndarray, ...]) -> Callable[[], None]:
    """What `Kernel.launch_kernel` of Taichi 1.7.4 does, split into what is done once and what each start needs.

    There is no plain call to fall back to: Taichi refuses more than 64 arguments there.
    """
    try:
        primal = kernel._primal
        if kernel not in _COMPILED:
            # Of which type and rank arrays are is all that Taichi asks, and that is stated at the kernel.
            compiled = primal.compiled_kernels[primal.ensure_compiled(*arrays)]
            program = initialise().lang.impl.get_runtime().prog
            binary = program.compile_kernel(program.config(), program.get_device_caps(), compiled)
            _COMPILED[kernel] = compiled, binary, program.launch_kernel
        compiled, binary, launch = _COMPILED[kernel]
        context = compiled.make_launch_context()
        for place, (array, argument) in enumerate(zip(arrays, primal.arguments, strict=True)):
            element_dimensions = getattr(argument.annotation.dtype, "ndim", 0)
            shape = array.shape[: array.ndim - element_dimensions]
            context.set_arg_external_array_with_shape((place,), array.ctypes.data, array.nbytes, shape, 0)
    except (AttributeError, TypeError) as error:
        raise _other_taichi(error) from error
    return lambda: launch(binary, context)


def _other_taichi(error: Exception) -> MissingBackendError:
    return MissingBackendError(f"kernels are started by private names of taichi 1.7.4, and this one lacks some "
                               f"({error}); install taichi==1.7.4")
