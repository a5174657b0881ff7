"""Formats of recordings, one function and one short file each.

Adding one: write ``read_NAME(path) -> Recording`` in a file beside these and add a line to `FORMATS`.
"""

from collections.abc import Callable

from tissue_sim.errors import InputError, nearest
from tissue_sim.recording.formats.afm import read_afm, read_afm_curves
from tissue_sim.recording.formats.columns import check_columns, check_delimiter, read_columns
from tissue_sim.recording.formats.instron import read_instron
from tissue_sim.recording.formats.native import read_native
from tissue_sim.recording.formats.soft_robotics import read_soft_robotics
from tissue_sim.recording.formats.xlsx import read_xlsx
from tissue_sim.recording.recording import Recording

#: Name -> function of a path and, by keyword, of what only this format needs to know.
FORMATS: dict[str, Callable[..., Recording]] = {
    "native": read_native,
    "instron": read_instron,
    "soft_robotics": read_soft_robotics,
    "xlsx": read_xlsx,
    "afm": read_afm,
}
#: Formats whose files may hold several recordings -> reader of all of them.
SEVERAL: dict[str, Callable[..., tuple[Recording, ...]]] = {"afm": read_afm_curves}


def find_format(name: str) -> Callable[..., Recording]:
    """The reader of that name.

    Raises:
        InputError: no such format.
    """
    if name not in FORMATS:
        raise InputError(f"unknown format {name!r}{nearest(str(name), FORMATS)}", field="format")
    return FORMATS[name]


__all__ = ["FORMATS", "SEVERAL", "check_columns", "check_delimiter", "find_format", "read_afm", "read_afm_curves",
           "read_columns", "read_xlsx"]
