"""What the operating system lends us: a cache folder, a port."""

from __future__ import annotations

import os
import socket
from pathlib import Path

from scenes.doctor.check import Check, folder_size, readable_size

VIEWER_PORT = 8080


def matplotlib_cache() -> Check:
    """Whether matplotlib can keep its list of fonts: without it every figure takes seconds longer."""
    try:
        import matplotlib
    except ImportError:
        return Check("matplotlib cache", "fail", "matplotlib cannot be imported", "python -m pip install matplotlib")
    folder = Path(matplotlib.get_cachedir())
    size = folder_size(folder)
    values = {"folder": str(folder), "bytes": size}
    if not os.access(folder, os.W_OK):
        return Check("matplotlib cache", "warn", f"{folder} cannot be written",
                     "set the environment variable MPLCONFIGDIR to a folder of yours", values)
    return Check("matplotlib cache", "ok", f"{folder}, {readable_size(size)}", values=values)


def viewer_port() -> Check:
    """Whether the viewer's port is free on the loopback interface."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        try:
            probe.bind(("127.0.0.1", VIEWER_PORT))
        except OSError as error:
            return Check("loopback port", "warn", f"{VIEWER_PORT} is taken ({error.strerror})",
                         "close the program that uses it, or give the viewer another port",
                         {"port": VIEWER_PORT, "free": False})
    return Check("loopback port", "ok", f"{VIEWER_PORT} is free", values={"port": VIEWER_PORT, "free": True})
