"""Read the sheets of spreadsheets (xlsx, xls, ods) as rows of text."""

from __future__ import annotations

import io
import re
import zipfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tissue_sim.errors import (
    InputError,
    format_foreign_exception_message,
    located_and_converted_errors,
    make_hint_with_similar_or_known_words,
)
from tissue_sim.files import ZIP_MAGIC, read_bytes, read_first_bytes_or_empty
from tissue_sim.recording.formats.number_text import TextOfNumericCell
from tissue_sim.recording.formats.table import Table, TableRow, move_cell_units_to_unit_row

#: Expected content of the file, for messages.
EXPECTED_SPREADSHEET = "a spreadsheet (xlsx, xls, ods)"
#: First bytes of an xls file (Excel 97 to 2003), and of an xlsx file with a password.
OLE_MAGIC = b"\xd0\xcf\x11\xe0"
#: Largest number of cells (rows * columns) of a sheet, for which the memory suffices.
_MAX_CELLS = 50_000_000
#: Suffixes of spreadsheets.
SUFFIXES = (".xlsx", ".xlsm", ".xlsb", ".xls", ".ods")


@dataclass(frozen=True)
class Sheet:
    """Rows with content of a sheet; `TableRow.line` is the row number in the spreadsheet."""

    file: Path
    name: str
    rows: tuple[TableRow, ...]

    def build_table_below_skipped_rows(self, skip_rows: int = 0) -> Table:
        """Return the rows below the first `skip_rows` rows; units after the numbers are moved to a row of units."""
        return Table(move_cell_units_to_unit_row([row for row in self.rows if row.line > skip_rows]), name=self.name)

    def located_errors(self) -> AbstractContextManager[None]:
        """Return a context manager that adds the file and the name of this sheet to an `InputError` raised in it."""
        return located_and_converted_errors(file=self.file, part=f"sheet {self.name!r}")


def is_workbook(path: Path) -> bool:
    """Return whether a file is a spreadsheet by its first bytes or by its suffix."""
    with_name = path.suffix.lower() in SUFFIXES
    return read_first_bytes_or_empty(path, len(ZIP_MAGIC)) in (ZIP_MAGIC, OLE_MAGIC) or with_name


def read_sheets(path: Path, sheet: str | int | Sequence[str | int] | None = None) -> tuple[Sheet, ...]:
    """Read the sheets with content of a spreadsheet: stored values of formulas, dates as text.

    Args:
        path: the file.
        sheet: name, number (from 1), or a list of names and numbers; None: all sheets.

    Raises:
        InputError: not a spreadsheet, no such sheet, or all sheets are empty.
    """
    wanted = sheet if isinstance(sheet, list | tuple) else () if sheet is None else (sheet,)
    for each in wanted:
        if isinstance(each, bool) or not isinstance(each, str | int):
            raise InputError(f"must be the name or the number of a sheet, or a list of them; got {each!r}. Numbers "
                             "begin with 1.", file=path, field="sheet")
    data = read_bytes(path, EXPECTED_SPREADSHEET)
    try:
        iterate_sheets = _iterate_xls_sheets if data.startswith(OLE_MAGIC) else _iterate_xlsx_or_ods_sheets
        found = list(iterate_sheets(data, path, wanted))
    except InputError:
        raise
    # A damaged archive may cause a panic of the parser (Rust), which derives from BaseException.
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt | SystemExit | GeneratorExit | MemoryError):
            raise
        raise InputError(
            f"cannot be read as {EXPECTED_SPREADSHEET}: {format_foreign_exception_message(error)}; open the file in a "
            "spreadsheet program and save the file again", file=path) from None
    filled = tuple(each for each in found if each.rows)
    if not filled:
        raise InputError(f"is empty, expected {EXPECTED_SPREADSHEET} with a table", file=path,
                         field=None if sheet is None else "sheet")
    return filled


def read_sheet(path: Path, sheet: str | int | None = None) -> Sheet:
    """Read one sheet of a spreadsheet.

    Args:
        path: the file.
        sheet: name or number (from 1); None: the only sheet with content.

    Raises:
        InputError: several sheets with content; see also `read_sheets`.
    """
    filled = read_sheets(path, sheet)
    if len(filled) > 1:
        raise InputError(f"{len(filled)} sheets have content; choose one with sheet = "
                         f"{' or '.join(repr(each.name) for each in filled)}", file=path, field="sheet")
    return filled[0]


def _iterate_xlsx_or_ods_sheets(data: bytes, path: Path, wanted: Sequence[str | int]) -> Iterator[Sheet]:
    """Yield the requested sheets of an xlsx or ods file; all sheets without a request."""
    # Imported on use: the check of the options of a text file imports this module.
    import python_calamine as calamine

    _require_limited_cell_counts(data, path)
    with calamine.load_workbook(io.BytesIO(data)) as book:
        for name in _select_sheet_names(path, wanted, book.sheet_names):
            yield Sheet(path, name,
                        _convert_cells_to_rows(book.get_sheet_by_name(name).to_python(skip_empty_area=False)))


def _iterate_xls_sheets(data: bytes, path: Path, wanted: Sequence[str | int]) -> Iterator[Sheet]:
    """Yield the requested sheets of an xls file; all sheets without a request."""
    import xlrd

    try:
        book = xlrd.open_workbook(file_contents=data, logfile=io.StringIO(), ragged_rows=True)
    except xlrd.XLRDError as error:
        if "encrypted" in str(error):
            raise InputError("has a password; save the file without a password", file=path) from None
        raise
    for name in _select_sheet_names(path, wanted, book.sheet_names()):
        sheet = book.sheet_by_name(name)
        # A formula with an error, such as #DIV/0!, has no value.
        yield Sheet(path, name, _convert_cells_to_rows(
            ["" if cell.ctype == xlrd.XL_CELL_ERROR else cell.value for cell in sheet.row(i)]
            for i in range(sheet.nrows)))


def _require_limited_cell_counts(data: bytes, path: Path) -> None:
    """Check the number of cells of each sheet, because calamine aborts the process if the memory does not suffice.

    Raises:
        InputError: a sheet with more than `_MAX_CELLS` cells up to its last row and column.
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
            if rows * width > _MAX_CELLS:
                raise InputError(f"a sheet ({Path(name).stem}) reaches to cell {columns}{rows}; delete the cells far "
                                 "from the table", file=path)


def _convert_cells_to_rows(cells: Iterable[Iterable[Any]]) -> tuple[TableRow, ...]:
    """Convert the cells of a sheet to text, and return the rows with content."""
    numbered = (TableRow(number, tuple(map(_format_cell_value, row))) for number, row in enumerate(cells, start=1))
    return tuple(row for row in numbered if not row.is_blank)


def _select_sheet_names(path: Path, wanted: Sequence[str | int], names: list[str]) -> Iterable[str]:
    """Return the names of the requested sheets without repetitions; all names without a request."""
    return dict.fromkeys(_get_sheet_name_by_name_or_number(path, each, names) for each in wanted) if wanted else names


def _get_sheet_name_by_name_or_number(path: Path, sheet: str | int, names: list[str]) -> str:
    """Return the name of a sheet by name or number (from 1).

    Raises:
        InputError: no such sheet.
    """
    if isinstance(sheet, int):
        if not 1 <= sheet <= len(names):
            raise InputError(f"must be from 1 to {len(names)}, the number of sheets in the file; got {sheet}.",
                             file=path, field="sheet")
        return names[sheet - 1]
    if sheet not in names:
        raise InputError(f"there is no sheet {sheet!r}{make_hint_with_similar_or_known_words(sheet, names)}", file=path,
                         field="sheet")
    return sheet


def _format_cell_value(value: Any) -> str:
    """Return a value as text with single blanks; a number as `TextOfNumericCell`."""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return TextOfNumericCell(repr(value))
    return " ".join(str(value).split())
