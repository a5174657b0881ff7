"""Parameters of a model: declarations at dataclass fields, and access by path, in SI.

A frozen dataclass declares a parameter at its field with `parameter`. Files, campaigns, sensitivities, covariances,
sliders, flags and reports take symbol, unit, bounds, absent value and file key from the declaration, and access values
by path: ``material.viscoelastic.terms[0].g``, ``experiment.tool.radius``, ``rig.compliance``. A path may start at any
part: ``viscoelastic.terms[0].g`` is a path of a `Material`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass, replace
from functools import cache
from math import inf
from numbers import Real
from typing import Any, Protocol, TypeGuard, TypeVar, runtime_checkable

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.public_names import OldName

#: Key of the declaration in the metadata of a field.
_KEY = "tissue_sim.parameter"
#: Key of the words of a `choice` in the metadata of a field.
_WORDS = "tissue_sim.choice"
#: Name or index in a path; names may be those of a file, such as ``part:1`` of a mesh.
_TOKEN = re.compile(r"([^.\[\]]+)|\[(0|[1-9]\d{0,5})\]")
Part = TypeVar("Part")


@dataclass(frozen=True)
class Declaration:
    """Description of a parameter: symbol, unit, key in files, bounds.

    Attributes:
        symbol: symbol in reports, such as ``g``.
        unit: SI unit, ``"1"`` for a ratio.
        bounds: lowest and highest value in a fit, SI.
        absent: value without effect; None if the parameter always has an effect.
        key: key in files, with the file's unit: ``tau_s``, ``radius_mm``.
        factor: SI units in one unit of the file.
        shapes_mesh: whether the mesh depends on the parameter.
        words: words that stand for a number, such as ``frictionless`` for 0.
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
    """Parameter of a model, with its path, declaration and value.

    Attributes:
        path: path from the part that was searched.
        declaration: declaration of the parameter.
        value: SI.
        part: class of the part that has the parameter.
    """

    path: str
    declaration: Declaration
    value: float
    part: type

    @property
    def symbol(self) -> str:
        """Symbol of the parameter, with a number if there are several parameters of this kind, such as ``g1``."""
        return make_display_symbol_of_parameter(self.path, self.declaration)

    file_path = OldName("path_in_file")

    @property
    def path_in_file(self) -> str:
        """Path of the parameter in files, whose last key contains the unit: ``viscoelastic.terms[0].tau_s``."""
        place, dot, _ = self.path.rpartition(".")
        return place + dot + self.declaration.key


def make_display_symbol_of_parameter(path: str, declaration: Declaration) -> str:
    """Return the symbol of a declaration at a path, with the index in the path plus 1: ``terms[0].g`` gives ``g1``."""
    return declaration.symbol + "".join(str(token + 1) for token in split_path_into_names_and_indices(path)
                                        if isinstance(token, int))


@runtime_checkable
class HasNonFieldParameters(Protocol):
    """Protocol of a model component with parameters that are not dataclass fields, such as those of a law."""

    def non_field_parameters(self) -> Mapping[str, tuple[Declaration, float]]:
        """Return name -> (declaration, value in SI) of the parameters that are not fields."""

    def with_non_field_parameters(self: Part, values: Mapping[str, float], **changes: Any) -> Part:
        """Return a copy of the part with these parameters and, by `changes`, other fields changed."""


def parameter(symbol: str, unit: str, *, key: str, factor: float = 1.0, bounds: tuple[float, float] = (-inf, inf),
              absent: float | None = None, shapes_mesh: bool = False, words: Mapping[str, float] | None = None,
              default: Any = MISSING) -> Any:
    """Make a dataclass field that is a parameter; see `Declaration`."""
    what = Declaration(symbol, unit, bounds, absent, key, factor, shapes_mesh, words or {})
    return field(default=default, metadata={_KEY: what})


def choice(*words: str | int) -> Any:
    """Make a dataclass field that is one of several words or integers, the first by default; it is not a parameter."""
    return field(default=words[0], metadata={_WORDS: words})


def list_field_choices(kind: type) -> dict[str, tuple[str | int, ...]]:
    """Return field name -> words or integers of the fields of a dataclass that `choice` made."""
    return {entry.name: entry.metadata[_WORDS] for entry in fields(kind) if _WORDS in entry.metadata}


def get_field_declaration(entry: Field) -> Declaration | None:
    """Return the `Declaration` of a dataclass field; None if the field is not a parameter."""
    return entry.metadata.get(_KEY)


def list_field_declarations(kind: type) -> dict[str, Declaration]:
    """Return field name -> `Declaration` of the parameters that a dataclass declares, in the order of the fields."""
    return {entry.name: what for entry in fields(kind) if (what := get_field_declaration(entry)) is not None}


def make_parameter_dataclass_predicate(base: type) -> Callable[[Any], bool]:
    """Return a predicate for registries: whether a class is a dataclass, derives from `base` and has parameters."""
    return lambda kind: (isinstance(kind, type) and issubclass(kind, base) and is_dataclass(kind)
                         and bool(list_field_declarations(kind)))


def parameters(part: Any) -> dict[str, Parameter]:
    """Return path -> `Parameter` for all parameters of a part (`Model`, `Material`, ...) and of the parts in it."""
    return {each.path: each for each in _iterate_parameters(part, "")}


def parameter_values(part: Any) -> dict[str, float]:
    """Return path -> value in SI for all parameters of a part.

    Examples:
        >>> from tissue_sim import Layer, Material
        >>> parameter_values(Material("neo_hooke", {"C10": 1000.0}, layers=(Layer(0.004, 2.0),)))
        {'C10': 1000.0, 'layers[0].thickness': 0.004, 'layers[0].ratio': 2.0}
    """
    return {each.path: each.value for each in _iterate_parameters(part, "")}


def get_parameter_value(part: Any, path: str) -> float:
    """Return the value of one parameter, SI.

    Raises:
        InputError: an unknown path; the message names the nearest.

    Examples:
        >>> from tissue_sim import Material
        >>> get_parameter_value(Material("neo_hooke", {"C10": 1000.0}), "C10")
        1000.0
    """
    known = parameters(part)
    if path not in known:
        raise InputError(f"there is no parameter {path!r}{make_hint_with_similar_or_known_words(path, known)}",
                         field="parameters")
    return known[path].value


def get_parameters_at_paths(model: Any, names: Iterable[str]) -> list[Parameter]:
    """Return the parameters with the paths `names`, in this order; ``material.`` may be left out of a path.

    Raises:
        InputError: an unknown path; the message names the nearest.
    """
    known = parameters(model)
    return [_find_parameter(model, name, known) for name in names]


def _find_parameter(model: Any, name: str, known: Mapping[str, Parameter]) -> Parameter:
    """Return the parameter with a path, or with ``material.`` before the path; an `InputError` if neither exists."""
    for path in (name, f"material.{name}"):
        if path in known:
            return known[path]
        word = _find_component_or_none(model, path)
        if isinstance(word, str):
            raise InputError(f"must be a number to be changed; got {word!r}.", field=name)
    raise InputError(
        "unknown parameter"
        f"{make_hint_with_similar_or_known_words(name, [path.removeprefix('material.') for path in known])}",
        field=name)


def with_values(part: Part, values: Mapping[str, float]) -> Part:
    """Return a copy of a part with several parameters changed at once.

    Args:
        part: a model or a part of a model.
        values: path -> value, SI.

    Raises:
        InputError: an unknown path (the message names the nearest), or an invalid value.

    Examples:
        >>> from tissue_sim import Material
        >>> stiffer = with_values(Material("neo_hooke", {"C10": 1000.0}), {"C10": 1500.0})
        >>> stiffer.mu0
        3000.0
    """
    tree: dict = {}
    for path, number in values.items():
        *outer, last = split_path_into_names_and_indices(path)
        if not _has_parameter(_find_component_or_none(part, path.rpartition(".")[0]), last):
            raise InputError(
                f"there is no parameter {path!r}{make_hint_with_similar_or_known_words(path, parameters(part))}",
                field="parameters")
        branch = tree
        for token in outer:
            branch = branch.setdefault(token, {})
        branch[last] = float(number)
    return _replace_values_in_component(part, tree)


def split_path_into_names_and_indices(path: str) -> list[str | int]:
    """Split the path of a parameter into its names (str) and indices (int).

    Examples:
        >>> split_path_into_names_and_indices("terms[0].g")
        ['terms', 0, 'g']
    """
    return [name if name else int(index) for name, index in _TOKEN.findall(path)]


def convert_to_file_values(part: Any) -> dict[str, float]:
    """Return file key -> number in the unit of the key, rounded to 15 digits; fields that are None are left out."""
    return {what.key: float(f"{number / what.factor:.15g}") for name,
            what in list_field_declarations(type(part)).items()
            if (number := getattr(part, name)) is not None}


def make_from_file_values(kind: type[Part], content: Mapping[str, float], field: str, **others: Any) -> Part:
    """Make a part from numbers by file key, which are converted to SI.

    Args:
        kind: class of the part.
        content: key -> value in the unit of the key.
        field: field of the file, for messages.
        others: other arguments of the class.

    Raises:
        InputError: an unknown key (the message names the nearest), a missing key, or an invalid value; with the field.
    """
    names = {what.key: (name, what.factor) for name, what in list_field_declarations(kind).items()}
    for key in content:
        if key not in names:
            raise InputError(f"unknown key{make_hint_with_similar_or_known_words(key, names)}", field=f"{field}.{key}")
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


def _find_component_or_none(part: Any, path: str) -> Any:
    """Return the object at a path below a component; the component for an empty path; None for an unknown path."""
    for token in split_path_into_names_and_indices(path):
        if isinstance(token, int):
            part = part[token] if isinstance(part, tuple) and token < len(part) else None
        else:
            part = part.get(token) if isinstance(part, Mapping) else getattr(part, token, None)
    return part


def _has_parameter(part: Any, name: str | int) -> bool:
    """Return whether a component itself, not a component inside it, has a parameter with a name."""
    if not is_dataclass(part):
        return False
    return any(each.path == name for each in _iterate_own_parameters(part, ""))


def _iterate_parameters(part: Any, place: str) -> Iterator[Parameter]:
    """Yield every parameter of a part and of the parts below it."""
    yield from _iterate_own_parameters(part, place)
    for entry in fields(part):
        content = getattr(part, entry.name)
        if get_field_declaration(entry) is not None:
            continue
        if is_dataclass(content):
            yield from _iterate_parameters(content, f"{place}{entry.name}.")
        elif isinstance(content, tuple) and content and all(map(is_dataclass, content)):
            for index, item in enumerate(content):
                yield from _iterate_parameters(item, f"{place}{entry.name}[{index}].")
        elif isinstance(content, Mapping) and content and all(map(is_dataclass, content.values())):
            for name, item in content.items():
                yield from _iterate_parameters(item, f"{place}{entry.name}.{name}.")


def _iterate_own_parameters(part: Any, place: str) -> Iterator[Parameter]:
    """Yield the parameters of a part itself, from fields and `non_field_parameters`, without those of parts in it."""
    if _has_non_field_parameters(part):
        for name, (what, number) in part.non_field_parameters().items():
            yield Parameter(place + name, what, number, type(part))
    for entry in fields(part):
        stated = get_field_declaration(entry)
        if stated is not None:
            content = getattr(part, entry.name)
            content = stated.words.get(content, content) if isinstance(content, str) else content
            if isinstance(content, Real) and not isinstance(content, bool):
                yield Parameter(place + entry.name, stated, float(content), type(part))


def _has_non_field_parameters(part: Any) -> TypeGuard[HasNonFieldParameters]:
    """Return whether a part implements `HasNonFieldParameters`."""
    return _implements_non_field_parameters(type(part))  # type: ignore[arg-type]


@cache
def _implements_non_field_parameters(kind: type) -> bool:
    """Whether a class implements `HasNonFieldParameters`; cached, because `issubclass` with a protocol is slow."""
    return issubclass(kind, HasNonFieldParameters)


def _replace_values_in_component(part: Any, tree: Mapping[Any, Any]) -> Any:
    """Return a copy of a component, tuple or mapping with the values of a nested mapping of names and indices."""
    if isinstance(part, tuple):
        return tuple(_replace_values_in_component(item, tree[index]) if index in tree else item for index,
                     item in enumerate(part))
    if isinstance(part, Mapping):
        return {name: _replace_values_in_component(item, tree[name]) if name in tree else item for name,
                item in part.items()}
    changes = {name: _replace_values_in_component(getattr(part, name), sub) if isinstance(sub, dict) else sub
               for name, sub in tree.items()}
    if _has_non_field_parameters(part):
        own = {name: changes.pop(name) for name in part.non_field_parameters() if name in changes}
        if own:
            return part.with_non_field_parameters(own, **changes)
    return replace(part, **changes)
