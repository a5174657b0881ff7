"""Read spreadsheets (xlsx, xls, ods) and arrays in MATLAB, LabVIEW and HDF5 files as sheets: rows of text.

The vectors of equal length in a struct or group form a sheet with the names of the vectors as header. A matrix is a
sheet without a header.
"""

from __future__ import annotations

import importlib
import io
import logging
import re
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from tissue_sim.bounded import exclude_cpu_time_from_limit
from tissue_sim.errors import (
    InputError,
    format_foreign_exception_message,
    located_and_converted_errors,
    make_hint_with_similar_or_known_words,
)
from tissue_sim.files import ZIP_MAGIC, read_bytes, read_first_bytes_or_empty
from tissue_sim.recording.formats.number_text import TextOfNumericCell
from tissue_sim.recording.formats.table import Table, TableRow, move_cell_units_to_unit_row
from tissue_sim.recording.recording import MIN_POINTS

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


def import_optional_package(package: str, file: Path) -> ModuleType:
    """Import an optional package.

    Raises:
        InputError: the package is not installed; the message names the extra to install.
    """
    try:
        with exclude_cpu_time_from_limit():
            return importlib.import_module(package)
    except ImportError as error:
        raise InputError(f"reading this file needs the package {package} ({error}); install it with "
                         "pip install 'tissue-sim[formats]'", file=file) from None


#: Expected content of the file, for messages.
_EXPECTED = "arrays of MATLAB, LabVIEW or HDF5 (.mat, .tdms, .h5)"
#: First bytes of an HDF5 file.
_HDF5 = b"\x89HDF"
#: First bytes of a MATLAB file.
_MATLAB = b"MATL"
#: First bytes of a LabVIEW file.
_TDMS = b"TDSm"
#: Suffixes of containers.
_SUFFIXES = (".mat", ".tdms", ".h5", ".hdf5", ".hdf")


@dataclass(frozen=True)
class ContainerSettings:
    """Limits for arrays in a container.

    Attributes:
        most_columns: largest number of columns of a table; a wider matrix is a picture.
        most_numbers: largest number of values of a dataset.
    """

    most_columns: int = 64
    most_numbers: int = 50_000_000


#: Settings that the functions of this module use.
_SETTINGS = ContainerSettings()


def is_mat_tdms_or_hdf5_file(path: Path) -> bool:
    """Return whether a file is a container, by its first bytes or by its suffix."""
    return read_first_bytes_or_empty(path, 4) in (_HDF5, _MATLAB, _TDMS) or path.suffix.lower() in _SUFFIXES


def read_container_tables_as_sheets(path: Path,
                                    table: str | int | Sequence[str | int] | None = None) -> tuple[Sheet, ...]:
    """Read the tables of a container as sheets; the name of a sheet is the path of the table (``run.force``).

    Args:
        path: the file.
        table: name, number (from 1), or a list of names and numbers; None: all tables.

    Raises:
        InputError: a file that cannot be read, no such table, no table in the file, or the extra ``formats`` is not
            installed.
    """
    data = read_bytes(path, _EXPECTED)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tree = _read_container_tree(data, path)
            sheets = [Sheet(path, name, rows) for name, rows in _iterate_named_tables(tree, "")]
    except InputError:
        raise
    except Exception as error:  # a damaged file may cause any error of the three libraries, including MemoryError
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(f"cannot be read as {_EXPECTED}: {reason}", file=path) from None
    if not sheets:
        raise InputError(f"holds no vectors of numbers, expected {_EXPECTED}", file=path)
    wanted = table if isinstance(table, list | tuple) else () if table is None else (table,)
    names = [sheet.name for sheet in sheets]
    chosen = []
    for each in wanted:
        place = names.index(each) if each in names else each - 1 if isinstance(each, int) else -1
        if not 0 <= place < len(sheets):
            raise InputError(f"there is no table {each!r}{make_hint_with_similar_or_known_words(str(each), names)}",
                             file=path, field="sheet")
        chosen.append(sheets[place])
    return tuple(chosen) if wanted else tuple(sheets)


def _read_container_tree(data: bytes, path: Path) -> Mapping[str, Any]:
    """Return the groups of a container as nested maps: name -> group or array.

    Raises:
        ValueError: not a container.
    """
    if data[:4] == _TDMS:
        nptdms = import_optional_package("nptdms", path)
        nptdms.log.log_manager.set_level(logging.CRITICAL)
        return _read_tdms_arrays_with_units_in_names(nptdms.TdmsFile.read(io.BytesIO(data)))
    if data[:4] == _HDF5:
        with import_optional_package("h5py", path).File(io.BytesIO(data), "r") as file:
            return _read_hdf5_arrays_with_units_in_names(file)
    # The oldest MATLAB files have no common first bytes.
    if data[:4] != _MATLAB and path.suffix.lower() != ".mat":
        raise ValueError("the first bytes must be those of an HDF5, TDMS or MATLAB file")
    # A wrong length in a file may crash loadmat: `tissue_sim.bounded` reads the file in a separate process.
    return import_optional_package("scipy.io", path).loadmat(io.BytesIO(data), simplify_cells=True)


def _read_hdf5_arrays_with_units_in_names(group: Any) -> dict[str, Any]:
    """Return groups as maps and datasets as arrays; a unit in the attributes is added to the name."""
    tree: dict[str, Any] = {}
    for name, item in group.items():
        if hasattr(item, "items"):
            tree[name] = _read_hdf5_arrays_with_units_in_names(item)
            continue
        unit = item.attrs.get("units", item.attrs.get("unit"))
        unit = unit.decode("utf-8", "replace") if isinstance(unit, bytes) else unit
        if item.size is not None and item.size > _SETTINGS.most_numbers:
            raise ValueError(f"{name} has {item.size:g} numbers, more than {_SETTINGS.most_numbers:g}")
        value = item[()]
        if getattr(value, "dtype", None) is not None and value.dtype.names:
            tree[name] = {column: value[column] for column in value.dtype.names}
        else:
            # MATLAB writes its vectors as matrices of one column.
            tree[f"{name} [{unit}]" if isinstance(unit, str) else name] = np.squeeze(np.asarray(value))
    return tree


def _read_tdms_arrays_with_units_in_names(file: Any) -> dict[str, Any]:
    """Return group -> channel with unit -> array; a time is added from the sampling interval."""
    tree: dict[str, Any] = {}
    for group in file.groups():
        channels: dict[str, Any] = {}
        for channel in group.channels():
            unit = channel.properties.get("unit_string")
            channels[f"{channel.name} [{unit}]" if unit else channel.name] = channel[:]
            step = channel.properties.get("wf_increment")
            if isinstance(step, float) and step > 0:
                channels.setdefault("time [s]", step * np.arange(len(channel)))
        tree[group.name] = channels
    return tree


def _iterate_named_tables(tree: Mapping[str, Any], place: str) -> Iterator[tuple[str, tuple[TableRow, ...]]]:
    """Yield (name, rows) of each table in a tree of groups, depth first; `place` is the path of the root."""
    vectors: dict[int, dict[str, np.ndarray]] = {}
    for name, value in tree.items():
        if str(name).startswith(("__", "#")):
            continue
        below = f"{place}.{name}" if place else str(name)
        if isinstance(value, Mapping):
            yield from _iterate_named_tables(value, below)
            continue
        if isinstance(value, list) or (isinstance(value, np.ndarray) and value.dtype == object):
            members = {str(i): each for i, each in enumerate(value, start=1) if isinstance(each, Mapping)}
            yield from _iterate_named_tables(members, below)
            continue
        array = np.asarray(value)
        if array.dtype.kind not in "fiub":
            continue
        if array.ndim == 1 and array.size >= MIN_POINTS:
            vectors.setdefault(array.size, {})[str(name)] = array
        elif array.ndim == 2 and max(array.shape) >= MIN_POINTS and min(array.shape) <= _SETTINGS.most_columns:
            yield below, _format_matrix_rows([], array if array.shape[0] >= array.shape[1] else array.T)
    for size, columns in vectors.items():
        suffix = "" if len(vectors) == 1 else f" ({size})"
        yield (place or "arrays") + suffix, _format_matrix_rows(list(columns), np.column_stack(list(columns.values())))


def _format_matrix_rows(names: list[str], values: np.ndarray) -> tuple[TableRow, ...]:
    """Return a matrix, shape (rows, columns), as rows of text below a header; an empty list means no header."""
    header = [TableRow(1, tuple(names))] if names else []
    return (*header, *(TableRow(line, tuple(TextOfNumericCell(repr(each)) for each in numbers))
                       for line, numbers in enumerate(values.tolist(), start=2)))
