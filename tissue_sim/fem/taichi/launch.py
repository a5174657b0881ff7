"""Starting a compiled kernel thousands of times a second.

Taichi checks and converts every argument on every call: 27 arrays cost 0.25 ms. A `BoundKernel` hands its arguments
over once and starts in 9 us. It uses private names of Taichi 1.7.4, which pyproject pins; `tests/tissue_sim/
test_launch.py` fails when they are gone, and the plain call then still works.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tissue_sim.fem.taichi.runtime import initialise


class BoundKernel:
    """A Taichi kernel with numpy arrays as its arguments, bound once.

    The arrays are kept alive and must be changed in place: the kernel sees them where they were when it was bound.

    Args:
        kernel: a `ti.kernel` whose arguments are all arrays.
        arrays: C-contiguous, in the kernel's order.

    Raises:
        ValueError: an array that is not C-contiguous, which Taichi would copy.
    """

    def __init__(self, kernel, arrays: tuple[np.ndarray, ...]):
        if not all(array.flags.c_contiguous for array in arrays):
            raise ValueError("every array must be C-contiguous")
        self.kernel, self.arrays = kernel, arrays
        self._start: Callable[[], None] | None = None

    def __call__(self) -> None:
        """Run the kernel to its end. The first call compiles it, or loads it from the cache."""
        if self._start is None:
            self._start = _bind(self.kernel, self.arrays) or (lambda: self.kernel(*self.arrays))
        self._start()


def _bind(kernel, arrays: tuple[np.ndarray, ...]) -> Callable[[], None] | None:
    """What `Kernel.launch_kernel` of Taichi 1.7.4 does, split into what is done once and what each start needs; None
    where its private names are gone."""
    try:
        primal = kernel._primal
        compiled = primal.compiled_kernels[primal.ensure_compiled(*arrays)]
        context = compiled.make_launch_context()
        for place, (array, argument) in enumerate(zip(arrays, primal.arguments, strict=True)):
            element_dimensions = getattr(argument.annotation.dtype, "ndim", 0)
            shape = array.shape[: array.ndim - element_dimensions]
            context.set_arg_external_array_with_shape((place,), array.ctypes.data, array.nbytes, shape, 0)
        program = initialise().lang.impl.get_runtime().prog
        binary = program.compile_kernel(program.config(), program.get_device_caps(), compiled)
        launch = program.launch_kernel
    except (AttributeError, TypeError):
        return None
    return lambda: launch(binary, context)
