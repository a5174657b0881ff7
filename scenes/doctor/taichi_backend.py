"""Whether Taichi compiles and runs here, and where it keeps what it compiled."""

# No postponed annotations here: Taichi reads the types of a kernel when it is defined.
import time

from scenes.doctor.check import Check, folder_size, readable_size
from tissue_sim.errors import MissingBackendError

_TERMS = 1000


def kernel() -> Check:
    """Compile and run a small kernel on the back-end that the finite elements use."""
    from tissue_sim.fem import runtime

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
    values = {"version": version, "backend": backend, "start_s": seconds}
    expected = sum(i * i for i in range(_TERMS))
    if answer != expected:
        return Check("Taichi", "fail", f"{version} on {backend} computed {answer} instead of {expected}",
                     "empty the folder of compiled kernels, then python -m pip install --force-reinstall taichi==1.7.4",
                     values)
    return Check("Taichi", "ok", f"{version}, back-end {backend}; a kernel was compiled and run after {seconds:.1f} s",
                 values=values)


def compiled_kernels() -> Check:
    """Folder of the compiled kernels and its size."""
    from tissue_sim.fem import runtime

    folder = runtime.cache_folder()
    size = folder_size(folder)
    values = {"folder": str(folder), "bytes": size}
    if size == 0:
        return Check("compiled kernels", "ok", f"{folder} is empty: the first simulation compiles for some seconds",
                     values=values)
    return Check("compiled kernels", "ok", f"{folder}, {readable_size(size)} (safe to delete)", values=values)
