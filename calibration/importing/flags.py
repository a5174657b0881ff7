"""Refuse options of the user without effect, because such an option may hide a mistake."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from calibration.importing.imported import ImportedTest, ImportOptions
from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import KINDS, TestKind
from tissue_sim.experiment.tools.tool import TOOLS, interpret_shape_or_profile_path
from tissue_sim.recording.formats.guesses import ColumnGuess, FileInterpretation
from tissue_sim.recording.formats.interpretation import get_command_line_channel_name
from tissue_sim.recording.formats.pairing import uses_gauge_length
from tissue_sim.recording.formats.vocabulary import MACHINES
from tissue_sim.recording.measures import ENGINEERING, MEASURES

#: Formats of force curves of an AFM.
_AFM = ("afm", "jpk", "bruker")


def reject_contradicting_options(wishes: ImportOptions) -> None:
    """Raise an error for options that are invalid or contradict each other, whatever the files contain.

    Raises:
        InputError: the error names the flag.
    """
    stated = wishes.stated
    if stated.format is not None and stated.format not in (*MACHINES, *_AFM, "table"):
        raise InputError(f"format must be one of {', '.join((*MACHINES, 'afm', 'table'))}; got {stated.format!r}. "
                         "Without the flag the format is detected.", field="--format")
    if {"strain", "stretch"} <= stated.columns.keys():
        raise InputError("column must name strain or stretch; got both, but a strain is read as a stretch. Leave out "
                         "one of them.", field="--column")
    for channel, measure in stated.measures.items():
        becomes = {"strain": "stretch"}.get(channel, channel)
        names = [ENGINEERING, *(name for name, each in MEASURES.items() if each.channel == becomes)]
        if measure not in names or len(names) == 1:
            expected = f"one of {', '.join(names)}" if len(names) > 1 else "that of a strain, stretch or stress"
            raise InputError(
                f"measure of {get_command_line_channel_name(channel)} must be {expected}; got {measure!r}. Change "
                "the flag or leave it out.", field="--measure")


def reject_unused_options(wishes: ImportOptions, files: Sequence[FileInterpretation],
                          tests: Sequence[ImportedTest]) -> None:
    """Raise an error for the first option of the user that has no effect on any of the files.

    Raises:
        InputError: the error names the flag and the reason.
    """
    problem = next(_iterate_unused_options_with_reason(wishes, files, tests), None)
    if problem is not None:
        flag, reason = problem
        raise InputError(f"{reason}. Leave out the flag.", field=flag)


def is_test_key_used_by_kind(key: str, value: Any, kind: TestKind | None) -> bool:
    """Return whether a key of ``[[test]]`` with this value is valid for a kind of test; True for an unknown kind."""
    if kind is None:
        return True
    if key == "friction":
        return kind.tool is not None and not kind.face.fixed
    if key == "tool":
        return kind.tool is not None and (kind.tool_stated or _is_plate_tool_shape(value))
    return key != "tool_radius_mm" or kind.tool_stated


def _is_plate_tool_shape(shape: Any) -> bool:
    """Return whether the name of a tool shape, such as ``plate``, stands for a plate."""
    name = interpret_shape_or_profile_path(shape)[0]
    return name in TOOLS and TOOLS[name].is_plate


def _iterate_unused_options_with_reason(wishes: ImportOptions, files: Sequence[FileInterpretation],
                                        tests: Sequence[ImportedTest] ) -> Iterator[tuple[str, str]]:
    """Yield (flag, reason) of each option of the user that has no effect on the files."""
    yield from _iterate_options_unused_by_file_kind(wishes, files)
    yield from _iterate_options_of_unread_channels(wishes, files)
    kinds = [KINDS[test.kind] if test.kind else None for test in tests]
    for key, value in wishes.test.items():
        if not any(is_test_key_used_by_kind(key, value, kind) for kind in kinds):
            names = ", ".join(dict.fromkeys(kind.name for kind in kinds if kind is not None))
            yield f"--{key.replace('_', '-')}", f"{names} has no {key.removesuffix('_mm').replace('_', ' ')} to state"
    if "speed_mm_s" in wishes.test and not any(line.key == "speed_mm_s" for test in tests for line in test.lines):
        yield ("--speed-mm-s", "the speed counts only where a file lacks the time or the displacement; these files "
               "have both")
    derived = any(uses_gauge_length(reading.columns) for each in files for reading in each.readings)
    needless = [key for key in wishes.specimen if not (derived and key == "height_mm")]
    if needless and all(test.specimen is None for test in tests):
        key = needless[0]
        yield (f"--{key.replace('_', '-')}", "stress and strain are read, which need no size of the specimen; "
               "displacement and force are read if all sizes are stated")


def _iterate_options_unused_by_file_kind(wishes: ImportOptions,
                                         files: Sequence[FileInterpretation]) -> Iterator[tuple[str, str]]:
    """Yield (flag, reason) of options that do not apply to this kind of file."""
    stated, kinds = wishes.stated, {each.kind_of_file for each in files}
    if stated.sheet is not None and not kinds & {"workbook", "container"}:
        yield "--sheet", "only spreadsheets and containers of arrays have sheets"
    if stated.delimiter is not None and "text" not in kinds:
        yield "--delimiter", "only text has a delimiter"
    if kinds == {"afm"}:
        if stated.skip_lines:
            yield "--skip-lines", "files of an AFM have no lines to leave out"
        if stated.columns:
            yield "--column", "files of an AFM name their channels"


def _iterate_options_of_unread_channels(wishes: ImportOptions,
                                        files: Sequence[FileInterpretation]) -> Iterator[tuple[str, str]]:
    """Yield (flag, reason) of options for channels that are not read."""
    columns: list[ColumnGuess] = [column for each in files for reading in each.readings for column in reading.columns]
    read = {name for column in columns for name in (column.channel, column.role)}
    stated = wishes.stated
    for flag, values in (("--unit", stated.units), ("--scale", stated.scales), ("--sign", stated.signs),
                         ("--measure", stated.measures)):
        for channel in values:
            if channel not in read:
                has = ", ".join(dict.fromkeys(get_command_line_channel_name(column.channel) for column in columns)) \
                    or "none"
                yield flag, f"no column of {get_command_line_channel_name(channel)} is read; columns are read for {has}"
