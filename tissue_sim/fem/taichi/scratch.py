"""Scratch field shared by all kernels, for intermediate results of one batch of elements.

Taichi numbers its fields in the order of creation, and the key of a cached kernel contains these numbers. With a single
field the key does not depend on the kernels that a process created before.
"""

from dataclasses import dataclass
from functools import cache

from tissue_sim.fem.taichi.runtime import get_initialised_taichi

#: Number of components of each vector, one per element of a batch (SIMD lanes). Eight lanes (AVX-512) are no faster on
#: processors with AVX-512, slower on others, and take 1.5 times as long to compile (docs/performance.md).
LANES = 4
#: Number of vectors in the field.
VECTORS = 3200


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
    return _create_shared_scratch_field_once()


@cache
def _create_shared_scratch_field_once():
    """Return the only scratch field, of `VECTORS` vectors; the first call in a process creates the field."""
    ti = get_initialised_taichi()
    return ti.Vector.field(LANES, ti.f64, shape=VECTORS)
