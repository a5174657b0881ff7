"""Registrations of a plug-in file are known in spawned and in dask workers of a calibration."""

import importlib.util
import sys
from pathlib import Path

import distributed
import pytest

import tissue_sim as ts
from calibration.forward.simulation_cache import hash_content_and_source_code
from calibration.tasks.executors import Workers, open_task_executor
from tissue_sim.parameters import get_parameter_value

PLUGINS = Path(__file__).with_name("plugins")

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


ts.register_law(Fung())


def stress(parameters):
    """A task of the plugin's own."""
    return float(ts.find_law("fung_of_a_plugin").nominal_stress(0.8, parameters))
'''


def load(path):
    """A module that no other process can import: it lies in no folder of the search path."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = sys.modules[path.stem] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def plugin(tmp_path):
    path = tmp_path / "a_plugin.py"
    path.write_text(PLUGIN, encoding="utf-8")
    yield load(path)
    ts.LAWS.unregister("fung_of_a_plugin")
    del sys.modules["a_plugin"]


@pytest.fixture
def seepage(tmp_path):
    """The class of an effect, in such a module."""
    path = tmp_path / "a_seepage.py"
    path.write_text((PLUGINS / "seepage.py").read_text(encoding="utf-8"), encoding="utf-8")
    module = load(path)
    yield ts.EFFECTS.register(module.Seepage)
    ts.EFFECTS.unregister("seepage")
    del sys.modules["a_seepage"]


@pytest.fixture(params=["spawned", "dask"])
def workers(request):
    if request.param == "spawned":
        yield Workers(2)
        return
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, processes=True, dashboard_address=":0") as cluster:
        yield Workers(dask=cluster.scheduler_address)


@pytest.mark.slow
def test_a_law_of_a_plugin_file_is_known_in_workers(plugin, workers):
    values = {"a": 2800.0, "b": 1.5}
    with open_task_executor(workers) as tasks:
        # Registered before and after the workers have started.
        assert tasks.run(plugin.stress, [(values,)] * 3) == [plugin.stress(values)] * 3
        other = type("Other", (type(ts.find_law("fung_of_a_plugin")),), {"name": "other_of_a_plugin"})
        ts.register_law(other())
        try:
            assert tasks.run(ts.Material, [("other_of_a_plugin", values)])[0].mu0 == pytest.approx(2800.0)
        finally:
            ts.LAWS.unregister("other_of_a_plugin")


def test_what_nobody_registered_is_refused_there_as_here(workers):
    with open_task_executor(workers) as tasks, pytest.raises(ts.InputError, match="unknown law 'fung_of_a_plugin'"):
        tasks.run(ts.Material, [("fung_of_a_plugin", {"a": 1.0, "b": 1.0})])


@pytest.mark.slow
def test_a_class_that_a_plugin_file_registers_is_known_in_workers(seepage, workers):
    tissue = ts.Material("neo_hooke", {"C10": 500.0}, effects=(seepage(0.3, 4.0),))
    with open_task_executor(workers) as tasks:
        assert tasks.run(get_parameter_value, [(tissue, "effects.seepage.time")]) == [4.0]


def test_kept_curves_do_not_outlive_the_plugin_they_were_made_with(tmp_path, monkeypatch):
    """The source of what was added is part of the key."""
    monkeypatch.syspath_prepend(tmp_path)
    keys = []
    for stiffness in (1, 2):
        (tmp_path / "a_changing_plugin.py").write_text(PLUGIN.replace("(2 * b)", f"({stiffness} * b)"),
                                                       encoding="utf-8")
        importlib.invalidate_caches()
        importlib.import_module("a_changing_plugin")
        try:
            keys.append(hash_content_and_source_code("a model"))
        finally:
            ts.LAWS.unregister("fung_of_a_plugin")
            del sys.modules["a_changing_plugin"]
    assert keys[0] != keys[1] != hash_content_and_source_code("a model") != keys[0]
