"""Read tensile tests of the Soft Robotics Materials Database (Marechal et al., Soft Robotics 8, 2021, 284).

The delimiter is a semicolon. Lines ``PARAMETER;INFO;URL`` precede a header with Time, True Strain, True Stress,
Engineering Strain and Engineering Stress. A file has one mean curve of a material, loading only.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

from tissue_sim.files import read_text
from tissue_sim.recording.formats.blocks import find_table_header_and_data_rows, iterate_table_for_each_delimiter
from tissue_sim.recording.formats.columns import read_single_recording
from tissue_sim.recording.formats.number_text import is_number_with_either_mark, parse_number_preferring_point_or_nan
from tissue_sim.recording.formats.table import TableRow
from tissue_sim.recording.recording import Recording
from tissue_sim.units import split_header_with_brackets

#: Header of the engineering strain.
_STRAIN = "Engineering Strain"
#: Header of the nominal stress.
_STRESS = "Engineering Stress"
#: Header of the time.
_TIME = "Time"


def read_soft_robotics(path: str | Path) -> Recording:
    """Read stretch (1 + engineering strain), nominal stress and, if it increases, the time.

    In two files of the database (Ecoflex 00-30 and 00-50) the time counts 40.9, 40.10, 40.11. The time is then omitted,
    and ``time`` in the metadata states the reason.

    Raises:
        InputError: no header with Engineering Strain and Engineering Stress, or a bad cell; with file and line.
    """
    path = Path(path)
    text = read_text(path, f"a tensile test with the columns {_STRAIN} and {_STRESS}")
    _, header, data = find_table_header_and_data_rows(iterate_table_for_each_delimiter(text, file=path),
                                                      [_TIME, _STRAIN, _STRESS], file=path)
    lines = [line.split(";") for line in text.splitlines()[1:header.line - 1]]
    parameters = {cells[0].strip(): cells[1].strip() for cells in lines if len(cells) > 1 and cells[0].strip()}
    columns = {"stretch": {"name": _STRAIN, "unit": "-"}, "nominal stress": _STRESS}
    metadata = {"format": "soft_robotics", "parameters": parameters}
    if _does_time_decrease(header, data):
        metadata["time"] = "left out: the column runs backwards"
    else:
        columns = {"time": _TIME, **columns}
    recording = read_single_recording(path, columns, skip_lines=header.line - 1, metadata=metadata)
    return recording.with_channels(stretch=1.0 + recording.channel("stretch"))


def _does_time_decrease(header: TableRow, rows: list[TableRow]) -> bool:
    """Return whether the time decreases between two rows."""
    index = next(i for i, cell in enumerate(header.cells)
                 if split_header_with_brackets(cell)[0].casefold() == _TIME.casefold())
    cells = [row.cells[index] for row in rows if len(row.cells) > index]
    # A damaged cell keeps the column, so that the reader reports the line of the cell.
    return all(map(is_number_with_either_mark, cells)) and any(
        after < before for before, after in pairwise(map(parse_number_preferring_point_or_nan, cells)))
