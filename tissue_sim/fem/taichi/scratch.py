"""The one Taichi field of all kernels: what they have computed of the batch of elements that they work on.

Taichi knows a kept kernel by the numbers of its fields, and numbers fields as they are made. Where each kind of kernel
had a field of its own, a kernel was found again only by a process that made the same kinds in the same order.
"""

from functools import cache

from tissue_sim.fem.taichi.runtime import initialise

#: Numbers in each vector, one of an element each, and vectors.
LANES, VECTORS = 4, 3200


def scratch(lanes: int, size: int):
    """The field, of which the first `size` vectors may be used while a kernel runs; nothing stays there.

    Raises:
        ValueError: it has fewer, or vectors of another length.
    """
    if lanes != LANES or size > VECTORS:
        raise ValueError(f"{size} vectors of {lanes} asked for, and the scratch field has {VECTORS} of {LANES}")
    return _field()


@cache
def _field():
    ti = initialise()
    return ti.Vector.field(LANES, ti.f64, shape=VECTORS)
