"""Folders that tests share, and the order of the tests."""

import gc
import importlib
import io
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

# Before numpy comes: threads help no matrix as small as ours, and on a busy machine they wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# The libraries leave so many objects that looking through them after every 700 new ones took a tenth of the time.
gc.set_threshold(50_000)
# How long an example takes says nothing on a machine that has much else to do.
settings.register_profile("shared machine", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("shared machine")

ROOT = Path(__file__).resolve().parents[1]
# What tests of several folders share is a module beside this one.
sys.path[:0] = [str(ROOT / "tests"), str(ROOT)]
#: s; after that tests compile for themselves what nobody has.
COMPILING = 1800.0
#: With more processes a machine has too little memory before it has too few cores.
MOST_PROCESSES = 8
#: Tests that use no finite elements, but for those of the calibration that do; they take more than a minute.
WITHOUT_KERNELS = (
    "tests/calibration/", "tests/scenes/test_calibrate_command", "tests/scenes/test_material_command",
    "tests/tissue_sim/test_column", "tests/tissue_sim/test_formats", "tests/tissue_sim/test_laws",
    "tests/tissue_sim/test_material_file", "tests/tissue_sim/test_protocol", "tests/tissue_sim/test_recording",
    "tests/tissue_sim/test_viscoelasticity")
BUT = ("tests/calibration/effects/", "tests/calibration/test_coverage_small", "tests/calibration/test_inverse_fem",
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
        pytest.skip("compares with measurements that other people have published, of which this repository holds no "
                    f"copy, and there is no folder {folder}; docs/calibration.md, docs/measured_silicones.md and "
                    "docs/viscoelasticity.md say where they are; set TISSUE_SIM_DATA to the folder that holds "
                    "ecoflex_compression and the others")
    return folder


@pytest.fixture
def undrawn(monkeypatch):
    """Figures of reports are composed and not drawn, which takes longer than most fits: each is one black pixel."""
    from PIL import Image

    pixel = io.BytesIO()
    Image.new("RGB", (1, 1)).save(pixel, "png")
    monkeypatch.setattr("calibration.report.drawing.render_png", lambda figure: pixel.getvalue())


class Compilation:
    """A process that compiles kernels while tests run that need none. A machine's first run spends two minutes on
    that, and each of the processes that tests start would compile the same kernels again."""

    def __init__(self, config: pytest.Config):
        #: In the processes that share the tests; the one that shares them out has none of this.
        given = getattr(config, "workerinput", {}).get("compiling")
        #: There while the process runs.
        self._mark = None if given is None else Path(given)
        self._process: subprocess.Popen | None = None

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        # Pages stay together, see below, and take minutes: begun last, they would leave all processes but one idle.
        items.sort(key=lambda item: (may_use_kernels(item), not item.nodeid.startswith("tests/browser/")))
        both_kinds = {may_use_kernels(item) for item in items} == {False, True}
        if both_kinds and not config.option.collectonly and not hasattr(config, "workerinput"):
            self._begin()

    @pytest.hookimpl(optionalhook=True)
    def pytest_configure_node(self, node: Any) -> None:
        """Of the process that shares the tests out, which collects none."""
        if self._mark is None:
            self._begin()
        node.workerinput["compiling"] = str(self._mark)

    def _begin(self) -> None:
        from tissue_sim.files import cache_folder

        folder = tempfile.TemporaryDirectory()
        self._mark = Path(folder.name) / "compiling"
        if any(cache_folder().glob("*.tic")):
            return
        self._mark.touch()
        path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
        # Where it fails, the tests compile what they need, as with any other kernel.
        self._process = subprocess.Popen([sys.executable, Path(__file__).with_name("compile_kernels.py")],
                                         env={**os.environ, "PYTHONPATH": path}, stdin=subprocess.DEVNULL,
                                         stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

        def wait(process: subprocess.Popen = self._process) -> None:
            process.wait()
            folder.cleanup()

        threading.Thread(target=wait, daemon=True).start()

    def pytest_runtest_setup(self, item: pytest.Item) -> None:
        # Taichi looks for kept kernels once, when it starts in this process.
        if self._mark is not None and may_use_kernels(item):
            deadline = time.monotonic() + COMPILING
            while self._mark.exists() and time.monotonic() < deadline:
                time.sleep(0.1)
            self._mark = None

    def pytest_unconfigure(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def may_use_kernels(item: pytest.Item) -> bool:
    return item.nodeid.startswith(BUT) or not item.nodeid.startswith(WITHOUT_KERNELS)


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Compilation(config))


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """The whole suite is shared by processes, some tests are not: each process loads the libraries and kernels anew.

    One more than there are processors: a fifth of the time a process waits, for devices, pages and other processes."""
    whole = config.args == config.getini("testpaths")
    return min((os.cpu_count() or 1) + 1, MOST_PROCESSES) if whole else 0


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """A file is run by one process, and so are all pages: two browsers that draw without a graphics card leave no time
    for what is drawn."""
    from xdist.scheduler import LoadFileScheduling

    class PagesTogether(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            scope = super()._split_scope(nodeid)
            return "tests/browser" if scope.startswith("tests/browser/") else scope

    return PagesTogether(config, log)
