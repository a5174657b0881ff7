"""Check whether a computer meets the requirements of the program: one check per requirement."""

from __future__ import annotations

from collections.abc import Iterator

from scenes.doctor.check import CheckResult


def run_checks(*, clock_seconds: float = 2.0) -> Iterator[CheckResult]:
    """Run all checks one after the other, basic requirements first; each check runs when the iterator reaches it.

    Args:
        clock_seconds: duration of the measurement of the 1 kHz clock, s.

    Yields:
        The result of each check.
    """
    from scenes.doctor import clock, installation, platform_services, realtime_mesh, taichi_backend

    yield installation.check_python_version_and_platform()
    yield from installation.iterate_required_package_checks()
    yield installation.check_common_package_folder()
    yield taichi_backend.check_taichi_kernel()
    yield taichi_backend.check_taichi_kernel_cache_size()
    yield realtime_mesh.report_selected_realtime_resolution()
    yield clock.check_clock_lateness(clock_seconds)
    yield clock.check_real_time_priority()
    yield platform_services.check_matplotlib_font_cache()
    yield platform_services.check_viewer_port()


__all__ = ["CheckResult", "run_checks"]
