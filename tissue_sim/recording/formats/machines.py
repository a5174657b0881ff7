"""Files of test machines by the name of the machine's program: one reader, which understands a file from its content,
and what `tissue_sim.recording.formats.vocabulary` knows of each."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tissue_sim.errors import InputError
from tissue_sim.recording.formats.columns import Sheets
from tissue_sim.recording.formats.guesses import ColumnHints
from tissue_sim.recording.formats.kind_guess import KIND_OF_TEST
from tissue_sim.recording.formats.understanding import understand
from tissue_sim.recording.formats.vocabulary import MACHINES
from tissue_sim.recording.recording import Recording


def read_table(path: str | Path, *, sheet: Sheets | None = None, curve: int | None = None) -> tuple[Recording, ...]:
    """Read the recordings in a text, spreadsheet or container of any machine.

    What each column is taken for stands in the metadata of the recordings, under ``understood``: header, unit, sign and
    the reason.

    Args:
        path: the file.
        sheet: name or number (from 1) of a spreadsheet's sheet, or a list of them. None: all that hold a recording.
        curve: number from 1 of the only recording wanted. None: all.

    Raises:
        InputError: nothing that can be a recording; everything that only a person can say, in one sentence.
    """
    return _read(path, None, sheet, curve)


def _reader(machine: str) -> Callable[..., tuple[Recording, ...]]:
    def read(path: str | Path, *, sheet: Sheets | None = None, curve: int | None = None) -> tuple[Recording, ...]:
        return _read(path, machine, sheet, curve)

    read.__name__ = read.__qualname__ = f"read_{machine}"
    read.__doc__ = f"As `read_table`, for files of {MACHINES[machine].title}."
    return read


def _read(path: str | Path, machine: str | None, sheet: Sheets | None, curve: int | None) -> tuple[Recording, ...]:
    path = Path(path)
    understood = understand(path, ColumnHints(format=machine, sheet=sheet, any_test=True))
    missing = [what for reading in understood.readings for what in reading.missing]
    if missing:
        raise InputError(f"does not state {', nor '.join(missing)}; give columns with unit, or scale, in place of the "
                         "format", file=path, line=understood.readings[0].line)
    assumptions = (*understood.assumptions, *(each for reading in understood.readings for each in reading.assumptions))
    if asked := [each.question for each in assumptions if each.is_question and each.subject != KIND_OF_TEST]:
        raise InputError(f"{asked[0]} Give columns, and decimal, in place of the format", file=path,
                         line=understood.readings[0].line)
    found = [recording.with_metadata(format=understood.format, understood={
        column.channel: {**column.entry(), "reason": column.reason} for column in reading.columns})
        for reading in understood.readings for recording in reading.recordings]
    if curve is not None:
        if isinstance(curve, bool) or not isinstance(curve, int) or not 1 <= curve <= len(found):
            raise InputError(f"must be from 1 to {len(found)}, the number of curves in the file; got {curve!r}.",
                             file=path, field="curve")
        found = found[curve - 1:curve]
    return tuple(found)


globals().update({f"read_{name}": _reader(name) for name in MACHINES})
