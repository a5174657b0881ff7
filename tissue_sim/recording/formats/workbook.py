"""Sheets of xlsx spreadsheets as rows of text, so that they are read as any other table."""

from __future__ import annotations

import io
import warnings
import zipfile
from contextlib import closing
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

from tissue_sim.errors import InputError, nearest
from tissue_sim.files import ZIP_MAGIC, read_bytes
from tissue_sim.recording.formats.extra import require
from tissue_sim.recording.formats.table import Row

EXPECTED = "a spreadsheet (xlsx)"
#: How an .xls of Excel 97 to 2003 begins, and an xlsx with a password.
_OLE_MAGIC = b"\xd0\xcf\x11\xe0"


@dataclass(frozen=True)
class Sheet:
    """A sheet's rows that hold anything; `Row.line` is the number of the row in the spreadsheet."""

    name: str
    rows: tuple[Row, ...]


def is_workbook(path: Path) -> bool:
    """Whether the file is meant as a spreadsheet: by its first bytes or, failing these, by its name."""
    with_name = path.suffix.lower() in (".xlsx", ".xlsm")
    try:
        with path.open("rb") as file:
            return file.read(len(ZIP_MAGIC)) == ZIP_MAGIC or with_name
    except (OSError, ValueError):
        return with_name


def read_sheet(path: Path, sheet: str | int | None = None) -> Sheet:
    """A sheet of an xlsx file with the values that are stored; a formula without one stays text, as dates do.

    Args:
        path: the file.
        sheet: name, or number from 1. None: the only sheet that holds anything.

    Raises:
        InputError: no spreadsheet, no such sheet, none or several that hold anything, or openpyxl is not installed.
    """
    if sheet is not None and (isinstance(sheet, bool) or not isinstance(sheet, str | int)):
        raise InputError(f"{sheet!r} is not a sheet; give its name or its number from 1", file=path, field="sheet")
    data = read_bytes(path, EXPECTED)
    if data.startswith(_OLE_MAGIC):
        raise InputError(f"is an old spreadsheet (.xls) or one with a password, expected {EXPECTED}; save it as .xlsx "
                         "without a password", file=path)
    openpyxl = require("openpyxl", path)
    try:
        sheets = _sheets(openpyxl, data, path, sheet)
    except InputError:
        raise
    except Exception as error:  # whatever a damaged archive makes of openpyxl and its XML parser
        reason = " ".join(str(error).split()) or type(error).__name__
        raise InputError(f"cannot be read as {EXPECTED}: {reason}; open it in a spreadsheet program and save it again",
                         file=path) from None
    filled = [each for each in sheets if each.rows]
    if not filled:
        raise InputError(f"is empty, expected {EXPECTED} with a table", file=path,
                         field=None if sheet is None else "sheet")
    if len(filled) > 1:
        raise InputError(f"{len(filled)} sheets hold something; choose one with sheet = "
                         f"{' or '.join(repr(each.name) for each in filled)}", file=path, field="sheet")
    return filled[0]


def _sheets(openpyxl: Any, data: bytes, path: Path, sheet: str | int | None) -> list[Sheet]:
    """The sheet asked for, or all of them."""
    values = _rows(openpyxl, data, path, sheet, stored=True)
    if _has_formulas(data):
        formulas = _rows(openpyxl, data, path, sheet, stored=False)
        values = {name: [tuple(cell or text for cell, text in zip_longest(*pair, fillvalue=""))
                         for pair in zip_longest(rows, formulas[name], fillvalue=())]
                  for name, rows in values.items()}
    found = []
    for name, rows in values.items():
        numbered = (Row(number, cells) for number, cells in enumerate(rows, start=1))
        found.append(Sheet(name, tuple(row for row in numbered if not row.blank)))
    return found


def _rows(openpyxl: Any, data: bytes, path: Path, sheet: str | int | None, *,
          stored: bool) -> dict[str, list[tuple[str, ...]]]:
    """Cells as text, of stored values or of formulas: name of the sheet -> rows."""
    with warnings.catch_warnings():
        # openpyxl warns of drawings, validation lists and styles that it leaves out.
        warnings.simplefilter("ignore", UserWarning)
        with closing(openpyxl.load_workbook(io.BytesIO(data), read_only=True, data_only=stored)) as book:
            names = [each.title for each in book.worksheets]
            chosen = {}
            for name in names if sheet is None else [_find(path, sheet, names)]:
                # Some programs write a wrong size of the sheet, at which openpyxl would stop.
                book[name].reset_dimensions()
                chosen[name] = [tuple(map(_text, cells)) for cells in book[name].iter_rows(values_only=True)]
            return chosen


def _find(path: Path, sheet: str | int, names: list[str]) -> str:
    if isinstance(sheet, int):
        if not 1 <= sheet <= len(names):
            raise InputError(f"there is no sheet {sheet}; the file has {len(names)}", file=path, field="sheet")
        return names[sheet - 1]
    if sheet not in names:
        raise InputError(f"there is no sheet {sheet!r}{nearest(sheet, names)}", file=path, field="sheet")
    return sheet


def _has_formulas(data: bytes) -> bool:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return any(b"<f" in archive.read(name) for name in archive.namelist() if name.startswith("xl/worksheets/"))


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return repr(value)
    return " ".join(str(value).split())
