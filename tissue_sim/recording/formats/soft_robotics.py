"""Tensile tests of the Soft Robotics Materials Database (Marechal et al., Soft Robotics 8, 2021, 284).

Semicolons; ``PARAMETER;INFO;URL`` lines, then a header with Time, True Strain, True Stress, Engineering Strain and
Engineering Stress. One mean curve a material, loading only.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

from tissue_sim.files import read_text
from tissue_sim.recording.formats.columns import read_columns
from tissue_sim.recording.formats.header import find_header, text_tables
from tissue_sim.recording.formats.number_text import any_number, is_number
from tissue_sim.recording.formats.table import Row
from tissue_sim.recording.recording import Recording
from tissue_sim.units import split_header

_STRAIN, _STRESS, _TIME = "Engineering Strain", "Engineering Stress", "Time"


def read_soft_robotics(path: str | Path) -> Recording:
    """Stretch (1 + engineering strain) and nominal stress, with time where it is sound.

    In two files of the database (Ecoflex 00-30 and 00-50) the time counts 40.9, 40.10, 40.11: it is left out there,
    and the metadata say so under ``time``.

    Raises:
        InputError: no header with Engineering Strain and Engineering Stress, or a bad cell; with file and line.
    """
    path = Path(path)
    text = read_text(path, f"a tensile test with the columns {_STRAIN} and {_STRESS}")
    _, header, data = find_header(text_tables(text, file=path), [_TIME, _STRAIN, _STRESS], file=path)
    lines = [line.split(";") for line in text.splitlines()[1:header.line - 1]]
    parameters = {cells[0].strip(): cells[1].strip() for cells in lines if len(cells) > 1 and cells[0].strip()}
    columns = {"stretch": {"name": _STRAIN, "unit": "-"}, "nominal stress": _STRESS}
    metadata = {"format": "soft_robotics", "parameters": parameters}
    if _runs_backwards(header, data):
        metadata["time"] = "left out: the column runs backwards"
    else:
        columns = {"time": _TIME, **columns}
    recording = read_columns(path, columns, skip_lines=header.line - 1, metadata=metadata)
    return recording.with_channels(stretch=1.0 + recording.channel("stretch"))


def _runs_backwards(header: Row, rows: list[Row]) -> bool:
    index = next(i for i, cell in enumerate(header.cells) if split_header(cell)[0].casefold() == _TIME.casefold())
    cells = [row.cells[index] for row in rows if len(row.cells) > index]
    # A cell that is no number stays in, so that its line is reported.
    return all(map(is_number, cells)) and any(after < before for before, after in pairwise(map(any_number, cells)))
