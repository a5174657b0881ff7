"""Checks of the options that select columns: delimiter, decimal mark, column numbers and the map ``columns``."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from typing import Any

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.recording.formats.number_text import DECIMAL_MARKS
from tissue_sim.recording.measures import require_valid_measure
from tissue_sim.recording.recording import CHANNELS, LABELS

#: Keys of an entry of ``columns``.
_KEYS = ("name", "column", "unit", "sign", "scale", "offset", "measure")
#: Largest valid column number.
_MAX_COLUMN_NUMBER = 1_000_000
#: Letters of a column of a spreadsheet, up to XFD.
_LETTERS = re.compile(r"[A-Za-z]{1,3}")


def validate_decimal_mark(decimal: Any, field: str = "decimal") -> str:
    """Require that a decimal mark is valid, and return the mark.

    Raises:
        InputError: neither point nor comma; with the field.
    """
    if decimal not in DECIMAL_MARKS:
        raise InputError(f'must be "." or ","; got {decimal!r}. The other mark separates thousands.', field=field)
    return decimal


def validate_delimiter(delimiter: Any, field: str = "delimiter") -> str:
    """Require that a delimiter is valid, and return the delimiter.

    Raises:
        InputError: not one character, or a character of numbers or quoted cells; with the field.
    """
    if not isinstance(delimiter, str) or len(delimiter) != 1 or delimiter.isalnum() or delimiter in "\"'.+-\r\n":
        raise InputError(f'must be one character such as " ", "|" or ";"; got {delimiter!r}', field=field)
    return delimiter


def normalize_column_mapping(columns: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Check the option ``columns``; return channel -> mapping with ``name`` or ``column`` (from 1) and other keys.

    Raises:
        InputError: unknown channel or key, wrong type; with the field, such as ``columns.force.sign``.
    """
    if not isinstance(columns, Mapping) or not columns:
        raise InputError('expected a map of channels to column names such as { force = "Load (N)" }', field="columns")
    checked = {}
    for channel, entry in columns.items():
        field = f"columns.{channel}"
        if channel not in CHANNELS and channel not in LABELS:
            raise InputError(
                f"unknown channel{make_hint_with_similar_or_known_words(str(channel), (*CHANNELS, *LABELS))}",
                field=field)
        entry = {"name": entry} if isinstance(entry, str) else entry
        if not isinstance(entry, Mapping):
            raise InputError(f"must be a column name or a map with name or column, unit and sign; got {entry!r}",
                             field=field)
        for key, value in entry.items():
            if key not in _KEYS:
                raise InputError(f"unknown key{make_hint_with_similar_or_known_words(str(key), _KEYS)}",
                                 field=f"{field}.{key}")
            if key == "sign" and (isinstance(value, bool) or value not in (1, -1)):
                raise InputError(f"must be 1 or -1; got {value!r}", field=f"{field}.sign")
            if key in ("name", "unit") and not isinstance(value, str):
                raise InputError(f"must be text in quotation marks; got {value!r}", field=f"{field}.{key}")
            number = isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max
            if key == "scale" and not (number and value > 0):
                raise InputError(f"must be a positive number; got {value!r}. State the direction with sign.",
                                 field=f"{field}.scale")
            if key == "offset" and not number and value != "start":
                raise InputError(f'must be a finite number or "start"; got {value!r}. "start" subtracts the first '
                                 "value.", field=f"{field}.offset")
        if "column" in entry:
            if "name" in entry:
                raise InputError("give either the name or the number of the column", field=f"{field}.column")
            entry = {**entry, "column": parse_column_number_or_letters(entry["column"], f"{field}.column")}
        elif not entry.get("name", "").strip():
            raise InputError("the name of the column is missing", field=f"{field}.name")
        if "measure" in entry:
            require_valid_measure(entry["measure"], channel, columns, field)
        if channel in LABELS and set(entry) & {"unit", "sign", "scale", "offset"}:
            raise InputError("a label has no unit, sign, scale or offset; give only the name of the column",
                             field=field)
        checked[channel] = dict(entry)
    return checked


def parse_column_number_or_letters(column: Any, field: str = "column") -> int:
    """Return the number of a column, from 1, for a number or for letters of a spreadsheet: ``"AB"`` gives 28.

    Raises:
        InputError: neither; with the field.
    """
    if isinstance(column, str) and _LETTERS.fullmatch(column):
        number = 0
        for letter in column.upper():
            number = 26 * number + ord(letter) - ord("A") + 1
        column = number
    if isinstance(column, bool) or not isinstance(column, int) or not 1 <= column <= _MAX_COLUMN_NUMBER:
        raise InputError(f'must be a number from 1 or a letter such as "C"; got {column!r}', field=field)
    return column
