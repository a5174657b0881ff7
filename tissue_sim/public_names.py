"""Public names of a package, and modules, imported on first use, so that importing the package is instant."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from types import ModuleType
from typing import Any


def import_on_use(package: str) -> tuple[list[str], Callable[[str], Any], Callable[[], list[str]]]:
    """Names, ``__getattr__`` and ``__dir__`` of a package (PEP 562).

    Args:
        package: its ``__name__``. In its folder lies ``__init__.pyi``, which type checkers read, with a line
            ``from MODULE import NAME as NAME`` for each public name.
    """
    homes = {}
    spec: Any = sys.modules[package].__spec__
    # As the package itself is read, from a folder or an archive.
    for line in spec.loader.get_data(f"{spec.origin}i").decode("utf-8").splitlines():
        match line.split():
            case "from", module, "import", name, "as", _:
                homes[name] = module

    def get(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(homes[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *homes})

    return sorted(homes), get, names


class ModuleOnUse(ModuleType):
    """A module that is imported when one of its names is asked for; its ``__name__`` is that of the module."""

    def __getattr__(self, name: str) -> Any:
        return getattr(import_module(self.__name__), name)
