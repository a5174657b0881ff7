"""Arrays that kernels address relative to fields."""

import gc
from pathlib import Path

import numpy as np
import pytest

from tissue_sim.fem.taichi import origins
from tissue_sim.fem.taichi.runtime import get_initialised_taichi

#: Address ranges of this process.
MAPS = Path("/proc/self/maps")


@pytest.fixture(scope="module")
def double_and_count():
    """Kernel that doubles the blocks at an offset, and adds 1, 2, 3 ... to the numbers at another."""
    ti = get_initialised_taichi()
    blocks, reals = origins.get_origins().blocks, origins.get_origins().reals

    @ti.kernel
    def run(at_blocks: ti.i32, at_reals: ti.i32, count: ti.i32):
        ti.loop_config(serialize=True)
        for _ in range(1):
            for i in range(count):
                blocks[at_blocks + i] = 2.0 * blocks[at_blocks + i]
            for i in range(count * origins.BLOCK):
                reals[at_reals + i] = reals[at_reals + i] + i + 1.0

    return run


@pytest.mark.parametrize("count", [1, 5, 4000])
def test_a_kernel_reads_and_writes_the_same_array_as_blocks_and_as_numbers(double_and_count, count):
    guarded = origins.allocate_array((count + 2, origins.BLOCK))
    guarded[:] = 7.0
    inner = guarded[1:-1]
    inner[:] = np.arange(inner.size).reshape(inner.shape)
    double_and_count(origins.compute_block_offset(inner), origins.compute_real_offset(inner), count)
    np.testing.assert_array_equal(inner.ravel(), 3.0 * np.arange(inner.size) + 1.0)
    assert (guarded[[0, -1]] == 7.0).all()


def test_arrays_are_zero_writeable_and_aligned_to_cache_lines():
    array = origins.allocate_array((3, 2, 8))
    assert array.shape == (3, 2, 8) and array.dtype == float and not array.any() and array.flags.writeable
    assert origins.get_origins().blocks_address % 64 == 0 and array.ctypes.data % 64 == 0


def count_maps(address):
    """Number of maps of this process that contain an address."""
    lines = MAPS.read_text(encoding="ascii").splitlines()
    limits = [[int(end, 16) for end in line.split()[0].split("-")] for line in lines]
    return sum(low <= address < high for low, high in limits)


@pytest.mark.skipif(not MAPS.exists(), reason="reads the maps of the process from /proc, which only Linux has")
def test_memory_is_freed_with_the_last_view():
    array = origins.allocate_array((1 << 20,))
    view, address = array[:8], array.ctypes.data
    del array
    gc.collect()
    assert count_maps(address) == 1 and not view.any()
    del view
    gc.collect()
    assert count_maps(address) == 0


def test_an_array_that_a_kernel_cannot_address_is_refused():
    array = origins.allocate_array((16, 8))
    with pytest.raises(ValueError, match="whole number of 64 bytes"):
        origins.compute_block_offset(array.ravel()[1:9])
    with pytest.raises(ValueError, match="must be C-contiguous"):
        origins.compute_block_offset(array[:, ::2])
    with pytest.raises(ValueError, match="must be C-contiguous"):
        origins.compute_block_offset(array.astype(np.float32))


def test_an_array_too_far_away_is_refused(monkeypatch):
    array = origins.allocate_array((1, 8))
    monkeypatch.setattr(origins, "MAX_OFFSET", abs(origins.compute_block_offset(array)) - 1)
    with pytest.raises(OverflowError, match="distance of an array from its origin must be at most"):
        origins.compute_block_offset(array)
