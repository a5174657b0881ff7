"""Shared fixtures, markers, and the order in which processes run the tests."""

import contextlib
import gc
import importlib
import io
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

# Set before numpy is imported: threads do not speed up small matrices, and on a busy machine they wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# With the default of 700 new objects, garbage collection took a tenth of the time.
gc.set_threshold(50_000)
# The duration of an example depends on the load of the machine.
settings.register_profile("shared machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("shared machine")

ROOT = Path(__file__).resolve().parents[1]
# Modules that tests of several folders import are in this folder; the benchmarks are in the root folder.
sys.path[:0] = [str(ROOT / "tests"), str(ROOT)]
#: Longest time that a test waits for the compiling process, s; then it compiles its kernels itself.
COMPILING = 1800.0
#: Maximum number of processes; more need too much memory.
MOST_PROCESSES = 8
#: Tests without finite elements; they run while kernels are compiled.
WITHOUT_KERNELS = (
    "tests/calibration/", "tests/scenes/test_calibrate_command", "tests/scenes/test_material_",
    "tests/tissue_sim/exports/", "tests/tissue_sim/test_column", "tests/tissue_sim/test_formats",
    "tests/tissue_sim/test_laws", "tests/tissue_sim/test_material_file", "tests/tissue_sim/test_protocol",
    "tests/tissue_sim/test_recording",
    "tests/tissue_sim/test_viscoelasticity")
#: Tests of the folders above that do use finite elements.
WITH_KERNELS = (
    "tests/calibration/effects/", "tests/calibration/test_coverage_small", "tests/calibration/test_inverse_fem",
    "tests/calibration/test_inverse_measured")


@pytest.fixture(scope="session")
def root() -> Path:
    """The repository."""
    return ROOT


@pytest.fixture(scope="session")
def reference() -> Path:
    """Reference curves from independent solvers."""
    return ROOT / "tests" / "reference"


@pytest.fixture(scope="session")
def benchmark_module() -> Callable[[str], ModuleType]:
    """A function that imports a module of the benchmarks: ``benchmark_module("peers.felupe_problem")``.

    The benchmarks limit the threads of numerical libraries by environment variables; these are restored."""
    def load(name: str) -> ModuleType:
        with pytest.MonkeyPatch.context() as patch:
            for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
                patch.setenv(variable, "1")
            return importlib.import_module(f"benchmarks.{name}")

    return load


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """Measured data of others; not part of the repository."""
    folder = Path(os.environ.get("TISSUE_SIM_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("compares with published measurements, whose licences keep them out of this repository; there is "
                    f"no folder {folder}. docs/calibration.md, docs/measured_silicones.md and "
                    "docs/viscoelasticity.md name their sources; "
                    "set TISSUE_SIM_DATA to the folder that contains ecoflex_compression and the others")
    return folder


@pytest.fixture
def undrawn(monkeypatch):
    """Replace each drawn figure of a report by one black pixel: drawing takes longer than most fits."""
    from PIL import Image

    pixel = io.BytesIO()
    Image.new("RGB", (1, 1)).save(pixel, "png")
    monkeypatch.setattr("calibration.report.drawing.render_png", lambda figure: pixel.getvalue())


class Compilation:
    """A process that compiles kernels while tests without kernels run.

    The first run on a machine compiles for two minutes; without this process each test process would compile the same
    kernels."""

    def __init__(self, config: pytest.Config):
        #: Path of the mark in worker processes; the controller has none.
        given = getattr(config, "workerinput", {}).get("compiling")
        #: File that exists while the process runs.
        self._mark = None if given is None else Path(given)
        self._process: subprocess.Popen | None = None

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        # All pages run in one process, see below, for minutes: started last, they would leave the other processes idle.
        items.sort(key=lambda item: (may_use_kernels(item), not item.nodeid.startswith("tests/browser/")))
        both_kinds = {may_use_kernels(item) for item in items} == {False, True}
        if both_kinds and not config.option.collectonly and not hasattr(config, "workerinput"):
            self._begin()

    @pytest.hookimpl(optionalhook=True)
    def pytest_configure_node(self, node: Any) -> None:
        """Start the compilation in the controller, which collects no tests."""
        if self._mark is None:
            self._begin()
        node.workerinput["compiling"] = str(self._mark)

    def _begin(self) -> None:
        from tissue_sim.files import get_cache_folder

        folder = tempfile.TemporaryDirectory()
        self._mark = Path(folder.name) / "compiling"
        if any(get_cache_folder().glob("*.tic")):
            return
        self._mark.touch()
        path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
        # If the process fails, the tests compile their kernels themselves.
        self._process = subprocess.Popen([sys.executable, Path(__file__).with_name("compile_kernels.py")],
                                         env={**os.environ, "PYTHONPATH": path}, stdin=subprocess.DEVNULL,
                                         stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

        def wait(process: subprocess.Popen = self._process) -> None:
            process.wait()
            folder.cleanup()

        threading.Thread(target=wait, daemon=True).start()

    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        # Taichi reads its cache of kernels once, at its start in this process.
        if self._mark is not None and may_use_kernels(item):
            from waiting import wait_until

            mark, self._mark = self._mark, None
            # After this time, the tests compile their kernels themselves.
            with contextlib.suppress(AssertionError):
                wait_until(lambda: not mark.exists(), "compiled kernels", COMPILING)

    def pytest_unconfigure(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def may_use_kernels(item: pytest.Item) -> bool:
    return item.nodeid.startswith(WITH_KERNELS) or not item.nodeid.startswith(WITHOUT_KERNELS)


#: Markers that follow from the folder of a test.
MARKERS_OF_FOLDERS = {"tests/browser/": "browser", "tests/haptics/devices/": "hardware_protocol",
                      "tests/haptics/protocols/": "hardware_protocol", "tests/haptics/recorder/": "hardware_protocol"}


def is_whole_suite(config: pytest.Config) -> bool:
    """True if the command line names no test, file or folder."""
    return config.args == config.getini("testpaths")


def pytest_configure(config: pytest.Config) -> None:
    # The choice is made here, and not in `addopts`, so that `pytest FILE` runs all tests of the file.
    if is_whole_suite(config) and not config.option.markexpr:
        config.option.markexpr = "not slow"
    config.pluginmanager.register(Compilation(config))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        for folder, marker in MARKERS_OF_FOLDERS.items():
            if item.nodeid.startswith(folder):
                item.add_marker(marker)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Number of processes: one more than processors for the whole suite, none for single tests.

    Each process loads libraries and kernels. A process waits a fifth of its time for devices and other processes."""
    return min((os.cpu_count() or 1) + 1, MOST_PROCESSES) if is_whole_suite(config) else 0


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Run each file in one process, and all pages in one process: browsers without a graphics card slow each other."""
    from xdist.scheduler import LoadFileScheduling

    class PagesTogether(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            scope = super()._split_scope(nodeid)
            return "tests/browser" if scope.startswith("tests/browser/") else scope

    return PagesTogether(config, log)
