"""Arrays that kernels address relative to small fields, the origins.

Taichi addresses the elements of array arguments by 32-bit integers whose sign extension LLVM cannot simplify, so that
neighbouring numbers are fetched by a gather instruction, which is slow on many processors, or one by one. The
elements of a field of vectors are loaded as vectors. Taichi checks no bounds: memory at a distance of a whole number of
elements from a field is ``field[offset + i]``. The arrays are NumPy arrays in aligned anonymous maps, which are freed
when their last view dies.

An array that a kernel addresses this way is no argument of the kernel. Its owner keeps the array alive.
"""

import math
import mmap
from dataclasses import dataclass
from enum import Enum
from functools import cache

import numpy as np

from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.fem.taichi.shared_fields import BLOCK, INTEGER_BLOCK, LANES, get_shared_fields

#: Alignment of an array, bytes: a cache line. The vectors of every origin divide it.
ALIGNMENT = 64
#: Largest distance of an array from an origin, in vectors of the origin (127 GiB of blocks): indices of kernels have 32
#: bits, and the array itself needs a part of them.
MAX_OFFSET = 2**31 - 2**24


class OriginKind(Enum):
    """Kind of an origin: name in `SharedFields`, type and number of the numbers in a vector.

    Attributes:
        REAL_BLOCKS: rows of blocks of band matrices, and single numbers.
        REAL_LANES: one number for each element of a batch.
        INTEGER_BLOCKS: single integers.
        INTEGER_LANES: one integer for each element of a batch.
    """

    REAL_BLOCKS = ("blocks", np.dtype(np.float64), BLOCK)
    REAL_LANES = ("lanes", np.dtype(np.float64), LANES)
    INTEGER_BLOCKS = ("integer_blocks", np.dtype(np.int32), INTEGER_BLOCK)
    INTEGER_LANES = ("integer_lanes", np.dtype(np.int32), LANES)

    @property
    def dtype(self) -> np.dtype:
        """Type of the numbers."""
        return self.value[1]

    @property
    def width(self) -> int:
        """Number of numbers in a vector."""
        return self.value[2]

    @property
    def vector_bytes(self) -> int:
        """Size of a vector, bytes."""
        return self.width * self.dtype.itemsize


@dataclass(frozen=True)
class Origin:
    """Field relative to which kernels address arrays.

    Attributes:
        field: field of vectors.
        address: its address, bytes.
    """

    field: object
    address: int


@cache
def get_origin(kind: OriginKind = OriginKind.REAL_BLOCKS) -> Origin:
    """Return an origin of this process."""
    ti = get_initialised_taichi()
    field, address = getattr(get_shared_fields(), kind.value[0]), ti.u64

    @ti.kernel
    def get_address() -> address:
        return ti.get_addr(field, [0])

    return Origin(field, int(get_address()))


def allocate_array(shape: tuple[int, ...], dtype: type = float) -> np.ndarray:
    """Return an array of zeros that kernels can address relative to the origins.

    The array has at least `ALIGNMENT` unused bytes on both sides.

    Args:
        shape: shape of the array.
        dtype: float, or np.int32.
    """
    count, size = math.prod(shape), np.dtype(dtype).itemsize
    memory = _map_memory((-(-count * size // ALIGNMENT) + 2) * ALIGNMENT)
    return np.frombuffer(memory, dtype, count, offset=ALIGNMENT).reshape(shape)


def _map_memory(length: int) -> mmap.mmap:
    """Return an anonymous map of `length` bytes, which begins on a page and contains zeros."""
    if not hasattr(mmap, "MAP_PRIVATE"):
        return mmap.mmap(-1, length)  # Windows
    # A process that is forked gets a copy of a private map.
    return mmap.mmap(-1, length, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)


def copy_to_addressable_array(values: np.ndarray) -> np.ndarray:
    """Return a copy of an array of floats or 32-bit integers that kernels can address relative to the origins."""
    array = allocate_array(values.shape, values.dtype.type)
    array[...] = values
    return array


def compute_offset(array: np.ndarray, kind: OriginKind = OriginKind.REAL_BLOCKS) -> int:
    """Return the index of the first number of an array relative to an origin, in vectors of the origin.

    Args:
        array: array from `allocate_array`, or a contiguous part of one that begins with a whole vector.
        kind: the origin.

    Raises:
        ValueError: the array has another type or is not contiguous, or begins inside a vector.
        OverflowError: the array is too far from the origin for an index of 32 bits.
    """
    if array.dtype != kind.dtype or not array.flags.c_contiguous:
        raise ValueError(f"array must be C-contiguous with numbers of type {kind.dtype}; got type {array.dtype} and "
                         f"strides {array.strides}. Use allocate_array.")
    offset, rest = divmod(array.ctypes.data - get_origin(kind).address, kind.vector_bytes)
    if rest:
        raise ValueError(f"array must begin a whole number of {kind.vector_bytes} bytes from the origin; got a "
                         f"remainder of {rest} bytes. Use allocate_array.")
    if abs(offset) > MAX_OFFSET:
        raise OverflowError(f"the distance of an array from the origin must be at most {MAX_OFFSET} elements of "
                            f"{kind.vector_bytes} bytes; got {offset}. Create the simulator before other arrays of the "
                            "process occupy that much address space.")
    return offset
