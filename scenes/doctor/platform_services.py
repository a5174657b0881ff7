"""Check the services of the operating system: the cache folder of matplotlib, and the port of the viewer."""

from __future__ import annotations

import os
import socket
from pathlib import Path

from scenes.doctor.check import CheckResult, compute_folder_size, format_size

#: Default TCP port of the viewer.
VIEWER_PORT = 8080


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
