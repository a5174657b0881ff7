"""Environment of child processes that tests start."""

import os
import sys
from pathlib import Path


def child_environment(*folders: Path) -> dict[str, str]:
    """Return environment variables with which a child process imports what this process can import.

    Args:
        folders: folders that the child process searches first.
    """
    return {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [*map(str, folders), *sys.path]))}
