"""Fields shared by all kernels: the scratch field for one batch of elements, and the origins of arrays.

Taichi numbers its fields in the order of creation, and the key of a cached kernel contains these numbers. All fields
are created together, so that the key does not depend on the kernels that a process created before.
"""

from dataclasses import dataclass
from functools import cache

from tissue_sim.fem.taichi.runtime import get_initialised_taichi

#: Number of components of the vectors of lanes and of the scratch field, one per finite element of a batch. Eight lanes
#: (AVX-512) are no faster on processors with AVX-512, slower on others, and take 1.5 times as long to compile
#: (docs/performance.md).
LANES = 4
#: Number of vectors in the scratch field.
VECTORS = 3200
#: Number of numbers in a vector of the origin of blocks, and in a row of a block of a band matrix.
BLOCK = 8
#: Number of integers in a vector of the origin of integers, as long as a vector of `BLOCK` numbers.
INTEGER_BLOCK = 16
#: Number of vectors of an origin. Kernels use its address only.
ORIGIN_SIZE = 64


@dataclass(frozen=True)
class CountsInLargestElement:
    """Size of the largest element for which a kernel reserves vectors of the scratch field.

    Attributes:
        nodes: number of nodes.
        points: number of quadrature points.
        modes: number of pressure modes.
    """

    nodes: int
    points: int
    modes: int


def get_shared_scratch_field(lanes: int, size: int):
    """Return the shared scratch field; a kernel may use its first `size` vectors while the kernel runs.

    Args:
        lanes: required number of components of a vector.
        size: required number of vectors.

    Raises:
        ValueError: the field has fewer vectors, or vectors of another length.
    """
    if lanes != LANES or size > VECTORS:
        raise ValueError(f"size must be at most {VECTORS} vectors of {LANES} components; got {size} vectors of "
                         f"{lanes}. Increase VECTORS in tissue_sim/fem/taichi/shared_fields.py.")
    return get_shared_taichi_fields().scratch


@dataclass(frozen=True)
class SharedTaichiFields:
    """The fields of a process. Kernels address arrays relative to the origins (`tissue_sim.fem.taichi.origins`).

    Attributes:
        blocks: origin, vectors of `BLOCK` numbers.
        lanes: origin, vectors of `LANES` numbers.
        integer_blocks: origin, vectors of `INTEGER_BLOCK` integers of 32 bits.
        integer_lanes: origin, vectors of `LANES` integers of 32 bits.
        scratch: scratch field, `VECTORS` vectors of `LANES` numbers.
    """

    blocks: object
    lanes: object
    integer_blocks: object
    integer_lanes: object
    scratch: object


@cache
def get_shared_taichi_fields() -> SharedTaichiFields:
    """Return the fields of this process; the first call creates them."""
    ti = get_initialised_taichi()
    # The first field begins on a page of memory. Arrays aligned to cache lines are whole vectors away from it.
    return SharedTaichiFields(blocks=ti.Vector.field(BLOCK, ti.f64, shape=ORIGIN_SIZE),
                              lanes=ti.Vector.field(LANES, ti.f64, shape=ORIGIN_SIZE),
                              integer_blocks=ti.Vector.field(INTEGER_BLOCK, ti.i32, shape=ORIGIN_SIZE),
                              integer_lanes=ti.Vector.field(LANES, ti.i32, shape=ORIGIN_SIZE),
                              scratch=ti.Vector.field(LANES, ti.f64, shape=VECTORS))
