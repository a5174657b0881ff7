"""Conversion between JSON and msgspec structs; errors name the dotted path of the field."""

from __future__ import annotations

import json
import math
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec.inspect import DictType, LiteralType, NoneType, StructType, UnionType, type_info

from tissue_sim.bounded import bounded
from tissue_sim.errors import InputError, nearest
from tissue_sim.files import LIMITS, read_text

#: Type in msgspec's messages -> words for users.
_WORDS = {"float": "a number", "int": "a whole number", "str": "text", "bool": "true or false", "null": "null",
          "object": "an object {...}", "array": "a list [...]"}


def read_json(path: str | Path, expected: str) -> Any:
    """Read the JSON value of a file.

    Args:
        path: the file.
        expected: description of the expected file, for the message.

    Raises:
        InputError: no such file, not text, damaged JSON (line and column), or a key that appears twice.
    """
    path = Path(path)
    text = read_text(path, expected, LIMITS.json)
    try:
        return parse_json(text)
    except InputError as error:
        raise error.located(file=path) from None
    except json.JSONDecodeError as error:
        raise InputError(f"damaged JSON at column {error.colno} ({error.msg}), expected {expected}; repair or restore "
                         "it", file=path, line=error.lineno) from None
    except ValueError as error:
        raise InputError(f"damaged JSON ({error}), expected {expected}; repair or restore it", file=path) from None


def parse_json(text: str) -> Any:
    """Parse a JSON text.

    Raises:
        InputError: a key that appears twice, half of a surrogate pair, or too many nested levels.
        ValueError: not JSON, or an integer that is too long.
    """
    try:
        value = json.loads(text, object_pairs_hook=_without_duplicates)
        if "\\u" in text:
            _require_whole_characters(value, "")
        return value
    except RecursionError:
        raise InputError("damaged JSON (nested too deep); repair or restore it") from None


def read_toml(path: str | Path, expected: str) -> dict[str, Any]:
    """Read a TOML file; arguments as in `read_json`.

    Raises:
        InputError: see `tissue_sim.files.read_text`; or not TOML (line).
    """
    path = Path(path)
    text = read_text(path, expected, LIMITS.toml)
    # In a bounded process, because Python's parser takes hours for keys with thousands of parts.
    return bounded(_parse_toml, text, file=path, size=len(text))


def _parse_toml(text: str) -> dict[str, Any]:
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        place = re.search(r"\(at line (\d+), column (\d+)\)", str(error))
        reason = re.sub(r"\s*\(at .*\)$", "", str(error))
        where = f" at column {place[2]}" if place else ""
        raise InputError(f"this is not valid TOML: {reason}{where}", line=int(place[1]) if place else None) from None
    except ValueError as error:
        raise InputError(f"this is not valid TOML: {error}") from None


def decode(value: Any, kind: Any, field: str = "", words: Mapping[str, str] | None = None) -> Any:
    """Convert a value of JSON types to a struct.

    Args:
        value: decoded JSON; a struct of the type is returned unchanged.
        kind: a `msgspec.Struct` type, or an optional one.
        field: dotted path of `value`, for the message.
        words: names of JSON's types, if the file has another format.

    Raises:
        InputError: unknown key or choice (the message names the nearest), missing key, wrong type; with the path.
    """
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        message, _, place = str(error).partition(" - at `$")
    except OverflowError:
        message, place = "A number is too large for a float", ""
    place = place.rstrip("`").lstrip(".")
    path = ".".join(part for part in (field, place) if part)
    if unknown := re.search(r"unknown field `(.*)`$", message):
        raise InputError(f"unknown key{nearest(unknown[1], _find_keys(kind, place))}",
                         field=f"{path}.{unknown[1]}".lstrip("."))
    if missing := re.search(r"missing required field `(.*)`$", message):
        hint = "; give a unit such as Pa, kPa or 1" if missing[1] == "unit" else "; add it"
        raise InputError(f"is missing{hint}", field=f"{path}.{missing[1]}".lstrip("."))
    if choice := re.match(r"Invalid enum value '(.*)'$", message):
        raise InputError(f"unknown value {choice[1]!r}{nearest(choice[1], _find_choices(kind, place))}", field=path)
    known = {**_WORDS, **(words or {})}
    sentence = re.sub(r"`([^`]*)`", lambda match: " or ".join(known.get(word, word) for word in match[1].split(" | ")),
                      message)
    raise InputError(sentence[0].lower() + sentence[1:], field=path or None)


def require_schema(data: Any, kind: str, newest: int) -> None:
    """Require the ``schema`` of a kind of file, ``tissue_sim/KIND/VERSION``, in decoded JSON.

    Args:
        data: decoded JSON.
        kind: ``"rig"``.
        newest: newest supported version.

    Raises:
        InputError: not an object, no schema, another schema, or a newer version.
    """
    if not isinstance(data, dict):
        raise InputError('expected an object { "schema": ... }, found something else')
    schema, expected = data.get("schema"), f"tissue_sim/{kind}/{newest}"
    version = re.fullmatch(rf"tissue_sim/{kind}/([0-9]{{1,9}})", schema) if isinstance(schema, str) else None
    if not version or int(version[1]) < 1:
        found = "the schema is missing" if schema is None else f"{schema!r} is not a {kind} schema"
        raise InputError(f"{found}, expected {expected!r}", field="schema")
    if int(version[1]) > newest:
        raise InputError(f"{schema!r} was written by a newer version, expected {expected!r}; update tissue-sim",
                         field="schema")


def as_json_types(value: Any) -> Any:
    """Convert structs, read-only maps, tuples, numpy numbers and paths to types that JSON supports.

    Raises:
        TypeError: a value without an equivalent in JSON.
    """
    if isinstance(value, msgspec.Struct):
        return as_json_types(msgspec.to_builtins(value))
    if isinstance(value, np.generic | np.ndarray):
        return as_json_types(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): as_json_types(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_json_types(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{type(value).__name__} has no equivalent in JSON")


def require_writable(value: Any, field: str = "") -> None:
    """Require that decoded JSON can be written as UTF-8: no NaN, infinity or half of a surrogate pair anywhere.

    Raises:
        InputError: with the dotted path of the value.
    """
    _require_whole_characters(value, field)
    _require_finite(value, field)


def _require_finite(value: Any, field: str) -> None:
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"{value} is not a finite number; give a finite one, or leave the key out", field=field)
    if isinstance(value, Mapping):
        for key, item in value.items():
            _require_finite(item, f"{field}.{key}".lstrip("."))
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            _require_finite(item, f"{field}[{index}]")


def _require_whole_characters(value: Any, field: str) -> None:
    if isinstance(value, str) and any("\ud800" <= character <= "\udfff" for character in value):
        raise InputError(f"{value!r} contains half of a surrogate pair, expected whole characters", field=field)
    if isinstance(value, Mapping):
        for key, item in value.items():
            _require_whole_characters(key, field)
            _require_whole_characters(item, f"{field}.{key}".lstrip("."))
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            _require_whole_characters(item, f"{field}[{index}]")


def _without_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    seen: dict[str, Any] = {}
    for key, value in pairs:
        if key in seen:
            raise InputError(f"key {key!r} appears twice; remove one")
        seen[key] = value
    return seen


def _find_keys(kind: Any, place: str) -> list[str]:
    """Keys of the struct at a dotted path such as ``provenance.recordings[0]``."""
    return [field.encode_name for field in _find_struct_type(_find_type(kind, place)).fields]


def _find_choices(kind: Any, place: str) -> list[str]:
    """Valid values of the text at a dotted path."""
    info = _find_type(kind, place)
    options = info.types if isinstance(info, UnionType) else (info,)
    return [str(choice) for option in options if isinstance(option, LiteralType) for choice in option.values]


def _find_type(kind: Any, place: str) -> Any:
    info = type_info(kind)
    for name in filter(None, re.split(r"\.|\[[^\]]*\]", place)):
        info = next(field.type for field in _find_struct_type(info).fields if field.encode_name == name)
    return info


def _find_struct_type(info: Any) -> StructType:
    """Struct type inside of options, lists and maps."""
    while not isinstance(info, StructType):
        if isinstance(info, UnionType):
            info = next(option for option in info.types if not isinstance(option, NoneType))
        else:
            info = info.value_type if isinstance(info, DictType) else info.item_type
    return info
