"""Import the optional packages of some formats: the extra ``formats``."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

from tissue_sim.bounded import exclude_cpu_time_from_limit
from tissue_sim.errors import InputError


def import_optional_package(package: str, file: Path) -> ModuleType:
    """Import an optional package.

    Raises:
        InputError: the package is not installed; the message names the extra to install.
    """
    try:
        with exclude_cpu_time_from_limit():
            return importlib.import_module(package)
    except ImportError as error:
        raise InputError(f"reading this file needs the package {package} ({error}); install it with "
                         "pip install 'tissue-sim[formats]'", file=file) from None
