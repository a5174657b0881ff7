"""What the program needs of a computer, one check each."""

from __future__ import annotations

from collections.abc import Iterator

from scenes.doctor.check import Check


def examine(*, clock_seconds: float = 2.0) -> Iterator[Check]:
    """All checks, in the order in which one needs another; each is done when it is asked for.

    Args:
        clock_seconds: how long to watch the 1 kHz clock, s.
    """
    from scenes.doctor import clock, installation, platform_services, realtime_mesh, taichi_backend

    yield installation.python()
    yield from installation.packages()
    yield installation.one_place()
    yield taichi_backend.kernel()
    yield taichi_backend.compiled_kernels()
    yield realtime_mesh.reached()
    yield clock.ticks(clock_seconds)
    yield clock.real_time_priority()
    yield platform_services.matplotlib_cache()
    yield platform_services.viewer_port()


__all__ = ["Check", "examine"]
