"""Whether Taichi compiles and runs here, and where it keeps what it compiled."""

# No postponed annotations here: Taichi reads the types of a kernel when it is defined.
import subprocess
import sys
import time

from scenes.doctor.check import Check, folder_size, readable_size
from tissue_sim.errors import MissingBackendError

_TERMS = 1000
#: Back-ends of Taichi beside the CPU; OpenGL last, see `other_backends`.
_OTHERS = ("cuda", "amdgpu", "metal", "vulkan", "dx11", "opengl", "gles")
_PROBE = """
import sys
from tissue_sim.fem.taichi import runtime
ti = runtime.initialise()
for name in sys.argv[1:]:
    if ti.lang.misc.is_arch_supported(getattr(ti, name)):
        print(name, flush=True)
"""
_PROBE_SECONDS = 60.0


def kernel() -> Check:
    """Compile and run a small kernel on the back-end that the finite elements use."""
    from tissue_sim.fem.taichi import runtime

    start = time.perf_counter()
    try:
        ti = runtime.initialise()
    except MissingBackendError as error:
        return Check("Taichi", "warn", str(error), "use one of these platforms for finite elements")
    except OSError as error:
        return Check("Taichi", "fail", f"cannot start ({error})",
                     "set TISSUE_SIM_CACHE to a folder that you can write to")

    @ti.kernel
    def sum_of_squares(terms: ti.i32) -> ti.f64:
        total = ti.cast(0.0, ti.f64)
        for i in range(terms):
            total += ti.cast(i, ti.f64) * i
        return total

    try:
        answer = sum_of_squares(_TERMS)
    except (RuntimeError, ti.TaichiCompilationError) as error:
        return Check("Taichi", "fail", f"cannot compile a kernel ({error})",
                     "python -m pip install --force-reinstall taichi==1.7.4")
    seconds = time.perf_counter() - start
    version = ".".join(str(part) for part in ti.__version__)
    backend = str(ti.lang.impl.current_cfg().arch).removeprefix("Arch.")
    offered = [backend, *other_backends()]
    values = {"version": version, "backend": backend, "offered": ", ".join(offered), "start_s": seconds}
    expected = sum(i * i for i in range(_TERMS))
    if answer != expected:
        return Check("Taichi", "fail", f"{version} on {backend} computed {answer} instead of {expected}",
                     "empty the folder of compiled kernels, then python -m pip install --force-reinstall taichi==1.7.4",
                     values)
    return Check("Taichi", "ok", f"{version}, back-ends here: {', '.join(offered)}; this program uses the CPU "
                 f"({backend}) whatever else there is, because a tissue step is a chain of small dependent operations "
                 f"in double precision; a kernel was compiled and run after {seconds:.1f} s", values=values)


def other_backends() -> list[str]:
    """Back-ends beside the CPU that Taichi can start on this computer.

    Asked in a process of its own: asking for OpenGL where there is no display ends the process. Those that it named
    until then count.
    """
    try:
        done = subprocess.run([sys.executable, "-c", _PROBE, *_OTHERS], capture_output=True, text=True,
                              encoding="utf-8", timeout=_PROBE_SECONDS, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return []
    return [name for name in done.stdout.split() if name in _OTHERS]


def compiled_kernels() -> Check:
    """Folder of the compiled kernels and its size."""
    from tissue_sim.fem.taichi import runtime

    folder = runtime.cache_folder()
    size = folder_size(folder)
    values = {"folder": str(folder), "bytes": size}
    if size == 0:
        return Check("compiled kernels", "ok", f"{folder} is empty: the first simulation compiles for some seconds",
                     values=values)
    return Check("compiled kernels", "ok", f"{folder}, {readable_size(size)} (safe to delete)", values=values)
