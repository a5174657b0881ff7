"""Clients of a tissue server in other languages, and the bridge to ROS 2.

Folders with sources: `c` (C99 and C++ library with CMake), `csharp` (one file), `packets` (example packets with which
each client is tested). `ros2` is a node in Python. The sources are part of the installed package.
"""

from pathlib import Path


def get_source_folder() -> Path:
    """Return the folder that contains the sources of the clients: the subfolders `c`, `csharp` and `packets`."""
    return Path(__file__).resolve().parent
