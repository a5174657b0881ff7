"""Cache of functions and texts that sympy derives from a formula.

Importing sympy and deriving the functions of one simulation takes longer than the simulation. Only formulas of this
package are cached, because the sources of other formulas, on which the result depends, are not known here.
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

from tissue_sim.errors import InputError
from tissue_sim.files import get_cache_folder, write_text

#: Name that sympy's lambdify gives to its functions.
_NAME = "_lambdifygenerated"


def load_or_derive_function(derive: Callable[[], tuple[Any, Any] | None], *, cache_key: tuple | None,
                            source: str | None = None,
                            names: Mapping[str, Any] | None = None) -> Callable | None:
    """Return a function of expressions that sympy derives, from the cache if possible.

    Args:
        derive: returns the arguments and the list of expressions, or None if the function does not exist.
        cache_key: key of the function among all that the source files derive; None: not cached.
        source: file that contains `derive`, if it is not in this package.
        names: name -> function (exp, log, ...) for the expressions; None: those of numpy.

    Returns:
        The function; None if `derive` returns None.
    """
    namespace = dict(vars(np) if names is None else names)
    path = _make_cache_path_or_none(cache_key, source)
    if path is not None:
        try:
            exec(compile(path.read_text(encoding="utf-8"), str(path), "exec"), namespace)
            return namespace[_NAME]
        except (OSError, ValueError, SyntaxError, KeyError):
            pass  # not cached yet, or damaged
    formula = derive()
    if formula is None:
        return None
    import sympy as sp

    function = sp.lambdify(*formula, modules="numpy" if names is None else [dict(names)], cse=True)
    _write_cache_file(path, "".join(linecache.getlines(function.__code__.co_filename)))
    return function


def load_or_format_text(write: Callable[[], str], *, cache_key: tuple | None) -> str:
    """Return a text that sympy prints, from the cache if possible; `cache_key` as in `load_or_derive_function`."""
    path = _make_cache_path_or_none(cache_key)
    if path is not None:
        with suppress(OSError, ValueError):
            if text := path.read_text(encoding="utf-8"):
                return text
    text = write()
    _write_cache_file(path, text)
    return text


def _make_cache_path_or_none(cache_key: tuple | None, source: str | None = None) -> Path | None:
    """Return the path of a cached function or text; None for the key None, which is not cached."""
    if cache_key is None:
        return None
    files = (*sorted(Path(__file__).parent.glob("*.py")), *([] if source is None else [Path(source)]))
    key = sha256(repr((_compute_source_digest(files), cache_key)).encode()).hexdigest()
    return get_cache_folder() / "formulas" / key[:32]


def _write_cache_file(path: Path | None, text: str) -> None:
    """Write a text to the cache; a path that is None or cannot be written is ignored."""
    if path is not None:
        # Without a writable cache the derivation is only repeated.
        with suppress(InputError):
            write_text(path, text)


@cache
def _compute_source_digest(files: tuple[Path, ...]) -> str:
    """Return one SHA-256 of the version of sympy and of the contents of the source files, as hexadecimal digits."""
    try:
        release = version("sympy")
    except PackageNotFoundError:
        release = ""
    return sha256(b"".join([release.encode(), *(file.read_bytes() for file in files)])).hexdigest()
