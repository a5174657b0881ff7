"""The parameters of a model: every number that it depends on, by a path, in SI.

A frozen dataclass declares at its field what the field is, with `parameter`. Files, campaigns, sensitivities,
covariances, sliders, flags and reports take symbol, unit, bounds, absent value and file key from there, and reach the
values by path: ``material.viscoelastic.terms[0].g``, ``experiment.tool.radius``, ``rig.compliance``. A path may start
at any part: ``viscoelastic.terms[0].g`` is one of a `Material`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass, replace
from math import inf
from numbers import Real
from typing import Any, Protocol, TypeVar, runtime_checkable

from tissue_sim.errors import InputError, nearest

_KEY = "tissue_sim.parameter"
_TOKEN = re.compile(r"([A-Za-z_]\w*)|\[(0|[1-9]\d{0,5})\]")
Part = TypeVar("Part")


@dataclass(frozen=True)
class Declaration:
    """What a parameter is.

    Attributes:
        symbol: as reports write it, such as ``g``.
        unit: in SI, ``"1"`` for a ratio.
        bounds: lowest and highest value that a fit may try, SI.
        absent: value at which the parameter does nothing; None where it always acts.
        key: in files, with the file's unit in its name: ``tau_s``, ``radius_mm``.
        factor: SI units in one unit of the file.
        shapes_mesh: whether the mesh depends on it.
    """

    symbol: str
    unit: str
    bounds: tuple[float, float] = (-inf, inf)
    absent: float | None = None
    key: str = ""
    factor: float = 1.0
    shapes_mesh: bool = False


@dataclass(frozen=True)
class Parameter:
    """A parameter of one model.

    Attributes:
        path: from the part that was asked.
        declaration: what it is.
        value: SI.
        symbol: with a number where there are several of its kind: ``g1``.
    """

    path: str
    declaration: Declaration
    value: float
    symbol: str


@runtime_checkable
class HasParameters(Protocol):
    """A part whose parameters are no plain fields, such as those of a law, by name."""

    def own_parameters(self) -> Mapping[str, tuple[Declaration, float]]:
        """Name -> what it is and its value, of those that are no declared fields."""

    def with_own_parameters(self: Part, values: Mapping[str, float], **changes: Any) -> Part:
        """The part with some of them, and some fields, changed."""


def parameter(symbol: str, unit: str, *, key: str, factor: float = 1.0, bounds: tuple[float, float] = (-inf, inf),
              absent: float | None = None, shapes_mesh: bool = False, default: Any = MISSING) -> Any:
    """A dataclass field that is a parameter; see `Declaration`."""
    declared = Declaration(symbol, unit, bounds, absent, key, factor, shapes_mesh)
    return field(default=default, metadata={_KEY: declared})


def declaration(entry: Field) -> Declaration | None:
    """What a dataclass field declares; None where it is no parameter."""
    return entry.metadata.get(_KEY)


def declared(kind: type) -> dict[str, Declaration]:
    """Field -> what it declares, of a dataclass, in order."""
    return {entry.name: found for entry in fields(kind) if (found := declaration(entry)) is not None}


def parameters(part: Any) -> dict[str, Parameter]:
    """Path -> parameter, of everything in a part: a `Model`, a `Material`, an `Experiment`, a `Rig`."""
    return {path: Parameter(path, what, value, _symbol(what, path)) for path, what, value in _walk(part, "")}


def value(part: Any, path: str) -> float:
    """The value of one parameter, SI.

    Raises:
        InputError: no such parameter; names the nearest.
    """
    known = parameters(part)
    if path not in known:
        raise InputError(f"there is no parameter {path!r}{nearest(path, known)}", field="parameters")
    return known[path].value


def with_values(part: Part, values: Mapping[str, float]) -> Part:
    """The part with parameters changed, all of them at once.

    Args:
        part: a model or a part of one.
        values: path -> value, SI.

    Raises:
        InputError: no such parameter (names the nearest), or what the parts refuse.
    """
    known = {path for path, *_ in _walk(part, "")}
    tree: dict = {}
    for path, number in values.items():
        if path not in known:
            raise InputError(f"there is no parameter {path!r}{nearest(path, known)}", field="parameters")
        *outer, last = tokens(path)
        branch = tree
        for token in outer:
            branch = branch.setdefault(token, {})
        branch[last] = float(number)
    return _changed(part, tree)


def tokens(path: str) -> list[str | int]:
    """``terms[0].g`` -> ``["terms", 0, "g"]``."""
    return [name if name else int(index) for name, index in _TOKEN.findall(path)]


def _walk(part: Any, place: str) -> Iterator[tuple[str, Declaration, float]]:
    """(path, declaration, value) of every parameter at and below a part."""
    if isinstance(part, HasParameters):
        for name, (what, number) in part.own_parameters().items():
            yield place + name, what, number
    for entry in fields(part):
        content = getattr(part, entry.name)
        what = declaration(entry)
        if what is not None:
            if isinstance(content, Real) and not isinstance(content, bool):
                yield place + entry.name, what, float(content)
        elif is_dataclass(content):
            yield from _walk(content, f"{place}{entry.name}.")
        elif isinstance(content, tuple) and content and all(map(is_dataclass, content)):
            for index, item in enumerate(content):
                yield from _walk(item, f"{place}{entry.name}[{index}].")


def _changed(part: Any, tree: Mapping[str | int, Any]) -> Any:
    if isinstance(part, tuple):
        return tuple(_changed(item, tree[index]) if index in tree else item for index, item in enumerate(part))
    changes = {name: _changed(getattr(part, name), sub) if isinstance(sub, dict) else sub for name, sub in tree.items()}
    if isinstance(part, HasParameters):
        own = {name: changes.pop(name) for name in part.own_parameters() if name in changes}
        if own:
            return part.with_own_parameters(own, **changes)
    return replace(part, **changes)


def _symbol(what: Declaration, path: str) -> str:
    numbers = [token for token in tokens(path) if isinstance(token, int)]
    return what.symbol + "".join(str(number + 1) for number in numbers)
