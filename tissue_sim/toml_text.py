"""Tables as TOML text: the standard library reads TOML but does not write it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any


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
