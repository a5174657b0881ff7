"""Sheets of spreadsheets (xlsx, xls, ods) as rows of text, so that they are read as any other table."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import python_calamine as calamine
import xlrd

from tissue_sim.errors import InputError, located, nearest, reason_of
from tissue_sim.files import ZIP_MAGIC, first_bytes, read_bytes
from tissue_sim.recording.formats.cell_units import without_cell_units
from tissue_sim.recording.formats.number_text import ExactNumber
from tissue_sim.recording.formats.table import Row, Table

EXPECTED = "a spreadsheet (xlsx, xls, ods)"
#: How an .xls of Excel 97 to 2003 begins, and an xlsx with a password.
OLE_MAGIC = b"\xd0\xcf\x11\xe0"
#: Cells of the rectangle of a sheet.
_MOST_CELLS = 50_000_000
SUFFIXES = (".xlsx", ".xlsm", ".xlsb", ".xls", ".ods")


@dataclass(frozen=True)
class Sheet:
    """Rows with content of a sheet; `Row.line` is the number of the row in the spreadsheet."""

    file: Path
    name: str
    rows: tuple[Row, ...]

    def table(self, skip_rows: int = 0) -> Table:
        """The rows below the first `skip_rows`."""
        return Table(without_cell_units([row for row in self.rows if row.line > skip_rows]), name=self.name)

    def located(self) -> AbstractContextManager[None]:
        """Errors of the work inside name the sheet."""
        return located(file=self.file, part=f"sheet {self.name!r}")


def is_workbook(path: Path) -> bool:
    """Return whether the file is meant as a spreadsheet: by its first bytes or, failing these, by its name."""
    with_name = path.suffix.lower() in SUFFIXES
    return first_bytes(path, len(ZIP_MAGIC)) in (ZIP_MAGIC, OLE_MAGIC) or with_name


def read_sheets(path: Path, sheet: str | int | Sequence[str | int] | None = None) -> tuple[Sheet, ...]:
    """Sheets of a spreadsheet that hold anything, with the values that are stored; dates stay text.

    Args:
        path: the file.
        sheet: name, or number from 1, or a list of them. None: all that hold anything.

    Raises:
        InputError: no spreadsheet, no such sheet, or none that holds anything.
    """
    wanted = sheet if isinstance(sheet, list | tuple) else () if sheet is None else (sheet,)
    for each in wanted:
        if isinstance(each, bool) or not isinstance(each, str | int):
            raise InputError(f"{each!r} is not a sheet; give its name or its number from 1, or a list of them",
                             file=path, field="sheet")
    data = read_bytes(path, EXPECTED)
    try:
        found = list((_old_sheets if data.startswith(OLE_MAGIC) else _sheets)(data, path, wanted))
    except InputError:
        raise
    # A damaged archive may end the parser, too: its panics derive from BaseException.
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt | SystemExit | GeneratorExit | MemoryError):
            raise
        raise InputError(f"cannot be read as {EXPECTED}: {reason_of(error)}; open it in a spreadsheet program and save "
                         "it again", file=path) from None
    filled = tuple(each for each in found if each.rows)
    if not filled:
        raise InputError(f"is empty, expected {EXPECTED} with a table", file=path,
                         field=None if sheet is None else "sheet")
    return filled


def read_sheet(path: Path, sheet: str | int | None = None) -> Sheet:
    """Read one sheet; None: the only sheet with content. See `read_sheets` for the arguments.

    Raises:
        InputError: several that hold anything.
    """
    filled = read_sheets(path, sheet)
    if len(filled) > 1:
        raise InputError(f"{len(filled)} sheets hold something; choose one with sheet = "
                         f"{' or '.join(repr(each.name) for each in filled)}", file=path, field="sheet")
    return filled[0]


def _sheets(data: bytes, path: Path, wanted: Sequence[str | int]) -> Iterator[Sheet]:
    """Read the sheets of an xlsx or ods file."""
    _check_extent(data, path)
    with calamine.load_workbook(io.BytesIO(data)) as book:
        for name in _chosen(path, wanted, book.sheet_names):
            yield Sheet(path, name, _rows(book.get_sheet_by_name(name).to_python(skip_empty_area=False)))


def _old_sheets(data: bytes, path: Path, wanted: Sequence[str | int]) -> Iterator[Sheet]:
    """Read the sheets of an xls file."""
    try:
        book = xlrd.open_workbook(file_contents=data, logfile=io.StringIO(), ragged_rows=True)
    except xlrd.XLRDError as error:
        if "encrypted" in str(error):
            raise InputError("has a password; save it without one", file=path) from None
        raise
    for name in _chosen(path, wanted, book.sheet_names()):
        sheet = book.sheet_by_name(name)
        # What a formula makes of a fault has no value.
        yield Sheet(path, name, _rows([["" if cell.ctype == xlrd.XL_CELL_ERROR else cell.value for cell in sheet.row(i)]
                                       for i in range(sheet.nrows)]))


def _check_extent(data: bytes, path: Path) -> None:
    """Refuse a sheet that reaches so far that its rectangle does not fit the memory: calamine ends the process there.

    Raises:
        InputError: such a sheet.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        for name in archive.namelist():
            if not name.startswith("xl/worksheets/") or not name.endswith(".xml"):
                continue
            content = archive.read(name)
            rows = max(map(int, re.findall(rb'<row [^>]*?\br="(\d{1,9})"', content)), default=0)
            letters = {match.decode() for match in re.findall(rb'<c [^>]*?\br="([A-Z]{1,9})', content)}
            columns = max(letters, key=lambda each: (len(each), each), default="A")
            width = sum(26**i * (ord(letter) - 64) for i, letter in enumerate(reversed(columns)))
            if rows * width > _MOST_CELLS:
                raise InputError(f"a sheet ({Path(name).stem}) reaches to cell {columns}{rows}; clear what stands far "
                                 "from the table", file=path)


def _rows(cells: Iterable[Iterable[Any]]) -> tuple[Row, ...]:
    numbered = (Row(number, tuple(map(_text, row))) for number, row in enumerate(cells, start=1))
    return tuple(row for row in numbered if not row.blank)


def _chosen(path: Path, wanted: Sequence[str | int], names: list[str]) -> Iterable[str]:
    return dict.fromkeys(_find(path, each, names) for each in wanted) if wanted else names


def _find(path: Path, sheet: str | int, names: list[str]) -> str:
    if isinstance(sheet, int):
        if not 1 <= sheet <= len(names):
            raise InputError(f"there is no sheet {sheet}; the file has {len(names)}", file=path, field="sheet")
        return names[sheet - 1]
    if sheet not in names:
        raise InputError(f"there is no sheet {sheet!r}{nearest(sheet, names)}", file=path, field="sheet")
    return sheet


def _text(value: Any) -> str:
    if isinstance(value, int | float) and not isinstance(value, bool):
        return ExactNumber(repr(value))
    return " ".join(str(value).split())
