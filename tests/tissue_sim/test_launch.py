"""Arguments bound once and by name: the same answer as a plain call, and nothing silently lost or exchanged."""

import numpy as np
import pytest

from tissue_sim.errors import MissingBackendError
from tissue_sim.fem.axisymmetric.energy import get_axisymmetric_scratch_field as solver_scratch
from tissue_sim.fem.taichi import launch
from tissue_sim.fem.taichi.runtime import get_initialised_taichi, get_shared_scratch_field


@pytest.fixture(scope="module")
def kernel():
    ti = get_initialised_taichi()
    reals, pairs = ti.types.ndarray(dtype=ti.f64, ndim=1), ti.types.ndarray(dtype=ti.types.vector(2, ti.f64), ndim=1)

    @ti.kernel
    def add(x: reals, factor: reals, y: pairs):
        for _ in range(1):
            for i in range(x.shape[0]):
                y[i][0] = y[i][0] + factor[0] * x[i]

    return add


def arrays(**changes):
    return {"x": np.arange(3.0), "factor": np.array([2.0]), "y": np.zeros((3, 2))} | changes


def test_what_others_have_compiled_is_kept():
    """Taichi's own bound is seven of our larger kernels."""
    assert get_initialised_taichi().lang.impl.current_cfg().offline_cache_max_size_of_files > 100 * 15e6


def test_a_kept_kernel_is_found_whatever_was_used_before(root):
    """Taichi knows it by the numbers of its fields, in the order in which they were made: there is one."""
    assert solver_scratch() is get_shared_scratch_field(4, 1)
    makers = [path for path in (root / "tissue_sim").rglob("*.py") if ".field(" in path.read_text(encoding="utf-8")]
    assert [path.name for path in makers] == ["runtime.py"]
    with pytest.raises(ValueError, match="got 4000 vectors of 4"):
        get_shared_scratch_field(4, 4000)


def test_bound_call_is_a_plain_call(kernel):
    bound, plain = arrays(), np.zeros((3, 2))
    run = launch.BoundKernel(kernel, bound)
    for _ in range(2):
        run()
        kernel(bound["x"], bound["factor"], plain)
        bound["x"] += 1.0  # in place: the kernel sees it
    np.testing.assert_array_equal(bound["y"], plain)
    np.testing.assert_array_equal(plain[:, 0], 2.0 * (2 * np.arange(3.0) + 1))


def test_order_does_not_matter(kernel):
    """Two arrays of one rank and type in each other's place give another answer; by name they cannot be."""
    forward, backward = arrays(), dict(reversed(arrays().items()))
    for named in (forward, backward):
        launch.BoundKernel(kernel, named)()
    np.testing.assert_array_equal(forward["y"], backward["y"])
    np.testing.assert_array_equal(forward["y"][:, 0], 2.0 * np.arange(3.0))


@pytest.mark.parametrize(("changes", "message"), [
    ({"facto": np.zeros(1)}, "named like the arguments of the kernel; got 'facto'; did you mean 'factor'"),
    ({"x": np.zeros((3, 2)), "y": np.zeros(3)},
     "x must be an array with 1 axes of type float64; got type float64 and shape"),
    ({"x": np.zeros(3, np.int32)}, "x must be an array with 1 axes of type float64; got type int32"),
    ({"y": np.zeros((3, 4))}, "y must be an array with 2 axes of type float64 whose last axis has length 2"),
    ({"x": np.zeros(6)[::2]}, "x must be C-contiguous; got strides"),
])
def test_what_does_not_fit_is_refused(kernel, changes, message):
    with pytest.raises(ValueError, match=message):
        launch.BoundKernel(kernel, arrays(**changes))


def test_missing_argument_is_refused(kernel):
    named = arrays()
    del named["factor"]
    with pytest.raises(ValueError, match="must contain every argument of the kernel; factor missing"):
        launch.BoundKernel(kernel, named)


def test_another_taichi_is_named_with_the_remedy(kernel, monkeypatch):
    run = launch.BoundKernel(kernel, arrays())
    monkeypatch.setattr(launch, "_COMPILED", {})  # no kernel has run yet
    monkeypatch.delattr(type(kernel._primal), "ensure_compiled")
    with pytest.raises(MissingBackendError, match=r"install taichi==1\.7\.4"):
        run()


def test_other_arrays_of_a_kernel_that_has_run_are_bound_without_asking_taichi_again(kernel, monkeypatch):
    """Taichi checks type and rank of each array, which the kernel states."""
    launch.BoundKernel(kernel, arrays())()
    monkeypatch.delattr(type(kernel._primal), "ensure_compiled")
    others = arrays(x=np.arange(5.0), y=np.zeros((5, 2)))
    launch.BoundKernel(kernel, others)()
    np.testing.assert_array_equal(others["y"][:, 0], 2.0 * np.arange(5.0))
