"""Tasks give the same answers wherever they run, survive the death of a worker, and leave no process behind."""

import importlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import distributed
import pytest
from child_environment import child_environment

from calibration.tasks import dask_cluster, executors
from calibration.tasks.executors import Workers, open_task_executor
from tissue_sim.errors import ConvergenceError, InputError, WorkerError

SUMS = [(1, 2), (3.5, 4), (5, -6), (0.1, 0.2)]


@pytest.fixture
def task(monkeypatch):
    """The module of task functions; worker processes inherit the search path and find it there."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
    return importlib.import_module("executor_tasks")


def small_cluster():
    """A dask cluster of one worker in this process, its dashboard on any free port."""
    return distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=False, dashboard_address=":0")


@pytest.fixture(scope="module")
def cluster():
    with small_cluster() as cluster:
        yield cluster


@pytest.fixture(params=["inline", "pool", "dask"])
def workers(request):
    if request.param == "dask":
        return Workers(dask=request.getfixturevalue("cluster").scheduler_address)
    return Workers(2 if request.param == "pool" else 1)


def test_everywhere_the_same_results_in_the_order_of_the_arguments(workers, task):
    told = {}
    with open_task_executor(workers) as tasks:
        assert tasks.parallel == (workers != Workers())
        results = tasks.run(task.add, SUMS, told.__setitem__)
        assert tasks.run(task.add, []) == []
        # A tuple that begins with a function stays what it is; dask would call it.
        assert tasks.run(task.nested, [((abs, -1),)]) == [(abs, -1)]
    assert results == [3, 7.5, -1, 0.1 + 0.2]
    assert told == dict(enumerate(results))


def test_everywhere_an_error_arrives_as_it_was_raised(workers, task):
    with open_task_executor(workers) as tasks:
        with pytest.raises(InputError) as caught:
            tasks.run(task.refuse, [("input",), ("done",)])
        assert (caught.value.file, caught.value.line, caught.value.field) == ("a.toml", 3, "test[0].radius")
        assert str(caught.value) == "a.toml:3: test[0].radius: is not positive"
        with pytest.raises(ConvergenceError, match=r"^stopped$") as caught:
            tasks.run(task.refuse, [("done",), ("convergence",)])
        assert caught.value.depth == 0.004
        assert tasks.run(task.refuse, [("done",)]) == ["done"]


def test_one_worker_starts_no_process():
    program = ("import os, sys; from calibration.tasks.executors import *\n"
               "with open_task_executor(Workers()) as tasks:\n"
               "    assert tasks.run(os.getpid, [(), ()]) == [os.getpid()] * 2\n"
               "heavy = {'multiprocessing', 'distributed', 'numpy', 'taichi'} & set(sys.modules)\n"
               "assert not heavy, heavy")
    subprocess.run([sys.executable, "-c", program], check=True, env=child_environment())


def test_results_are_told_in_the_order_of_completion_in_the_callers_thread(task, tmp_path):
    told, marker = [], tmp_path / "go"

    def listen(index, result):
        told.append((index, result))
        assert threading.current_thread() is threading.main_thread()
        if len(told) == 2:
            marker.touch()

    with open_task_executor(Workers(2)) as tasks:
        # The first waits for the other two.
        results = tasks.run(task.wait_for, [(str(marker), "a"), (str(tmp_path), "b"), (str(tmp_path), "c")], listen)
    assert results == ["a", "b", "c"]
    assert told == [(1, "b"), (2, "c"), (0, "a")]


def test_children_have_one_native_thread_and_the_parent_keeps_its_own(task, monkeypatch, tmp_path):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")
    with open_task_executor(Workers(2)) as tasks:
        assert tasks.run(task.meet, [(str(tmp_path), *names)] * 2) == [dict.fromkeys(names, "1")] * 2
    assert task.environment(*names) == {"OMP_NUM_THREADS": "7", "OPENBLAS_NUM_THREADS": None}


def test_workers_leave_ctrl_c_to_their_parent(task):
    with open_task_executor(Workers(2)) as tasks:
        assert tasks.run(task.interrupted, [("a",), ("b",)]) == ["a", "b"]


def test_a_worker_that_dies_once_loses_nothing(task, tmp_path):
    told = {}
    with open_task_executor(Workers(2)) as tasks:
        results = tasks.run(task.die_first, [(str(tmp_path / "died"), value) for value in range(5)], told.__setitem__)
    assert (tmp_path / "died").exists()
    assert results == [0, 1, 2, 3, 4] and told == dict(enumerate(results))


@pytest.mark.slow
def test_tasks_that_kill_their_worker_leave_the_others_their_results(task, tmp_path):
    log, told = tmp_path / "log", {}
    fatal = (0, 3)
    with open_task_executor(Workers(2)) as tasks:
        with pytest.raises(WorkerError, match=r"^2 of 6 tasks have no result") as caught:
            tasks.run(task.log_then, [(str(log), index, index in fatal) for index in range(6)], told.__setitem__)
        assert tasks.run(task.add, SUMS[:1]) == [3]
    assert caught.value.tasks == fatal
    assert told == {1: 1, 2: 2, 4: 4, 5: 5}
    runs = [int(name) for name in log.read_text().split()]
    # A task that ran in parallel with one of the two was repeated.
    assert all(runs.count(index) <= 3 for index in told)
    # Each of the two had its second chance when the others were done.
    assert set(fatal) <= set(runs[max(runs.index(index) for index in told) + 1:])
    assert all(2 <= runs.count(index) <= 3 for index in fatal)


def test_a_lone_task_that_kills_its_worker_is_given_up_after_three_deaths(task, tmp_path):
    log = tmp_path / "log"
    with open_task_executor(Workers(2)) as tasks, pytest.raises(WorkerError) as caught:
        tasks.run(task.log_then, [(str(log), "x", True)])
    assert caught.value.tasks == (0,)
    assert log.read_text().split() == ["x"] * 3


def test_running_tasks_are_told_and_waiting_ones_dropped_when_one_raises(task, tmp_path, monkeypatch):
    told, noticed = {}, tmp_path / "noticed"

    def notice(running, **options):
        """Finished tasks; the slow task runs until one of them has failed."""
        done, others = ended(running, **options)
        if any(future.exception() for future in done):
            noticed.touch()
        return done, others

    ended = executors.wait
    monkeypatch.setattr(executors, "wait", notice)
    with open_task_executor(Workers(2)) as tasks, pytest.raises(InputError):
        tasks.run(task.call, [(task.wait_for, str(noticed), "slow"), (task.refuse, "input"),
                              (task.refuse, "never", str(tmp_path / "begun"))], told.__setitem__)
    assert told == {0: "slow"}
    assert not (tmp_path / "begun").exists()


def test_an_error_of_the_listener_ends_the_running_tasks(task, tmp_path):
    def listen(index, result):
        raise LookupError(result)

    began = time.monotonic()
    with open_task_executor(Workers(2)) as tasks:
        with pytest.raises(LookupError, match="short"):
            tasks.run(task.wait_for, [(str(tmp_path / "never"), "long"), (str(tmp_path), "short")], listen)
        assert tasks.run(task.add, SUMS[:1]) == [3]
    assert time.monotonic() - began < 30


def test_a_script_without_main_guard_is_told_so(tmp_path):
    script = tmp_path / "unguarded.py"
    script.write_text("import math\nfrom calibration.tasks.executors import Workers, open_task_executor\n"
                      "with open_task_executor(Workers(2)) as tasks:\n    tasks.run(math.sqrt, [(1.0,), (2.0,)])\n")
    ended = subprocess.run([sys.executable, script], env=child_environment(), capture_output=True, text=True)
    assert ended.returncode == 1
    # Python's own warning of workers that died may come after it.
    assert any("if __name__ == '__main__':" in line for line in ended.stderr.splitlines()[-8:])


@pytest.mark.skipif(os.name == "nt", reason="POSIX signals and process groups")
@pytest.mark.parametrize(("name", "status"), [("SIGINT", 42), ("SIGKILL", -9)])
def test_no_worker_outlives_its_parent(name, status, task, tmp_path):
    script = Path(__file__).with_name("executor_tasks.py")
    parent = subprocess.Popen([sys.executable, script, tmp_path], env=child_environment(), start_new_session=True,
                              stderr=subprocess.PIPE, text=True)
    task.wait_until(lambda: len(list(tmp_path.iterdir())) == 2)
    if name == "SIGINT":
        os.killpg(parent.pid, signal.SIGINT)  # as a terminal does
    else:
        parent.kill()
    _, printed = parent.communicate(timeout=600)
    assert parent.returncode == status
    assert len(list(tmp_path.iterdir())) == 2, "a task began after the interruption"
    if name == "SIGINT":
        assert printed == "", "workers leave Ctrl-C to their parent"
    task.wait_until(lambda: not any(_alive(int(worker.name)) for worker in tmp_path.iterdir()))


def test_a_cluster_that_does_not_answer_is_bad_input(monkeypatch, tmp_path):
    monkeypatch.setattr(dask_cluster, "CONNECT_TIMEOUT", 0.3)
    for address in ("tcp://127.0.0.1:9", "missing.json", "tcp://127.0.0.1", "pigeon://loft:1", ""):
        with pytest.raises(InputError,
                           match="no dask scheduler answers") as caught, open_task_executor(Workers(dask=address)):
            pass
        assert caught.value.field == "dask"


def test_a_scheduler_file_leads_to_the_cluster(cluster, task, tmp_path):
    file = tmp_path / "scheduler.json"
    file.write_text(json.dumps({"address": cluster.scheduler_address}))
    with open_task_executor(Workers(dask=str(file))) as tasks:
        assert tasks.run(task.add, SUMS[:1]) == [3]
    file.write_text("[]")
    with pytest.raises(InputError, match="a scheduler file must be JSON") as caught, \
            open_task_executor(Workers(dask=str(file))):
        pass
    assert (caught.value.file, caught.value.field) == (file, "dask")


@pytest.mark.slow
def test_a_cluster_that_goes_away_ends_the_run(task, tmp_path):
    told, gone = {}, tmp_path / "gone"
    with small_cluster() as own:
        def leave(index, result):
            told[index] = result
            own.close()
            gone.touch()

        with (open_task_executor(Workers(dask=own.scheduler_address)) as tasks,
              pytest.raises(WorkerError, match="connection to the workers was lost") as caught):
            tasks.run(task.wait_for, [(str(tmp_path), "a"), (str(gone), "b"), (str(gone), "c")], leave)
    assert told == {0: "a"}
    assert caught.value.tasks == (1, 2)


def test_without_the_package_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (pytest.raises(InputError, match=r'pip install "tissue-sim\[cluster\]"') as caught,
          open_task_executor(Workers(dask="tcp://127.0.0.1:8786"))):
        pass
    assert caught.value.field == "dask"


def test_workers_that_make_no_sense_are_refused():
    with pytest.raises(InputError, match="workers must be at least 1; got 0") as caught:
        Workers(0)
    assert caught.value.field == "workers"
    with pytest.raises(InputError, match="dask and workers exclude each other") as caught:
        Workers(4, "tcp://127.0.0.1:8786")
    assert caught.value.field == "dask"


def _alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # A process that has ended stays listed until its status is read.
    status = Path(f"/proc/{pid}/stat")
    return not (status.exists() and status.read_text().rpartition(")")[2].split()[0] == "Z")
