"""Arrays that kernels address relative to a small field, the origin.

Taichi addresses the elements of array arguments by 32-bit integers whose sign extension LLVM cannot simplify, so that
eight neighbouring numbers are fetched by a gather instruction, which is slow on many processors, or one by one. The
elements of a field of vectors are loaded as vectors. Taichi checks no bounds: memory at a distance of a whole number of
elements from a field is ``field[offset + i]``. The arrays are NumPy arrays in aligned anonymous maps, which are freed
when their last view dies.

An array that a kernel addresses this way is no argument of the kernel. Its owner keeps the array alive.
"""

import ctypes
import math
import mmap
from dataclasses import dataclass
from functools import cache

import numpy as np

from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.fem.taichi.scratch import BLOCK, get_shared_fields

#: Size of an element of the origin, bytes.
BLOCK_BYTES = BLOCK * np.dtype(float).itemsize
#: Largest distance of an array from the origin, in elements (127 GiB): indices of kernels have 32 bits, and the array
#: itself needs a part of them.
MAX_OFFSET = 2**31 - 2**24


@dataclass(frozen=True)
class Origin:
    """Field relative to which kernels address arrays.

    Attributes:
        field: field of vectors of `BLOCK` numbers.
        address: its address, bytes.
    """

    field: object
    address: int


@cache
def get_origin() -> Origin:
    """Return the origin of this process."""
    ti = get_initialised_taichi()
    field, address = get_shared_fields().origin, ti.u64

    @ti.kernel
    def get_address() -> address:
        return ti.get_addr(field, [0])

    return Origin(field, int(get_address()))


def allocate_array(shape: tuple[int, ...]) -> np.ndarray:
    """Return an array of zeros that kernels can address relative to the origin.

    Args:
        shape: shape of the array.
    """
    count = math.prod(shape)
    memory = mmap.mmap(-1, (-(-count // BLOCK) + 1) * BLOCK_BYTES)
    address = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    return np.frombuffer(memory, count=count, offset=(get_origin().address - address) % BLOCK_BYTES).reshape(shape)


def compute_block_offset(array: np.ndarray) -> int:
    """Return the index of the first element of an array relative to the origin, in vectors of `BLOCK` numbers.

    Args:
        array: array from `allocate_array`, or a contiguous part of one that begins with a whole vector.

    Raises:
        ValueError: the array has another type or is not contiguous, or begins inside a vector.
        OverflowError: the array is too far from the origin for an index of 32 bits.
    """
    if array.dtype != float or not array.flags.c_contiguous:
        raise ValueError(f"array must be C-contiguous with 64-bit floats; got type {array.dtype} and strides "
                         f"{array.strides}. Use allocate_array.")
    offset, rest = divmod(array.ctypes.data - get_origin().address, BLOCK_BYTES)
    if rest:
        raise ValueError(f"array must begin a whole number of {BLOCK_BYTES} bytes from the origin; got a remainder of "
                         f"{rest} bytes. Use allocate_array.")
    if abs(offset) > MAX_OFFSET:
        raise OverflowError(f"the distance of an array from the origin must be at most {MAX_OFFSET} elements of "
                            f"{BLOCK_BYTES} bytes; got {offset}. Create the simulator before other arrays of the "
                            "process occupy that much address space.")
    return offset
