"""The parameters of a model: every number that it depends on, by a path, in SI.

A frozen dataclass declares at its field what the field is, with `parameter`. Files, campaigns, sensitivities,
covariances, sliders, flags and reports take symbol, unit, bounds, absent value and file key from there, and reach the
values by path: ``material.viscoelastic.terms[0].g``, ``experiment.tool.radius``, ``rig.compliance``. A path may start
at any part: ``viscoelastic.terms[0].g`` is one of a `Material`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass, replace
from functools import cache
from math import inf
from numbers import Real
from typing import Any, Protocol, TypeGuard, TypeVar, runtime_checkable

from tissue_sim.errors import InputError, nearest

_KEY = "tissue_sim.parameter"
#: Names of parts are those that others gave them, such as ``part:1`` of a mesh.
_TOKEN = re.compile(r"([^.\[\]]+)|\[(0|[1-9]\d{0,5})\]")
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
        words: what else may stand there and is a number, such as ``frictionless`` for 0.
    """

    symbol: str
    unit: str
    bounds: tuple[float, float] = (-inf, inf)
    absent: float | None = None
    key: str = ""
    factor: float = 1.0
    shapes_mesh: bool = False
    words: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Parameter:
    """A parameter of one model.

    Attributes:
        path: from the part that was asked.
        declaration: what it is.
        value: SI.
        part: class of the part that it belongs to.
    """

    path: str
    declaration: Declaration
    value: float
    part: type

    @property
    def symbol(self) -> str:
        """Of its declaration, with a number where there are several of its kind: ``g1``."""
        return symbol_at(self.path, self.declaration)

    @property
    def file_path(self) -> str:
        """The path as files write it, its last part with the unit: ``viscoelastic.terms[0].tau_s``."""
        place, dot, _ = self.path.rpartition(".")
        return place + dot + self.declaration.key


def symbol_at(path: str, declaration: Declaration) -> str:
    """Symbol of what is declared at a path, with a number where there are several of its kind: ``g1``."""
    return declaration.symbol + "".join(str(token + 1) for token in tokens(path) if isinstance(token, int))


@runtime_checkable
class HasParameters(Protocol):
    """A part whose parameters are no plain fields, such as those of a law, by name."""

    def own_parameters(self) -> Mapping[str, tuple[Declaration, float]]:
        """Name -> what it is and its value, of those that are no declared fields."""

    def with_own_parameters(self: Part, values: Mapping[str, float], **changes: Any) -> Part:
        """The part with some of them, and some fields, changed."""


def parameter(symbol: str, unit: str, *, key: str, factor: float = 1.0, bounds: tuple[float, float] = (-inf, inf),
              absent: float | None = None, shapes_mesh: bool = False, words: Mapping[str, float] | None = None,
              default: Any = MISSING) -> Any:
    """A dataclass field that is a parameter; see `Declaration`."""
    what = Declaration(symbol, unit, bounds, absent, key, factor, shapes_mesh, words or {})
    return field(default=default, metadata={_KEY: what})


def declaration(entry: Field) -> Declaration | None:
    """What a dataclass field declares; None where it is no parameter."""
    return entry.metadata.get(_KEY)


def declared(kind: type) -> dict[str, Declaration]:
    """Field -> what it declares, of a dataclass, in order."""
    return {entry.name: what for entry in fields(kind) if (what := declaration(entry)) is not None}


def declaring(base: type) -> Callable[[Any], bool]:
    """Whether a thing is a dataclass that derives from `base` and declares parameters: a check for registries."""
    return lambda kind: (isinstance(kind, type) and issubclass(kind, base) and is_dataclass(kind)
                         and bool(declared(kind)))


def parameters(part: Any) -> dict[str, Parameter]:
    """Path -> parameter, of everything in a part: a `Model`, a `Material`, an `Experiment`, a `Rig`."""
    return {each.path: each for each in _walk(part, "")}


def parameter_values(part: Any) -> dict[str, float]:
    """Path -> value, SI, of everything in a part."""
    return {each.path: each.value for each in _walk(part, "")}


def value(part: Any, path: str) -> float:
    """The value of one parameter, SI.

    Raises:
        InputError: no such parameter; names the nearest.
    """
    known = parameters(part)
    if path not in known:
        raise InputError(f"there is no parameter {path!r}{nearest(path, known)}", field="parameters")
    return known[path].value


def find_parameters(model: Any, names: Iterable[str]) -> list[Parameter]:
    """Parameters of a model by their paths; ``material.`` may be left out.

    Raises:
        InputError: no such parameter; names the nearest.
    """
    known = parameters(model)
    return [_find(model, name, known) for name in names]


def _find(model: Any, name: str, known: Mapping[str, Parameter]) -> Parameter:
    for path in (name, f"material.{name}"):
        if path in known:
            return known[path]
        word = _at(model, path)
        if isinstance(word, str):
            raise InputError(f"is {word!r} and not a number that could change", field=name)
    raise InputError(f"unknown parameter{nearest(name, [path.removeprefix('material.') for path in known])}",
                     field=name)


def with_values(part: Part, values: Mapping[str, float]) -> Part:
    """The part with parameters changed, all of them at once.

    Args:
        part: a model or a part of one.
        values: path -> value, SI.

    Raises:
        InputError: no such parameter (names the nearest), or what the parts refuse.
    """
    tree: dict = {}
    for path, number in values.items():
        *outer, last = tokens(path)
        if not _has(_at(part, path.rpartition(".")[0]), last):
            raise InputError(f"there is no parameter {path!r}{nearest(path, parameters(part))}", field="parameters")
        branch = tree
        for token in outer:
            branch = branch.setdefault(token, {})
        branch[last] = float(number)
    return _changed(part, tree)


def tokens(path: str) -> list[str | int]:
    """``terms[0].g`` -> ``["terms", 0, "g"]``."""
    return [name if name else int(index) for name, index in _TOKEN.findall(path)]


def to_keys(part: Any) -> dict[str, float]:
    """Key of files -> value in its unit, 15 digits, of the numbers that a part declares and has."""
    return {what.key: float(f"{number / what.factor:.15g}") for name, what in declared(type(part)).items()
            if (number := getattr(part, name)) is not None}


def from_keys(kind: type[Part], content: Mapping[str, float], field: str, **others: Any) -> Part:
    """A part from the keys of a file.

    Args:
        kind: its class.
        content: key -> value in its unit.
        field: where they stand, for messages.
        others: what it takes beside them.

    Raises:
        InputError: an unknown key (names the nearest), a missing one, or a value that the part refuses; with the field.
    """
    names = {what.key: (name, what.factor) for name, what in declared(kind).items()}
    for key in content:
        if key not in names:
            raise InputError(f"unknown key{nearest(key, names)}", field=f"{field}.{key}")
    entries: Mapping[str, Field] = getattr(kind, "__dataclass_fields__", {})
    needed = {name for name, entry in entries.items() if entry.default is MISSING}
    if missing := [key for key, (name, _) in names.items() if name in needed and key not in content]:
        raise InputError(f"needs {', '.join(missing)}", field=field)
    try:
        return kind(**{names[key][0]: names[key][1] * value for key, value in content.items()}, **others)
    except InputError as refused:
        last = (refused.field or "").rpartition(".")[2]
        named = next((key for key, (name, _) in names.items() if name == last), last)
        raise InputError(refused.problem, field=".".join(filter(None, (field, named)))) from None


def _at(part: Any, path: str) -> Any:
    """What stands at a path, the part itself at the empty one; None where nothing does."""
    for token in tokens(path):
        if isinstance(token, int):
            part = part[token] if isinstance(part, tuple) and token < len(part) else None
        else:
            part = part.get(token) if isinstance(part, Mapping) else getattr(part, token, None)
    return part


def _has(part: Any, name: str | int) -> bool:
    """Whether a part has a parameter of that name itself."""
    if not is_dataclass(part):
        return False
    return any(each.path == name for each in _parameters_of(part, ""))


def _walk(part: Any, place: str) -> Iterator[Parameter]:
    """Every parameter at and below a part."""
    yield from _parameters_of(part, place)
    for entry in fields(part):
        content = getattr(part, entry.name)
        if declaration(entry) is not None:
            continue
        if is_dataclass(content):
            yield from _walk(content, f"{place}{entry.name}.")
        elif isinstance(content, tuple) and content and all(map(is_dataclass, content)):
            for index, item in enumerate(content):
                yield from _walk(item, f"{place}{entry.name}[{index}].")
        elif isinstance(content, Mapping) and content and all(map(is_dataclass, content.values())):
            for name, item in content.items():
                yield from _walk(item, f"{place}{entry.name}.{name}.")


def _parameters_of(part: Any, place: str) -> Iterator[Parameter]:
    """The parameters of a part itself."""
    if _states_its_own(part):
        for name, (what, number) in part.own_parameters().items():
            yield Parameter(place + name, what, number, type(part))
    for entry in fields(part):
        stated = declaration(entry)
        if stated is not None:
            content = getattr(part, entry.name)
            content = stated.words.get(content, content) if isinstance(content, str) else content
            if isinstance(content, Real) and not isinstance(content, bool):
                yield Parameter(place + entry.name, stated, float(content), type(part))


def _states_its_own(part: Any) -> TypeGuard[HasParameters]:
    return _of_a_kind_that_does(type(part))  # type: ignore[arg-type]


@cache
def _of_a_kind_that_does(kind: type) -> bool:
    """Python looks through all classes of a protocol for this."""
    return issubclass(kind, HasParameters)


def _changed(part: Any, tree: Mapping[Any, Any]) -> Any:
    if isinstance(part, tuple):
        return tuple(_changed(item, tree[index]) if index in tree else item for index, item in enumerate(part))
    if isinstance(part, Mapping):
        return {name: _changed(item, tree[name]) if name in tree else item for name, item in part.items()}
    changes = {name: _changed(getattr(part, name), sub) if isinstance(sub, dict) else sub for name, sub in tree.items()}
    if _states_its_own(part):
        own = {name: changes.pop(name) for name in part.own_parameters() if name in changes}
        if own:
            return part.with_own_parameters(own, **changes)
    return replace(part, **changes)
