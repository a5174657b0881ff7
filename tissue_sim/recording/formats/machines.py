"""Read the files of test machines: one reader for all machines in `tissue_sim.recording.formats.vocabulary`.

For each machine in `MACHINES`, the module has a function ``read_<machine>``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tissue_sim.errors import InputError
from tissue_sim.recording.formats.columns import Sheets
from tissue_sim.recording.formats.guesses import InterpretationOverrides
from tissue_sim.recording.formats.kind_guess import KIND_OF_TEST
from tissue_sim.recording.formats.understanding import interpret_file
from tissue_sim.recording.formats.vocabulary import MACHINES
from tissue_sim.recording.recording import Recording


def read_table(path: str | Path, *, sheet: Sheets | None = None,
               curve: int | None = None) -> tuple[Recording, ...]:
    """Read the recordings in a text, spreadsheet or container of any machine.

    The metadata of the recordings have the interpretation of the columns under ``understood``: header, unit, sign and
    reason.

    Args:
        path: the file.
        sheet: name or number (from 1) of a sheet, or a list of names and numbers. None: all sheets with a recording.
        curve: number (from 1) of the only recording to read. None: all.

    Raises:
        InputError: the file has no recording, or information is missing; the message lists all missing information.
    """
    return _read_file_of_given_or_any_machine(path, None, sheet, curve)


def _make_machine_reader(machine: str) -> Callable[..., tuple[Recording, ...]]:
    """Return the function ``read_<machine>`` for a name in `MACHINES`."""
    def read_file_of_given_machine(path: str | Path, *, sheet: Sheets | None = None,
                                   curve: int | None = None) -> tuple[Recording, ...]:
        return _read_file_of_given_or_any_machine(path, machine, sheet, curve)

    read_file_of_given_machine.__name__ = read_file_of_given_machine.__qualname__ = f"read_{machine}"
    title = MACHINES[machine].title
    read_file_of_given_machine.__doc__ = f"Read the recordings in a file of {title}; see `read_table`."
    return read_file_of_given_machine


def _read_file_of_given_or_any_machine(path: str | Path, machine: str | None, sheet: Sheets | None, curve: int | None
                                       ) -> tuple[Recording, ...]:
    """Read the recordings in a file; `machine` is a name in `MACHINES` (None: any machine)."""
    path = Path(path)
    understood = interpret_file(path, InterpretationOverrides(format=machine, sheet=sheet, any_test=True))
    missing = [what for reading in understood.readings for what in reading.missing_information_texts]
    if missing:
        raise InputError(f"does not state {', nor '.join(missing)}; give columns with unit or scale instead of the "
                         "format", file=path, line=understood.readings[0].line)
    assumptions = (*understood.assumptions, *(each for reading in understood.readings for each in reading.assumptions))
    if asked := [each.question_text for each in assumptions if each.needs_user_decision
                 and each.subject != KIND_OF_TEST]:
        raise InputError(f"{asked[0]} Give columns and decimal instead of the format", file=path,
                         line=understood.readings[0].line)
    found = [recording.with_metadata(format=understood.format, understood={
        column.channel: {**column.to_campaign_entry(), "reason": column.reason} for column in reading.columns})
        for reading in understood.readings for recording in reading.recordings]
    if curve is not None:
        if isinstance(curve, bool) or not isinstance(curve, int) or not 1 <= curve <= len(found):
            raise InputError(f"must be from 1 to {len(found)}, the number of curves in the file; got {curve!r}.",
                             file=path, field="curve")
        found = found[curve - 1:curve]
    return tuple(found)


globals().update({f"read_{name}": _make_machine_reader(name) for name in MACHINES})
