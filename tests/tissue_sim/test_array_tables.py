"""Tables of arrays: kernels read and write the arrays that a layout names, and nothing else."""

import gc
import weakref

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.axisymmetric.discretisation import build_mesh, build_solver_on_mesh
from tissue_sim.fem.taichi.array_tables import (
    LANE_INTEGERS,
    LANE_REALS,
    ArrayLayout,
    integer_array_type,
    real_array_type,
)
from tissue_sim.fem.taichi.origins import allocate_array, copy_to_addressable_array
from tissue_sim.fem.taichi.runtime import LANES, get_initialised_taichi

LAYOUT = ArrayLayout(lanes=LANE_REALS, dofs=LANE_INTEGERS, x=real_array_type(), pairs=integer_array_type(2),
                     tensors=real_array_type(3))
#: Vectors of 64 bytes before and after each array, which no kernel may change.
GUARD = 64


def make_guarded_array(values):
    """Return a copy of `values` between two guards, and the guards."""
    size, width = values.size, GUARD // values.itemsize
    # The array begins a whole number of vectors after the first guard.
    memory = allocate_array((size + 2 * width,), values.dtype.type)
    memory[:] = 77
    inner = memory[width:-width].reshape(values.shape)
    inner[...] = values
    return inner, (memory[:width], memory[-width:])


@pytest.fixture(scope="module")
def kernel():
    ti = get_initialised_taichi()
    table_type = ti.types.ndarray(dtype=ti.i32, ndim=1)

    @ti.func
    def add_hundred(arrays: ti.template(), i):
        arrays.x[i] = arrays.x[i] + 100.0

    @ti.kernel
    def run(passes: ti.i32, table: table_type):
        ti.loop_config(serialize=True)
        for _ in range(passes):
            arrays = LAYOUT.open_table(table)
            for b in range(10):
                gathered = ti.Vector([arrays.x[arrays.dofs[b][lane]] for lane in ti.static(range(LANES))])
                arrays.lanes[b] = arrays.lanes[b] + gathered
            for i in range(arrays.pairs.shape[0]):
                for j in range(arrays.pairs.shape[1]):
                    arrays.pairs[i, j] = 2 * arrays.pairs[i, j]
            for i in range(arrays.tensors.shape[0]):
                arrays.tensors[i, 2, 1] = arrays.tensors[i, 2, 1] + float(arrays.pairs[i, 1])
            for i in range(arrays.x.shape[0]):
                add_hundred(arrays, i)

    return run


def make_values(size):
    """Return the values of the arrays before a run; `x` has `size` numbers, of which the dofs use the first 40."""
    return {"lanes": np.arange(40.0).reshape(10, LANES), "dofs": np.arange(40, dtype=np.int32)[::-1].reshape(10, LANES),
            "x": np.arange(float(size)), "pairs": np.arange(21, dtype=np.int32).reshape(7, 3),
            "tensors": np.arange(60.0).reshape(5, 4, 3)}


@pytest.mark.parametrize("size", [40, 41, 47, 1000])
def test_a_kernel_changes_the_arrays_of_a_table_and_nothing_else(kernel, size):
    values = make_values(size)
    guarded = {name: make_guarded_array(each) for name, each in values.items()}
    arrays = {name: array for name, (array, _) in guarded.items()}
    kernel(1, LAYOUT.make_offset_table(arrays))
    np.testing.assert_array_equal(arrays["lanes"], values["lanes"] + values["x"][values["dofs"]])
    np.testing.assert_array_equal(arrays["pairs"], 2 * values["pairs"])
    expected = values["tensors"].copy()
    expected[:, 2, 1] += 2 * values["pairs"][:5, 1]
    np.testing.assert_array_equal(arrays["tensors"], expected)
    np.testing.assert_array_equal(arrays["x"], values["x"] + 100.0)
    np.testing.assert_array_equal(arrays["dofs"], values["dofs"])
    assert all((guard == 77).all() for _, guards in guarded.values() for guard in guards)


def test_one_compilation_serves_all_sizes_and_tables(kernel):
    first, second = ({name: copy_to_addressable_array(each) for name, each in make_values(size).items()}
                     for size in (40, 500))
    kernel(1, LAYOUT.make_offset_table(first))
    before = {name: array.copy() for name, array in first.items()}
    kernel(1, LAYOUT.make_offset_table(second))
    assert all((first[name] == before[name]).all() for name in first)
    assert second["x"][-1] == 599.0


@pytest.mark.parametrize(("name", "array", "message"), [
    ("lanes", np.zeros((3, LANES + 1)), r"lanes must have shape \(rows, 4\); got shape \(3, 5\)"),
    ("tensors", np.zeros((2, 2)), r"tensors must have 3 axes; got shape \(2, 2\)"),
    ("pairs", np.zeros((7, 3)), "numbers of type int32; got type float64"),
])
def test_an_array_that_does_not_fit_its_layout_is_refused(name, array, message):
    arrays = {each: copy_to_addressable_array(value) for each, value in make_values(40).items()}
    arrays[name] = copy_to_addressable_array(array)
    with pytest.raises(ValueError, match=message):
        LAYOUT.make_offset_table(arrays)


def test_a_missing_array_is_named():
    arrays = {each: copy_to_addressable_array(value) for each, value in make_values(40).items()}
    arrays["dof"] = arrays.pop("dofs")
    with pytest.raises(ValueError, match="arrays must contain dofs; did you mean 'dof'"):
        LAYOUT.make_offset_table(arrays)


def test_a_table_keeps_its_arrays_alive_until_they_are_replaced():
    first, second = ({name: copy_to_addressable_array(each) for name, each in make_values(40).items()}
                     for _ in range(2))
    table, expected = LAYOUT.make_offset_table(first), LAYOUT.make_offset_table(second).tolist()
    watched = weakref.ref(first["x"])
    del first
    gc.collect()
    assert watched() is not None
    incomplete = {name: array for name, array in second.items() if name != "x"}
    with pytest.raises(ValueError, match="arrays must contain x"):
        LAYOUT.replace_arrays(table, incomplete)
    assert table.tolist() != expected and watched() is not None
    LAYOUT.replace_arrays(table, second)
    gc.collect()
    assert table.tolist() == expected and watched() is None


def test_a_material_whose_kernel_fails_leaves_the_solver_with_valid_memory(monkeypatch):
    """The new law has other coefficients, in another array; the old kernel keeps the arrays of its table."""
    experiment = ts.Experiment(ts.Specimen(0.020, 0.015), ts.Protocol.ramp(1e-3, 5), friction="bonded")
    bulk = ts.Bulk("bulk_ratio", 1e3)
    one = ts.Material("neo_hooke", {"C10": 1000.0}, bulk)
    two = ts.Material("ogden_1", {"mu1": 2000.0, "alpha1": 2.0}, bulk)
    solver, other = (build_solver_on_mesh(ts.Model(experiment, one), build_mesh(experiment, "realtime"))
                     for _ in range(2))
    for each in (solver, other):
        assert each.step(1e-4, 0.1).status is ts.StepStatus.CONVERGED

    def fail(*_):
        raise ts.InputError("no kernel")

    monkeypatch.setattr("tissue_sim.fem.axisymmetric.newton.make_step_kernel", fail)
    with pytest.raises(ts.InputError, match="no kernel"):
        solver.set_material(two)
    gc.collect()
    expected = one.energy_law.kernel_coefficients(one.parameters)
    np.testing.assert_array_equal(solver.equations.tables["tissue_table"].arrays["coefficients"], expected)
    for depth in (2e-4, 3e-4):
        assert solver.step(depth, 0.1).wrench == other.step(depth, 0.1).wrench
