"""Arrays that kernels address relative to small fields, their origins.

Taichi addresses the elements of array arguments by 32-bit integers whose sign extension LLVM cannot simplify, so that
eight neighbouring numbers are fetched by a gather instruction, which is slow on many processors. The elements of a
field of vectors are loaded as vectors. Taichi checks no bounds: memory at a distance of a whole number of elements from
a field is ``field[offset + i]``. The fields here are such origins; the arrays are NumPy arrays in aligned anonymous
maps, which are freed when their last view dies.

An array that a kernel addresses this way is no argument of the kernel. Its owner keeps the array alive.
"""

import ctypes
import math
import mmap
from dataclasses import dataclass
from functools import cache

import numpy as np

from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.fem.taichi.scratch import get_shared_fields

#: Size of a number, bytes.
_REAL_BYTES = np.dtype(float).itemsize
#: Number of numbers in an element of the field of blocks, and of the alignment of the arrays.
BLOCK = 8
#: Largest offset that a kernel can add to an index of 32 bits, in numbers.
MAX_OFFSET = 2**30


@dataclass(frozen=True)
class Origins:
    """Fields relative to which kernels address arrays.

    Attributes:
        blocks: field of vectors of `BLOCK` numbers.
        reals: field of numbers. Both fields may address the same array.
        blocks_address: address of `blocks`, bytes.
        reals_address: address of `reals`, bytes.
    """

    blocks: object
    reals: object
    blocks_address: int
    reals_address: int


@cache
def get_origins() -> Origins:
    """Return the origins of this process."""
    ti = get_initialised_taichi()
    fields, address = get_shared_fields(), ti.u64

    @ti.kernel
    def get_blocks_address() -> address:
        return ti.get_addr(fields.blocks, [0])

    @ti.kernel
    def get_reals_address() -> address:
        return ti.get_addr(fields.reals, [0])

    return Origins(fields.blocks, fields.reals, int(get_blocks_address()), int(get_reals_address()))


def allocate_array(shape: tuple[int, ...]) -> np.ndarray:
    """Return an array of zeros that kernels can address relative to both origins.

    Args:
        shape: shape of the array.
    """
    count = math.prod(shape)
    memory = mmap.mmap(-1, count * _REAL_BYTES + BLOCK * _REAL_BYTES)
    address = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    shift = (get_origins().blocks_address - address) % (BLOCK * _REAL_BYTES)
    return np.frombuffer(memory, count=count, offset=shift).reshape(shape)


def compute_block_offset(array: np.ndarray) -> int:
    """Return the index of the first element of an array relative to the origin of blocks, in blocks.

    Raises:
        ValueError: the array was not allocated by `allocate_array`, or is a view that begins inside a block.
        OverflowError: the array is too far from the origin for an index of 32 bits.
    """
    return _compute_offset(array, get_origins().blocks_address, BLOCK)


def compute_real_offset(array: np.ndarray) -> int:
    """Return the index of the first number of an array relative to the origin of numbers.

    Raises:
        ValueError: the array is not aligned to numbers.
        OverflowError: the array is too far from the origin for an index of 32 bits.
    """
    return _compute_offset(array, get_origins().reals_address, 1)


def _compute_offset(array: np.ndarray, origin: int, width: int) -> int:
    """Return the distance of an array from an origin, in elements of `width` numbers."""
    if array.dtype != float or not array.flags.c_contiguous:
        raise ValueError(f"array must be C-contiguous with 64-bit floats; got type {array.dtype} and strides "
                         f"{array.strides}. Use allocate_array.")
    offset, rest = divmod(array.ctypes.data - origin, width * _REAL_BYTES)
    if rest:
        raise ValueError(f"array must begin a whole number of {width * _REAL_BYTES} bytes from its origin; got a "
                         f"remainder of {rest} bytes. Use allocate_array.")
    if abs(offset) > MAX_OFFSET:
        raise OverflowError(f"the distance of an array from its origin must be at most {MAX_OFFSET} elements of "
                            f"{width * _REAL_BYTES} bytes; got {offset}. Free memory, and create the simulator again.")
    return offset
