"""What sympy derives from a formula, as Python functions and as text; both are kept in the cache folder.

Importing sympy and deriving what one simulation needs takes longer than the simulation. Only formulas of this package
are kept: what one from elsewhere follows from is not known here.
"""

from __future__ import annotations

import linecache
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from hashlib import sha256
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

from tissue_sim.atomic_write import write_text
from tissue_sim.errors import InputError
from tissue_sim.files import cache_folder

_NAME = "_lambdifygenerated"


def derived(derive: Callable[[], tuple[Any, Any] | None], *, kept_as: tuple | None, source: str | None = None,
            names: Mapping[str, Any] | None = None) -> Callable | None:
    """A function of expressions that sympy derives, or that it has derived before.

    Args:
        derive: gives the arguments and the list of expressions, or None where there is no such function.
        kept_as: what tells this function from all others that the source files derive; None: it is not kept.
        source: the file that derives it, where that is none of this package.
        names: its functions (exp, log, ...); numpy's unless given.
    """
    namespace = dict(vars(np) if names is None else names)
    path = _place(kept_as, source)
    if path is not None:
        try:
            exec(compile(path.read_text(encoding="utf-8"), str(path), "exec"), namespace)
            return namespace[_NAME]
        except (OSError, ValueError, SyntaxError, KeyError):
            pass  # not there yet, or damaged
    formula = derive()
    if formula is None:
        return None
    import sympy as sp

    function = sp.lambdify(*formula, modules="numpy" if names is None else [dict(names)], cse=True)
    _keep(path, "".join(linecache.getlines(function.__code__.co_filename)))
    return function


def printed(write: Callable[[], str], *, kept_as: tuple | None) -> str:
    """What sympy makes of a formula as text, or has made of it before; see `derived`."""
    path = _place(kept_as)
    if path is not None:
        with suppress(OSError, ValueError):
            if text := path.read_text(encoding="utf-8"):
                return text
    text = write()
    _keep(path, text)
    return text


def _place(kept_as: tuple | None, source: str | None = None) -> Path | None:
    """The file of what is kept."""
    if kept_as is None:
        return None
    files = (*sorted(Path(__file__).parent.glob("*.py")), *([] if source is None else [Path(source)]))
    key = sha256(repr((_state_of(files), kept_as)).encode()).hexdigest()
    return cache_folder() / "formulas" / key[:32]


def _keep(path: Path | None, text: str) -> None:
    if path is not None:
        # A folder that cannot be written to costs time alone.
        with suppress(InputError):
            write_text(path, text)


@cache
def _state_of(files: tuple[Path, ...]) -> str:
    """What the source files and the version of sympy were."""
    try:
        release = version("sympy")
    except PackageNotFoundError:
        release = ""
    return sha256(b"".join([release.encode(), *(file.read_bytes() for file in files)])).hexdigest()
