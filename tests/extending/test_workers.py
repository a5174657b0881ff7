"""What a plugin file registers is known where the tasks of a calibration run: in spawned and in dask workers."""

import importlib.util
import sys

import distributed
import pytest

import tissue_sim as ts
from calibration.tasks.executors import Workers, open_tasks

PLUGIN = '''
import sympy as sp
import tissue_sim as ts
from tissue_sim.laws import InvariantLaw


class Fung(InvariantLaw):
    """W = a / (2 b) (exp(b (I1 - 3)) - 1)."""

    name = "fung_of_a_plugin"
    title = "Fung"
    units = {"a": "Pa", "b": "1"}

    def energy(self, I1, I2, a, b):
        return a / (2 * b) * (sp.exp(b * (I1 - 3)) - 1)


ts.register(Fung())


def stress(parameters):
    """A task of the plugin's own."""
    return float(ts.find_law("fung_of_a_plugin").nominal_stress(0.8, parameters))
'''


@pytest.fixture
def plugin(tmp_path):
    """A module that no other process can import: it lies in no folder of the search path."""
    path = tmp_path / "a_plugin.py"
    path.write_text(PLUGIN, encoding="utf-8")
    spec = importlib.util.spec_from_file_location("a_plugin", path)
    module = sys.modules["a_plugin"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    yield module
    ts.LAWS.unregister("fung_of_a_plugin")
    del sys.modules["a_plugin"]


@pytest.fixture(params=["spawned", "dask"])
def workers(request):
    if request.param == "spawned":
        yield Workers(2)
        return
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=True, dashboard_address=":0") as cluster:
        yield Workers(dask=cluster.scheduler_address)


def test_a_law_of_a_plugin_file_is_known_in_workers(plugin, workers):
    values = {"a": 2800.0, "b": 1.5}
    with open_tasks(workers) as tasks:
        # Registered before and after the workers have started.
        assert tasks.run(plugin.stress, [(values,)] * 3) == [plugin.stress(values)] * 3
        other = type("Other", (type(ts.find_law("fung_of_a_plugin")),), {"name": "other_of_a_plugin"})
        ts.register(other())
        try:
            assert tasks.run(ts.Material, [("other_of_a_plugin", values)])[0].mu0 == pytest.approx(2800.0)
        finally:
            ts.LAWS.unregister("other_of_a_plugin")


def test_what_nobody_registered_is_refused_there_as_here(workers):
    with open_tasks(workers) as tasks, pytest.raises(ts.InputError, match="unknown law 'fung_of_a_plugin'"):
        tasks.run(ts.Material, [("fung_of_a_plugin", {"a": 1.0, "b": 1.0})])
