"""Check whether Taichi compiles and runs on this computer, and the size of its kernel cache."""

# Postponed annotations are not possible: Taichi reads the types of a kernel at its definition.
import subprocess
import sys
import time
from dataclasses import dataclass

from scenes.doctor.check import CheckResult, compute_folder_size, format_size
from tissue_sim.errors import MissingBackendError


@dataclass(frozen=True)
class TaichiCheckTermsAndTimeout:
    """Size and time limit of the checks of Taichi.

    Attributes:
        terms: number of terms of the sum that the test kernel computes.
        timeout: longest duration of the probe in a process, s. A slow computer needs a longer time.
    """

    terms: int = 1000
    timeout: float = 60.0


_SETTINGS = TaichiCheckTermsAndTimeout()
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
    def sum_squares_of_integers_below(terms: ti.i32) -> ti.f64:
        total = ti.cast(0.0, ti.f64)
        for i in range(terms):
            total += ti.cast(i, ti.f64) * i
        return total

    try:
        answer = sum_squares_of_integers_below(_SETTINGS.terms)
    except (RuntimeError, ti.TaichiCompilationError) as error:
        return CheckResult("Taichi", "fail", f"cannot compile a kernel ({error})",
                           "python -m pip install --force-reinstall taichi==1.7.4")
    seconds = time.perf_counter() - start
    version = ".".join(str(part) for part in ti.__version__)
    backend = str(ti.lang.impl.current_cfg().arch).removeprefix("Arch.")
    offered = [backend, *find_usable_gpu_backends()]
    values = {"version": version, "backend": backend, "offered": ", ".join(offered), "start_s": seconds}
    expected = sum(i * i for i in range(_SETTINGS.terms))
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
                                 encoding="utf-8", timeout=_SETTINGS.timeout, check=False)
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
