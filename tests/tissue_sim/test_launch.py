"""Arguments bound once: the same answer as a plain call, and nothing silently lost."""

import numpy as np
import pytest

from tissue_sim.fem.taichi import launch
from tissue_sim.fem.taichi.runtime import initialise


@pytest.fixture(scope="module")
def kernel():
    ti = initialise()
    reals, pairs = ti.types.ndarray(dtype=ti.f64, ndim=1), ti.types.ndarray(dtype=ti.types.vector(2, ti.f64), ndim=1)

    @ti.kernel
    def add(x: reals, y: pairs):
        for _ in range(1):
            for i in range(x.shape[0]):
                y[i][0] = y[i][0] + x[i]

    return add


def test_bound_call_is_a_plain_call(kernel):
    x, bound, plain = np.arange(3.0), np.zeros((3, 2)), np.zeros((3, 2))
    run = launch.BoundKernel(kernel, (x, bound))
    for _ in range(2):
        run()
        kernel(x, plain)
        x += 1.0  # in place: the kernel sees it
    np.testing.assert_array_equal(bound, plain)
    np.testing.assert_array_equal(bound[:, 0], 2 * np.arange(3.0) + 1)


def test_private_names_of_taichi_are_there(kernel):
    """When this fails, Taichi has changed: launches fall back to a plain call, 0.25 ms slower. Mend `launch._bind`."""
    assert launch._bind(kernel, (np.zeros(2), np.zeros((2, 2)))) is not None


def test_falls_back_to_a_plain_call(kernel, monkeypatch):
    monkeypatch.setattr(launch, "_bind", lambda *_: None)
    x, y = np.ones(2), np.zeros((2, 2))
    launch.BoundKernel(kernel, (x, y))()
    np.testing.assert_array_equal(y[:, 0], 1.0)


def test_array_that_would_be_copied_is_refused(kernel):
    with pytest.raises(ValueError, match="contiguous"):
        launch.BoundKernel(kernel, (np.zeros(4)[::2], np.zeros((2, 2))))
