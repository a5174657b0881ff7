"""Fields shared by all kernels: the scratch field for one batch of elements, and the origin of arrays.

Taichi numbers its fields in the order of creation, and the key of a cached kernel contains these numbers. All fields
are created together, so that the key does not depend on the kernels that a process created before.
"""

from dataclasses import dataclass
from functools import cache

from tissue_sim.fem.taichi.runtime import get_initialised_taichi

#: Number of components of each vector, one per element of a batch (SIMD lanes). Eight lanes (AVX-512) are no faster on
#: processors with AVX-512, slower on others, and take 1.5 times as long to compile (docs/performance.md).
LANES = 4
#: Number of vectors in the scratch field.
VECTORS = 3200
#: Number of numbers in a vector of the origin, and in a row of a block of a band matrix.
BLOCK = 8
#: Number of vectors of the origin. Kernels use its address only.
ORIGIN_SIZE = 64


@dataclass(frozen=True)
class ScratchElementSizeLimit:
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
                         f"{lanes}. Increase VECTORS in tissue_sim/fem/taichi/scratch.py.")
    return get_shared_fields().scratch


@dataclass(frozen=True)
class SharedFields:
    """The fields of a process.

    Attributes:
        origin: field of vectors of `BLOCK` numbers relative to which kernels address arrays, see
            `tissue_sim.fem.taichi.origins`.
        scratch: scratch field, `VECTORS` vectors of `LANES` numbers.
    """

    origin: object
    scratch: object


@cache
def get_shared_fields() -> SharedFields:
    """Return the fields of this process; the first call creates them."""
    ti = get_initialised_taichi()
    # The first field begins on a page of memory, so that the arrays that it addresses are aligned to cache lines.
    return SharedFields(origin=ti.Vector.field(BLOCK, ti.f64, shape=ORIGIN_SIZE),
                        scratch=ti.Vector.field(LANES, ti.f64, shape=VECTORS))
