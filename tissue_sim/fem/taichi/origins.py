"""Arrays that kernels address relative to small fields, the origins.

LLVM cannot prove that neighbouring entries of an array argument are contiguous, because Taichi indexes them with
sign-extended 32-bit integers. It loads them one by one or by gather instructions, which are slow on many processors.
Vectors of a Taichi field are loaded by one instruction.

Kernels therefore reach NumPy arrays by indices beyond the end of a small field, the origin: ``origin[offset + i]``.
Taichi checks no bounds. The arrays lie in anonymous memory maps at a distance of whole vectors from the origin. A map
is freed when the last view of its array dies. Kernels hold no reference to such an array; the caller must keep it
alive.
"""

import math
import mmap
from dataclasses import dataclass
from enum import Enum
from functools import cache

import numpy as np

from tissue_sim.fem.taichi.runtime import BLOCK, INTEGER_BLOCK, LANES, get_initialised_taichi, get_shared_taichi_fields

#: Alignment of an array, bytes: a cache line. The vectors of every origin divide it.
ALIGNMENT = 64
#: Largest distance of an array from an origin, in vectors of the origin: 127 GiB for blocks, 63 GiB for lanes of reals,
#: 31 GiB for lanes of integers. Indices of kernels have 32 bits; 2**24 vectors are kept for indices within an array.
MAX_OFFSET = 2**31 - 2**24


class AddressOriginKind(Enum):
    """Kind of an origin: name in `SharedTaichiFields`, type and number of the components of a vector.

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
        """Type of the components."""
        return self.value[1]

    @property
    def width(self) -> int:
        """Number of components of a vector."""
        return self.value[2]

    @property
    def vector_bytes(self) -> int:
        """Size of a vector, bytes."""
        return self.width * self.dtype.itemsize


@dataclass(frozen=True)
class AddressOrigin:
    """Field relative to which kernels address arrays.

    Attributes:
        field: field of vectors.
        address: its address, bytes.
    """

    field: object
    address: int


@cache
def get_address_origin(kind: AddressOriginKind = AddressOriginKind.REAL_BLOCKS) -> AddressOrigin:
    """Return an origin of this process."""
    ti = get_initialised_taichi()
    field, address = getattr(get_shared_taichi_fields(), kind.value[0]), ti.u64

    @ti.kernel
    def get_address() -> address:
        return ti.get_addr(field, [0])

    return AddressOrigin(field, int(get_address()))


def allocate_array(shape: tuple[int, ...], dtype: type = float) -> np.ndarray:
    """Return an array of zeros that kernels can address relative to the origins.

    The array has at least `ALIGNMENT` unused bytes on both sides.

    Args:
        shape: shape of the array.
        dtype: float, or np.int32.
    """
    count, size = math.prod(shape), np.dtype(dtype).itemsize
    return np.frombuffer(_map_memory(count * size), dtype, count, offset=ALIGNMENT).reshape(shape)


def _map_memory(used: int) -> mmap.mmap:
    """Return an anonymous map of zeros for an array of `used` bytes, with `ALIGNMENT` bytes or more on both sides."""
    length = (-(-used // ALIGNMENT) + 2) * ALIGNMENT
    if not hasattr(mmap, "MAP_PRIVATE"):
        return mmap.mmap(-1, length)  # Windows
    # A process that is forked gets a copy of a private map.
    return mmap.mmap(-1, length, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)


def copy_to_addressable_array(values: np.ndarray) -> np.ndarray:
    """Return a copy of an array of floats or 32-bit integers that kernels can address relative to the origins."""
    array = allocate_array(values.shape, values.dtype.type)
    array[...] = values
    return array


def compute_array_offset(array: np.ndarray, kind: AddressOriginKind = AddressOriginKind.REAL_BLOCKS) -> int:
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
    offset, rest = divmod(array.ctypes.data - get_address_origin(kind).address, kind.vector_bytes)
    if rest:
        raise ValueError(f"array must begin at a multiple of {kind.vector_bytes} bytes from the origin; got a "
                         f"remainder of {rest} bytes. Use allocate_array.")
    if abs(offset) > MAX_OFFSET:
        raise OverflowError(f"the distance of an array from the origin must be at most {MAX_OFFSET} vectors of "
                            f"{kind.vector_bytes} bytes; got {offset}. Create the simulator before the process "
                            "reserves large ranges of addresses.")
    return offset
