"""Read arrays in MATLAB (.mat), LabVIEW (.tdms) and HDF5 (.h5) files as tables.

The vectors of equal length in a struct or group form a table with the names of the vectors as header. A matrix is a
table without a header. Each table is read like a sheet of a spreadsheet.
"""

from __future__ import annotations

import importlib
import io
import logging
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from tissue_sim.bounded import exclude_cpu_time_from_limit
from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.files import read_bytes, read_first_bytes_or_empty
from tissue_sim.recording.formats.number_text import TextOfNumericCell
from tissue_sim.recording.formats.table import TableRow
from tissue_sim.recording.formats.workbook import Sheet
from tissue_sim.recording.recording import MIN_POINTS


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
