"""Formats of recordings, one function and one short file each.

Adding one: write ``read_NAME(path) -> Recording`` in a file beside these and add a line to `FORMATS`.
"""

from collections.abc import Callable
from pathlib import Path

from tissue_sim.errors import InputError, nearest
from tissue_sim.formats.columns import check_columns, check_delimiter, read_columns
from tissue_sim.formats.instron import read_instron
from tissue_sim.formats.native import read_native
from tissue_sim.formats.soft_robotics import read_soft_robotics
from tissue_sim.recording import Recording

FORMATS: dict[str, Callable[[str | Path], Recording]] = {
    "native": read_native,
    "instron": read_instron,
    "soft_robotics": read_soft_robotics,
}
#: Names that later versions will know.
PLANNED = ("xlsx", "afm")


def find_format(name: str) -> Callable[[str | Path], Recording]:
    """The reader of that name.

    Raises:
        InputError: no such format, or one that is not available in this version.
    """
    if name in PLANNED:
        raise InputError(f"format {name!r} is not available in this version; export the table as CSV and name its "
                         "columns with columns = {...}", field="format")
    if name not in FORMATS:
        raise InputError(f"unknown format {name!r}{nearest(str(name), FORMATS)}", field="format")
    return FORMATS[name]


__all__ = ["FORMATS", "PLANNED", "check_columns", "check_delimiter", "find_format", "read_columns"]
