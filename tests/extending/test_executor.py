"""An executor from one file, selected by its name."""

import math

import pytest

import tissue_sim as ts
from calibration import Workers
from calibration.tasks.executors import EXECUTORS, open_task_executor


@pytest.fixture
def threads(plugin, registers):
    registers(EXECUTORS, plugin("thread_pool").open_thread_pool, "threads")
    return Workers(3, executor="threads")


def test_executor_of_one_file(threads):
    told = {}
    with open_task_executor(threads) as tasks:
        assert tasks.parallel
        assert tasks.run(math.hypot, [(3.0, 4.0), (5.0, 12.0), (8.0, 15.0)], told.__setitem__) == [5.0, 13.0, 17.0]
        with pytest.raises(ValueError, match="math domain error"):
            tasks.run(math.sqrt, [(4.0,), (-1.0,)])
        assert tasks.run(math.sqrt, [(9.0,)]) == [3.0]
    assert told == {0: 5.0, 1: 13.0, 2: 17.0}


def test_an_unknown_name_is_refused():
    with pytest.raises(ts.InputError, match="unknown executor 'proceses'; did you mean 'processes'") as caught:
        Workers(2, executor="proceses")
    assert caught.value.field == "executor"


def test_one_process_on_request():
    with open_task_executor(Workers(1, executor="processes")) as tasks:
        assert tasks.parallel and tasks.run(math.sqrt, [(9.0,)]) == [3.0]


def test_a_cluster_needs_an_address():
    with pytest.raises(ts.InputError, match="needs the address of a scheduler"), \
            open_task_executor(Workers(executor="dask")):
        pass
