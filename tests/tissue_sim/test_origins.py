"""Arrays that kernels address relative to a field."""

import gc
import mmap
import sys
from pathlib import Path

import numpy as np
import pytest

from tissue_sim.fem.taichi import origins
from tissue_sim.fem.taichi.runtime import BLOCK, get_initialised_taichi

#: Flag of Linux for a map without reserved memory, which Python 3.11 does not name.
MAP_NORESERVE = 0x4000
#: Address ranges of this process.
MAPS = Path("/proc/self/maps")


@pytest.fixture(scope="module")
def double_and_count():
    """Kernel that doubles the vectors at an offset, and then adds 1, 2, 3 ... to their numbers, one by one."""
    ti = get_initialised_taichi()
    vectors = origins.get_address_origin().field

    @ti.kernel
    def run(offset: ti.i32, count: ti.i32):
        ti.loop_config(serialize=True)
        for _ in range(1):
            for i in range(count):
                vectors[offset + i] = 2.0 * vectors[offset + i]
            for i in range(count):
                for k in range(BLOCK):
                    vectors[offset + i][k] = vectors[offset + i][k] + i * BLOCK + k + 1.0

    return run


def check_kernel_on_array(double_and_count, guarded):
    """Run the kernel on all vectors of an array except the first and the last one, which must not change."""
    count = len(guarded) - 2
    guarded[:] = 7.0
    inner = guarded[1:-1]
    inner[:] = np.arange(inner.size).reshape(inner.shape)
    double_and_count(origins.compute_array_offset(inner), count)
    np.testing.assert_array_equal(inner.ravel(), 3.0 * np.arange(inner.size) + 1.0)
    assert (guarded[[0, -1]] == 7.0).all()


@pytest.mark.parametrize("count", [1, 5, 4000])
def test_a_kernel_reads_and_writes_an_array_within_its_limits(double_and_count, count):
    check_kernel_on_array(double_and_count, origins.allocate_array((count + 2, BLOCK)))


@pytest.mark.skipif(sys.platform != "linux", reason="reserves address space without memory by a flag of Linux")
def test_an_array_may_be_far_from_the_origin(double_and_count):
    # Map without reserved memory: 40 GiB of address space that nothing touches.
    between = [mmap.mmap(-1, 20 << 30, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | MAP_NORESERVE)
               for _ in range(2)]
    # The first arrays fill gaps between older maps.
    arrays = [origins.allocate_array((500_000, BLOCK)) for _ in range(40)]
    far = max(arrays, key=lambda array: abs(array.ctypes.data - origins.get_address_origin().address))
    assert abs(far.ctypes.data - origins.get_address_origin().address) > 20 << 30
    check_kernel_on_array(double_and_count, far[:4000])
    for one in between:
        one.close()


def test_arrays_are_zero_writeable_and_aligned_to_cache_lines():
    array = origins.allocate_array((3, 2, BLOCK))
    assert array.shape == (3, 2, BLOCK) and array.dtype == float and not array.any() and array.flags.writeable
    assert origins.get_address_origin().address % 64 == 0 and array.ctypes.data % 64 == 0


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
    array = origins.allocate_array((16, BLOCK))
    with pytest.raises(ValueError, match="multiple of 64 bytes"):
        origins.compute_array_offset(array.ravel()[1:9])
    with pytest.raises(ValueError, match="must be C-contiguous"):
        origins.compute_array_offset(array[:, ::2])
    with pytest.raises(ValueError, match="must be C-contiguous"):
        origins.compute_array_offset(array.astype(np.float32))


def test_an_array_too_far_away_is_refused(monkeypatch):
    array = origins.allocate_array((1, BLOCK))
    monkeypatch.setattr(origins, "MAX_OFFSET", abs(origins.compute_array_offset(array)) - 1)
    with pytest.raises(OverflowError, match="distance of an array from the origin must be at most"):
        origins.compute_array_offset(array)
