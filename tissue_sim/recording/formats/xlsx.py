"""Read recordings from spreadsheets (xlsx, xls, ods) with the native header or with chosen columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tissue_sim.recording.formats.columns import Sheets, read_recordings_from_columns
from tissue_sim.recording.formats.native import read_native_rows
from tissue_sim.recording.formats.sheets import Sheet, read_sheet, read_sheets
from tissue_sim.recording.formats.table import select_cells_and_drop_blank_rows
from tissue_sim.recording.recording import Recording


def read_xlsx(path: str | Path, *, columns: Mapping[str, Any] | None = None, sheet: Sheets | None = None,
              skip_lines: int = 0) -> Recording | tuple[Recording, ...]:
    """Read a recording from a sheet of a spreadsheet.

    Args:
        path: the file.
        columns: see `tissue_sim.recording.formats.columns.read_recordings_from_columns`. None: the first row of the
            sheet is a native header with one name per cell, such as ``time [s]``, ``displacement [mm]``, ``force [N]``.
        sheet: name or number (from 1), or a list of names and numbers. None: the only sheet with content.
        skip_lines: number of rows at the top that are ignored; with `columns` only.

    Raises:
        InputError: no such spreadsheet, sheet or column, or an invalid cell; with file, sheet and row.
    """
    if columns is not None:
        found = read_recordings_from_columns(path, columns, sheet=sheet, skip_lines=skip_lines)
        return found if len(found) > 1 else found[0]
    if isinstance(sheet, Sequence) and not isinstance(sheet, str):
        return tuple(_read_native_sheet(each) for each in read_sheets(Path(path), sheet))
    return _read_native_sheet(read_sheet(Path(path), sheet))


def _read_native_sheet(found: Sheet) -> Recording:
    """Return the recording of a sheet with the native header; columns without a name and comment rows are omitted."""
    with found.located_errors():
        rows = [row for row in found.rows if not row.cells[0].startswith("#")]
        # Columns without a name are not part of the table.
        named = [i for i, cell in enumerate(rows[0].cells) if cell] if rows else []
        return read_native_rows(select_cells_and_drop_blank_rows(rows, named), found.file)
