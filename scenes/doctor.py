"""Check whether a computer meets the requirements of the program: one check per requirement."""

# Postponed annotations are not possible: Taichi reads the types of a kernel at its definition.
import importlib.metadata
import importlib.util
import os
import platform
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tissue_sim.errors import MissingBackendError

if TYPE_CHECKING:
    import numpy as np

Status = Literal["ok", "warn", "fail"]
#: Packages of this program.
OWN_PACKAGES = ("tissue_sim", "calibration", "haptics", "scenes")
#: Distributions that this program requires.
REQUIRED_PACKAGES = ("taichi", "numpy", "scipy", "sympy", "viser", "msgspec", "rich", "matplotlib", "jinja2")
#: Platforms with Taichi wheels: (sys.platform, machine in lower case).
TAICHI_PLATFORMS = (("linux", "x86_64"), ("win32", "amd64"), ("darwin", "arm64"))
#: Lowest and highest supported version of Python.
PYTHON_RANGE = ((3, 11), (3, 13))
#: Default TCP port of the viewer.
VIEWER_PORT = 8080
#: Name of the coarsest real-time resolution.
COARSEST = "realtime_20"


@dataclass(frozen=True)
class CheckResult:
    """Result of one check of the computer.

    Attributes:
        name: name of the checked requirement.
        status: ``ok``; ``warn``: an optional part is missing or slow; ``fail``: a requirement is not met.
        finding: result in words, with numbers.
        remedy: instruction for the user; empty if the status is ``ok``.
        values: numbers of the finding for other programs, of JSON types; None: no numbers.
    """

    name: str
    status: Status
    finding: str
    remedy: str = ""
    values: Mapping[str, object] | None = None

    def make_json_object(self) -> dict:
        """Return the fields as a JSON object."""
        return asdict(self)


@dataclass(frozen=True)
class ClockCheckSettings:
    """Settings of the clock measurement.

    Attributes:
        period: time between two ticks, s.
        spin: time before a tick from which the process polls the clock instead of sleeping, s. A sleeping process wakes
            up late by less than this time.
        late: lateness from which a tick counts as late, s.
        very_late: lateness from which a tick counts as very late, s: a whole period is missed.
        tolerated: largest fraction of very late ticks that is not noticeable in a haptic loop, 1.
    """

    period: float = 1e-3
    spin: float = 0.2e-3
    late: float = 0.1e-3
    very_late: float = 1e-3
    tolerated: float = 1e-3


@dataclass(frozen=True)
class TaichiCheckTermsAndTimeout:
    """Size and time limit of the checks of Taichi.

    Attributes:
        terms: number of terms of the sum that the test kernel computes.
        timeout: longest duration of the probe in a process, s. A slow computer needs a longer time.
    """

    terms: int = 1000
    timeout: float = 60.0


#: Settings of every measurement.
_CLOCK = ClockCheckSettings()
#: Settings of the checks of Taichi.
_TAICHI = TaichiCheckTermsAndTimeout()
#: Back-ends of Taichi except the CPU; the OpenGL ones last, see `find_usable_gpu_backends`.
_OTHER_BACKENDS = ("cuda", "amdgpu", "metal", "vulkan", "dx11", "opengl", "gles")
#: Program that prints each of its arguments that names an available back-end.
_PROBE = """
import sys
from tissue_sim.fem.taichi import runtime
ti = runtime.get_initialised_taichi()
for name in sys.argv[1:]:
    if ti.lang.misc.is_arch_supported(getattr(ti, name)):
        print(name, flush=True)
"""


def run_checks(*, clock_seconds: float = 2.0) -> Iterator[CheckResult]:
    """Run all checks one after the other, basic requirements first; each check runs when the iterator reaches it.

    Args:
        clock_seconds: duration of the measurement of the 1 kHz clock, s.

    Yields:
        The result of each check.
    """
    yield check_python_version_and_platform()
    yield from iterate_required_package_checks()
    yield check_common_package_folder()
    yield check_taichi_kernel()
    yield check_taichi_kernel_cache_size()
    yield report_selected_realtime_resolution()
    yield check_clock_lateness(clock_seconds)
    yield check_real_time_priority()
    yield check_matplotlib_font_cache()
    yield check_viewer_port()


def check_python_version_and_platform() -> CheckResult:
    """Check the version of Python and the platform."""
    version = ".".join(str(part) for part in sys.version_info[:3])
    finding = f"{version} on {platform.platform()}, {platform.machine()}"
    values = {"version": version, "platform": platform.platform(), "machine": platform.machine()}
    low, high = PYTHON_RANGE
    if not low <= sys.version_info[:2] <= high:
        return CheckResult("Python", "fail", finding, "use Python 3.11, 3.12 or 3.13, for which Taichi has wheels",
                           values)
    if not has_taichi_wheel_for_platform():
        return CheckResult("Python", "warn", finding, "Taichi has no wheel for this platform: analytical calibration "
                           "works, finite elements need Linux x86-64, Windows or a Mac with Apple silicon", values)
    return CheckResult("Python", "ok", finding, values=values)


def has_taichi_wheel_for_platform() -> bool:
    """Return whether Taichi has a wheel for this platform."""
    return (sys.platform, platform.machine().lower()) in TAICHI_PLATFORMS


def iterate_required_package_checks() -> Iterator[CheckResult]:
    """Check whether each required package is installed; yield one result per package."""
    for name in REQUIRED_PACKAGES:
        try:
            version = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            status: Status = "warn" if name == "taichi" and not has_taichi_wheel_for_platform() else "fail"
            yield CheckResult(name, status, "not installed", f"python -m pip install {name}" if status == "fail" else
                              "finite elements need a platform with a Taichi wheel")
        else:
            yield CheckResult(name, "ok", version, values={"version": version})


def check_common_package_folder() -> CheckResult:
    """Return whether the four packages of this program are imported from the same folder, as a check result.

    Another distribution with a package `calibration`, or a file `calibration.py` in the current folder, would replace
    the package of this program without a message.
    """
    folders = {name: _find_folder_containing_package(name) for name in OWN_PACKAGES}
    values = {name: str(folder) if folder else None for name, folder in folders.items()}
    own_folder = folders["scenes"]
    foreign = [name for name, folder in folders.items() if folder != own_folder]
    if not foreign:
        return CheckResult("the four packages", "ok", f"all from {own_folder}", values=values)
    listed = ", ".join(f"{name} from {folders[name]}" if folders[name] else f"{name} not found" for name in foreign)
    return CheckResult("the four packages", "fail", f"{listed}, the others from {own_folder}",
                       "rename or uninstall the package with the same name, or start from another folder; "
                       "then: python -m pip install --force-reinstall --no-deps tissue-sim", values)


def _find_folder_containing_package(name: str) -> Path | None:
    """Return the folder that contains a package, the path of a single-file module, or None if neither exists."""
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):
        return None
    if spec is None or spec.origin is None:
        return None
    origin = Path(spec.origin).resolve()
    # A single file such as calibration.py has no search locations: its path differs from the folder of the packages.
    return origin.parent.parent if spec.submodule_search_locations else origin


def check_taichi_kernel() -> CheckResult:
    """Compile and run a small kernel on the back-end of the finite elements, and check its result."""
    from tissue_sim.fem.taichi import runtime

    start = time.perf_counter()
    try:
        ti = runtime.get_initialised_taichi()
    except MissingBackendError as error:
        return CheckResult("Taichi", "warn", str(error),
                           "use Linux x86-64, Windows or a Mac with Apple silicon for finite elements")
    except OSError as error:
        return CheckResult("Taichi", "fail", f"cannot start ({error})",
                           "set TISSUE_SIM_CACHE to a writable folder")

    @ti.kernel
    def sum_squares_of_integers_below(terms: ti.i32) -> ti.f64:  # type: ignore[name-defined]
        total = ti.cast(0.0, ti.f64)
        for i in range(terms):
            total += ti.cast(i, ti.f64) * i
        return total

    try:
        answer = sum_squares_of_integers_below(_TAICHI.terms)
    except (RuntimeError, ti.TaichiCompilationError) as error:
        return CheckResult("Taichi", "fail", f"cannot compile a kernel ({error})",
                           "python -m pip install --force-reinstall taichi==1.7.4")
    seconds = time.perf_counter() - start
    version = ".".join(str(part) for part in ti.__version__)
    backend = str(ti.lang.impl.current_cfg().arch).removeprefix("Arch.")
    offered = [backend, *find_usable_gpu_backends()]
    values = {"version": version, "backend": backend, "offered": ", ".join(offered), "start_s": seconds}
    expected = sum(i * i for i in range(_TAICHI.terms))
    if answer != expected:
        return CheckResult("Taichi", "fail", f"{version} on {backend} computed {answer} instead of {expected}",
                           "delete the files in the folder of compiled kernels, then: "
                           "python -m pip install --force-reinstall taichi==1.7.4", values)
    return CheckResult("Taichi", "ok", f"{version}, available back-ends: {', '.join(offered)}; this program always "
                       f"uses the CPU ({backend}), because a step of the tissue is a chain of small dependent "
                       f"operations in double precision; a kernel was compiled and run in {seconds:.1f} s",
                       values=values)


def find_usable_gpu_backends() -> list[str]:
    """Return the names of the back-ends, except the CPU, that Taichi can start on this computer.

    A separate process tests the back-ends, because a test of OpenGL without a display ends the process. The names that
    it printed before its end are used.
    """
    try:
        process = subprocess.run([sys.executable, "-c", _PROBE, *_OTHER_BACKENDS], capture_output=True, text=True,
                                 encoding="utf-8", timeout=_TAICHI.timeout, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return []
    return [name for name in process.stdout.split() if name in _OTHER_BACKENDS]


def check_taichi_kernel_cache_size() -> CheckResult:
    """Report the folder of the compiled kernels and its size."""
    from tissue_sim.files import get_cache_folder

    folder = get_cache_folder()
    size = compute_folder_size(folder)
    values = {"folder": str(folder), "bytes": size}
    if size == 0:
        return CheckResult("compiled kernels", "ok",
                           f"{folder} is empty: the first simulation compiles kernels for several seconds",
                           values=values)
    return CheckResult("compiled kernels", "ok", f"{folder}, {format_size(size)} (safe to delete)", values=values)


def report_selected_realtime_resolution() -> CheckResult:
    """Report the mesh that `resolution="realtime"` selects here for the needle of the reference study, with inertia."""
    import numpy as np

    import tissue_sim as ts
    from haptics.loop.multirate import STEP_BUDGET

    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
    experiment = ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(10e-3, 2), tool=ts.Tool("flat", 8e-3))
    start = time.perf_counter()
    try:
        simulator = ts.Simulator(ts.Model(experiment, material), budget=STEP_BUDGET, inertia="on")
        simulator.warm_up()
    except MissingBackendError as error:
        return CheckResult("real-time mesh", "warn", str(error),
                           "use Linux x86-64, Windows or a Mac with Apple silicon for finite elements")
    elements, percent = len(simulator.mesh.connectivity), 100 * float(simulator.force_error or np.nan)
    finding = (f"{simulator.resolution}, {elements} elements for the needle of the study with inertia, in "
               f"{STEP_BUDGET * 1e3:g} ms per step: force error at most {percent:.2g} %; selected in "
               f"{time.perf_counter() - start:.1f} s")
    values = {"resolution": simulator.resolution, "elements": elements, "force_error_percent": percent,
              "budget_us": STEP_BUDGET * 1e6}
    if simulator.resolution == COARSEST:
        return CheckResult("real-time mesh", "warn", finding, "a finer mesh needs a faster or less busy processor: "
                           "close other programs and run the check again; offline simulation is not affected", values)
    return CheckResult("real-time mesh", "ok", finding, values=values)


def check_clock_lateness(seconds: float) -> CheckResult:
    """Measure the lateness of the ticks of a 1 kHz clock in this process, with real-time priority if allowed.

    Args:
        seconds: duration of the measurement, s.
    """
    import numpy as np

    from haptics.loop.ticker import request_fifo_scheduling_and_get_refusal

    with ExitStack() as undo:
        scheduler = "ordinary priority" if request_fifo_scheduling_and_get_refusal(undo) else "SCHED_FIFO"
        lateness = measure_lateness_of_each_tick(seconds)
    late, very_late = (
        float((lateness > limit).mean()) for limit in (_CLOCK.late, _CLOCK.very_late))
    p50, p99, longest = (float(x) for x in np.quantile(lateness, (0.5, 0.99, 1.0)) * 1e6)
    finding = (f"{lateness.size} ticks ({scheduler}): {late:.2%} later than 0.1 ms, {very_late:.2%} later than 1 ms; "
               f"p50 {p50:.2g} us, p99 {p99:.3g} us, max {longest:.3g} us")
    values = {"ticks": lateness.size, "scheduler": scheduler, "later_than_0.1_ms": late, "later_than_1_ms": very_late,
              "p50_us": p50, "p99_us": p99, "max_us": longest}
    if p50 > _CLOCK.very_late * 1e6:
        return CheckResult("1 kHz clock", "fail", finding, "more than half of the ticks miss their period: close other "
                           "programs, or use a computer with a free core", values)
    if very_late > _CLOCK.tolerated:
        return CheckResult("1 kHz clock", "warn", finding, "haptic loops will miss ticks: close other programs, use "
                           "real-time priority and mains power; simulation and calibration are not affected", values)
    return CheckResult("1 kHz clock", "ok", finding, values=values)


def measure_lateness_of_each_tick(seconds: float) -> "np.ndarray":
    """Measure the lateness of each tick.

    The deadlines are fixed in advance: a tick that is several periods late also delays the following ticks, as in a
    real loop.

    Args:
        seconds: duration of the measurement, s.

    Returns:
        Lateness, s, shape (number of ticks,).
    """
    import numpy as np

    period, spin = _CLOCK.period, _CLOCK.spin
    count = max(1, round(seconds / period))
    lateness = np.empty(count)
    start = time.perf_counter() + period
    for tick in range(count):
        deadline = start + tick * period
        slack = deadline - time.perf_counter()
        if slack > spin:
            time.sleep(slack - spin)
        now = time.perf_counter()
        while now < deadline:
            now = time.perf_counter()
        lateness[tick] = now - deadline
    return lateness


def check_real_time_priority() -> CheckResult:
    """Check whether this user may use the real-time scheduler SCHED_FIFO."""
    from haptics.loop.ticker import request_fifo_scheduling_and_get_refusal

    with ExitStack() as undo:
        allowed = not request_fifo_scheduling_and_get_refusal(undo)
    values = {"allowed": allowed}
    if allowed:
        return CheckResult("real-time priority", "ok", "SCHED_FIFO is allowed", values=values)
    if not hasattr(os, "sched_setscheduler"):
        return CheckResult("real-time priority", "warn", "this platform has no SCHED_FIFO",
                           "no action is possible: the 1 kHz loop runs with ordinary priority, and ticks may be late",
                           values)
    return CheckResult("real-time priority", "warn", "SCHED_FIFO is not allowed for this user",
                       "for haptics add 'USER - rtprio 20' to /etc/security/limits.d/rtprio.conf and log in again "
                       "(in a container: --cap-add=SYS_NICE)", values)


def check_matplotlib_font_cache() -> CheckResult:
    """Check whether matplotlib can store its list of fonts; otherwise the first figure of a run is seconds slower."""
    try:
        import matplotlib
    except ImportError:
        return CheckResult("matplotlib cache", "fail", "matplotlib cannot be imported",
                           "python -m pip install matplotlib")
    folder = Path(matplotlib.get_cachedir())
    size = compute_folder_size(folder)
    values = {"folder": str(folder), "bytes": size}
    if not os.access(folder, os.W_OK):
        return CheckResult("matplotlib cache", "warn", f"{folder} cannot be written",
                           "set the environment variable MPLCONFIGDIR to a writable folder", values)
    return CheckResult("matplotlib cache", "ok", f"{folder}, {format_size(size)}", values=values)


def check_viewer_port() -> CheckResult:
    """Check whether the port of the viewer is free on the loopback interface."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        try:
            probe.bind(("127.0.0.1", VIEWER_PORT))
        except OSError as error:
            return CheckResult("loopback port", "warn", f"{VIEWER_PORT} is in use ({error.strerror})",
                               "close the program that uses it, or give the viewer another port",
                               {"port": VIEWER_PORT, "free": False})
    return CheckResult("loopback port", "ok", f"{VIEWER_PORT} is free", values={"port": VIEWER_PORT, "free": True})


def compute_folder_size(folder: Path) -> int:
    """Return the size of all files below a folder, bytes; 0 if the folder does not exist."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) if folder.is_dir() else 0


def format_size(size: int) -> str:
    """Return a size in bytes as a text with a decimal unit, such as ``1.5 MB``."""
    value = float(size)
    for unit in ("B", "kB", "MB"):
        if value < 1000:
            return f"{value:.3g} {unit}"
        value /= 1000
    return f"{value:.3g} GB"
