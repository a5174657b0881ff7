"""Model curve: the newest request is computed, failures give a reason, and the worker process may die."""

import multiprocessing
import os
import signal
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace

import numpy as np
import pytest

import tissue_sim as ts
from scenes.viewer.background_simulation import ModelCurveWorker, simulate_whole_test
from tissue_sim.errors import ConvergenceError

CURVE = ts.Recording({"displacement": np.linspace(0, 1e-3, 5), "force": np.linspace(0, 1, 5)})
OTHER = ts.Recording({"displacement": np.linspace(0, 2e-3, 5), "force": np.linspace(0, 1, 5)})


def test_the_newest_request_is_computed(pool):
    """The requests are plain words, because nothing in this test reads the model."""
    curve = ModelCurveWorker("accurate")
    assert not curve.is_busy and curve.recording is None
    curve.store_curve_request("first")
    assert curve.is_busy and not pool.tasks, "the process of the page does not wait for one to start"
    curve.store_result_and_start_next()
    for request in ("second", "third", "fourth"):
        curve.store_curve_request(request)
        curve.store_result_and_start_next()
    assert [arguments for arguments, _ in pool.tasks] == [("first", "accurate", "axisymmetric", None)]
    pool.tasks[0][1].set_result(CURVE)
    curve.store_result_and_start_next()
    assert curve.recording is CURVE and curve.number == 1
    assert [arguments[0] for arguments, _ in pool.tasks] == ["first", "fourth"] and curve.is_busy
    pool.tasks[1][1].set_result(OTHER)
    curve.store_result_and_start_next()
    assert curve.recording is OTHER and curve.number == 2 and not curve.is_busy
    curve.store_result_and_start_next()
    assert len(pool.tasks) == 2 and curve.number == 2
    curve.close()
    assert pool.stopped


@pytest.mark.parametrize(("error", "left"), [
    (ConvergenceError("no equilibrium below 3 mm", recording=OTHER, depth=3e-3), OTHER),
    (ConvergenceError("not even the first"), None),
    (ts.InputError("12 layers are too many", field="layers"), None),
])
def test_a_failed_simulation_gives_a_reason(pool, error, left):
    """The curve is the converged part of the failed simulation, never the curve of the previous model."""
    curve = ModelCurveWorker()
    for answer in ("set_result", CURVE), ("set_exception", error), ("set_result", CURVE):
        curve.store_curve_request("a model")
        curve.store_result_and_start_next()
        getattr(pool.tasks[-1][1], answer[0])(answer[1])
        curve.store_result_and_start_next()
        failed = answer[1] is error
        assert curve.recording is (left if failed else CURVE) and curve.problem == (str(error) if failed else "")
    assert curve.number == 3


def test_a_dead_worker_gives_a_message(pool):
    curve = ModelCurveWorker()
    curve.store_curve_request("a model")
    curve.store_result_and_start_next()
    pool.tasks[0][1].set_exception(BrokenProcessPool("terminated abruptly"))
    curve.store_result_and_start_next()
    assert "has died" in curve.problem and not curve.is_busy
    curve.store_curve_request("another")
    curve.store_result_and_start_next()
    pool.tasks[1][1].set_result(CURVE)
    curve.store_result_and_start_next()
    assert curve.recording is CURVE and curve.problem == ""


def test_a_result_after_forget_is_dropped(pool):
    """The result of an earlier request belongs to another test."""
    curve = ModelCurveWorker()
    curve.store_curve_request("compression")
    curve.store_result_and_start_next()
    curve.store_curve_request("compression, softer")
    curve.discard_curve_and_requests()
    assert curve.recording is None
    curve.store_curve_request("needle")
    pool.tasks[0][1].set_result(CURVE)
    curve.store_result_and_start_next()
    assert curve.recording is None and [arguments[0] for arguments, _ in pool.tasks] == ["compression", "needle"]
    pool.tasks[1][1].set_result(OTHER)
    curve.store_result_and_start_next()
    assert curve.recording is OTHER


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals")
def test_a_killed_worker_is_replaced(monkeypatch, until):
    """Real process with a text function instead of a simulation; test_session.py simulates whole tests."""
    monkeypatch.setattr("scenes.viewer.background_simulation.simulate_whole_test", "{}{}, {}".format)
    before = set(multiprocessing.active_children())
    curve = ModelCurveWorker("fast")
    try:
        curve.store_curve_request("needle, ")
        curve.store_result_and_start_next()
        worker, = set(multiprocessing.active_children()) - before
        os.kill(worker.pid, signal.SIGKILL)
        until(curve.store_result_and_start_next, lambda _: not curve.is_busy)
        assert "has died" in curve.problem and curve.recording is None
        curve.store_curve_request("needle, ")
        until(curve.store_result_and_start_next, lambda _: not curve.is_busy)
        assert (curve.recording, curve.problem, curve.number) == ("needle, fast, axisymmetric", "", 2)
    finally:
        curve.close()
    assert set(multiprocessing.active_children()) <= before


def test_the_worker_simulates_the_test(needle):
    specimen = replace(needle.experiment.specimen, density=1040.0, gravity=1e4)
    collapses = replace(needle.model, experiment=replace(needle.experiment, specimen=specimen))
    expected = ts.simulate(needle.model, resolution="realtime")
    np.testing.assert_array_equal(simulate_whole_test(needle.model, "realtime", "axisymmetric").force, expected.force)
    with pytest.raises(ConvergenceError, match="has no equilibrium under its own weight"):
        simulate_whole_test(collapses, "realtime", "axisymmetric")
