"""Conversion between JSON or TOML and msgspec structs; errors name the dotted path of the field.

The standard library reads TOML but does not write it; `format_toml` does.
"""

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

from tissue_sim.bounded import run_in_sandbox
from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.files import LIMITS, read_text


def format_toml(content: Mapping[str, Any]) -> str:
    """Write tables, lists of tables and plain values as TOML text."""
    plain = [_format_toml_entry((name, value)) for name, value in content.items()
             if not isinstance(value, Mapping) and not _is_list_of_tables(value)]
    parts = ["\n".join(plain)] if plain else []
    for name, value in content.items():
        if isinstance(value, Mapping):
            inner = {key: each for key, each in value.items() if not isinstance(each, Mapping)}
            parts.append(f"[{_format_toml_key(name)}]\n{format_toml(inner)}".rstrip())
            parts += [f"[{_format_toml_key(name)}.{_format_toml_key(key)}]\n{format_toml(each)}".rstrip()
                      for key, each in value.items() if isinstance(each, Mapping)]
        elif _is_list_of_tables(value):
            parts += [f"[[{_format_toml_key(name)}]]\n" + "\n".join(map(_format_toml_entry, table.items()))
                      for table in value]
    return "\n\n".join(parts) + "\n"


def _is_list_of_tables(value: Any) -> bool:
    """Return whether a value is a list of mappings with at least one item (an array of tables in TOML)."""
    return isinstance(value, list) and bool(value) and all(isinstance(each, Mapping) for each in value)


def _format_toml_key(name: str) -> str:
    """Return a TOML key with quotation marks if necessary."""
    return name if name.replace("_", "").replace("-", "").isalnum() and name.isascii() else json.dumps(name)


def _format_toml_entry(entry: tuple[str, Any]) -> str:
    """Return a key and its value as a line of TOML, such as ``kind = "compression"``."""
    return f"{_format_toml_key(entry[0])} = {_format_toml_value(entry[1])}"


def _format_toml_value(value: Any) -> str:
    """Return a value as TOML text; a mapping becomes an inline table."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return repr(value) if value == value and abs(value) != float("inf") else f"{value}"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(map(_format_toml_entry, value.items())) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_format_toml_value, value)) + "]"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else str(value)


#: Type in msgspec's messages -> words for users.
_WORDS = {"float": "a number", "int": "a whole number", "str": "text", "bool": "true or false", "null": "null",
          "object": "an object {...}", "array": "a list [...]"}


def read_json_value(path: str | Path, expected: str) -> Any:
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
        return parse_json_rejecting_duplicate_keys(text)
    except InputError as error:
        raise error.with_location(file=path) from None
    except json.JSONDecodeError as error:
        raise InputError(f"damaged JSON at column {error.colno} ({error.msg}), expected {expected}; repair or restore "
                         "it", file=path, line=error.lineno) from None
    except ValueError as error:
        raise InputError(f"damaged JSON ({error}), expected {expected}; repair or restore it", file=path) from None


def parse_json_rejecting_duplicate_keys(text: str) -> Any:
    """Parse a JSON text.

    Raises:
        InputError: a key that appears twice, half of a surrogate pair, or too many nested levels.
        ValueError: not JSON, or an integer that is too long.
    """
    try:
        value = json.loads(text, object_pairs_hook=_make_dict_rejecting_duplicate_keys)
        if "\\u" in text:
            _require_no_lone_surrogates(value, "")
        return value
    except RecursionError:
        raise InputError("damaged JSON (nested too deep); repair or restore it") from None


def read_toml_dict(path: str | Path, expected: str) -> dict[str, Any]:
    """Read a TOML file; arguments as in `read_json_value`.

    Raises:
        InputError: see `tissue_sim.files.read_text`; or not TOML (line).
    """
    path = Path(path)
    text = read_text(path, expected, LIMITS.toml)
    # In a bounded process, because Python's parser takes hours for keys with thousands of parts.
    return run_in_sandbox(_parse_toml_text, text, file=path, size=len(text))


def _parse_toml_text(text: str) -> dict[str, Any]:
    """Parse a TOML text; raise an `InputError` with the line of a syntax error."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        place = re.search(r"\(at line (\d+), column (\d+)\)", str(error))
        reason = re.sub(r"\s*\(at .*\)$", "", str(error))
        where = f" at column {place[2]}" if place else ""
        raise InputError(f"this is not valid TOML: {reason}{where}", line=int(place[1]) if place else None) from None
    except ValueError as error:
        raise InputError(f"this is not valid TOML: {error}") from None


def decode_struct(value: Any, kind: Any, field: str = "", words: Mapping[str, str] | None = None) -> Any:
    """Convert a value of JSON types to a msgspec struct, and check it.

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
        raise InputError(
            f"unknown key{make_hint_with_similar_or_known_words(unknown[1], _list_struct_keys_at_path(kind, place))}",
            field=f"{path}.{unknown[1]}".lstrip("."))
    if missing := re.search(r"missing required field `(.*)`$", message):
        hint = "; give a unit such as Pa, kPa or 1" if missing[1] == "unit" else "; add it"
        raise InputError(f"is missing{hint}", field=f"{path}.{missing[1]}".lstrip("."))
    if choice := re.match(r"Invalid enum value '(.*)'$", message):
        hint = make_hint_with_similar_or_known_words(choice[1], _list_valid_choices_at_path(kind, place))
        raise InputError(f"unknown value {choice[1]!r}{hint}", field=path)
    known = {**_WORDS, **(words or {})}
    sentence = re.sub(r"`([^`]*)`", lambda match: " or ".join(known.get(word, word) for word in match[1].split(" | ")),
                      message)
    raise InputError(sentence[0].lower() + sentence[1:], field=path or None)


def require_schema_kind_and_max_version(data: Any, kind: str, newest: int) -> None:
    """Raise an error unless decoded JSON has the ``schema`` of a kind of file, ``tissue_sim/KIND/VERSION``.

    Args:
        data: decoded JSON.
        kind: kind of file, such as ``"rig"``.
        newest: newest supported version.

    Raises:
        InputError: not an object, no schema, another schema, or a newer version.
    """
    if not isinstance(data, dict):
        raise InputError('file must contain an object { "schema": ... }; got '
                         f"{type(data).__name__}. Choose a file of this kind.")
    schema, expected = data.get("schema"), f"tissue_sim/{kind}/{newest}"
    version = re.fullmatch(rf"tissue_sim/{kind}/([0-9]{{1,9}})", schema) if isinstance(schema, str) else None
    if not version or int(version[1]) < 1:
        found = "the schema is missing" if schema is None else f"{schema!r} is not a {kind} schema"
        raise InputError(f"{found}, expected {expected!r}", field="schema")
    if int(version[1]) > newest:
        raise InputError(f"{schema!r} was written by a newer version, expected {expected!r}; update tissue-sim",
                         field="schema")


def convert_to_json_types(value: Any) -> Any:
    """Convert structs, read-only maps, tuples, numpy numbers and paths to types that JSON supports.

    Raises:
        TypeError: a value without an equivalent in JSON.
    """
    if isinstance(value, msgspec.Struct):
        return convert_to_json_types(msgspec.to_builtins(value))
    if isinstance(value, np.generic | np.ndarray):
        return convert_to_json_types(value.tolist())
    if isinstance(value, Mapping):
        return {str(key): convert_to_json_types(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [convert_to_json_types(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{type(value).__name__} has no equivalent in JSON")


def require_valid_json_values(value: Any, field: str = "") -> None:
    """Raise an error if decoded JSON cannot be written as UTF-8: NaN, infinity, or half of a surrogate pair.

    Raises:
        InputError: the error names the dotted path of the value.
    """
    _require_no_lone_surrogates(value, field)
    _require_finite_numbers(value, field)


def _require_finite_numbers(value: Any, field: str) -> None:
    """Raise an `InputError` for a number in nested maps and lists that is not finite; `field`: path of `value`."""
    if isinstance(value, float) and not math.isfinite(value):
        raise InputError(f"number must be finite; got {value}. Give a finite number, or leave out the key.",
                         field=field)
    if isinstance(value, Mapping):
        for key, item in value.items():
            _require_finite_numbers(item, f"{field}.{key}".lstrip("."))
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            _require_finite_numbers(item, f"{field}[{index}]")


def _require_no_lone_surrogates(value: Any, field: str) -> None:
    """Raise an `InputError` for a text in nested maps and lists that has half of a surrogate pair."""
    if isinstance(value, str) and any("\ud800" <= character <= "\udfff" for character in value):
        raise InputError(f"text must consist of whole characters; got half of a surrogate pair in {value!r}. Write the "
                         "character as UTF-8.", field=field)
    if isinstance(value, Mapping):
        for key, item in value.items():
            _require_no_lone_surrogates(key, field)
            _require_no_lone_surrogates(item, f"{field}.{key}".lstrip("."))
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            _require_no_lone_surrogates(item, f"{field}[{index}]")


def _make_dict_rejecting_duplicate_keys(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Make a dictionary of the pairs of a JSON object; raise an `InputError` for a key that appears twice."""
    seen: dict[str, Any] = {}
    for key, value in pairs:
        if key in seen:
            raise InputError(f"key must appear once in an object; got {key!r} twice. Remove one of the two.")
        seen[key] = value
    return seen


def _list_struct_keys_at_path(kind: Any, place: str) -> list[str]:
    """Return the keys of the struct at a dotted path such as ``provenance.recordings[0]`` below the type `kind`."""
    return [field.encode_name for field in _unwrap_struct_type(_find_type_at_path(kind, place)).fields]


def _list_valid_choices_at_path(kind: Any, place: str) -> list[str]:
    """Return the valid values of the text at a dotted path below the type `kind`."""
    info = _find_type_at_path(kind, place)
    options = info.types if isinstance(info, UnionType) else (info,)
    return [str(choice) for option in options if isinstance(option, LiteralType) for choice in option.values]


def _find_type_at_path(kind: Any, place: str) -> Any:
    """Return the msgspec type information at a dotted path below the type `kind`."""
    info = type_info(kind)
    for name in filter(None, re.split(r"\.|\[[^\]]*\]", place)):
        info = next(field.type for field in _unwrap_struct_type(info).fields if field.encode_name == name)
    return info


def _unwrap_struct_type(info: Any) -> StructType:
    """Return the struct type that an optional type, a list type or a map type contains."""
    while not isinstance(info, StructType):
        if isinstance(info, UnionType):
            info = next(option for option in info.types if not isinstance(option, NoneType))
        else:
            info = info.value_type if isinstance(info, DictType) else info.item_type
    return info
