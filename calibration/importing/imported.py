"""Result of an import: tests with their replicates, lines of a campaign, and missing information.

Options of the user without effect are refused, because such an option may hide a mistake.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from calibration.importing.motion import RecordedMotion
from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import KINDS, TestKind
from tissue_sim.experiment.tools.tool import TOOLS, interpret_shape_or_profile_path
from tissue_sim.public_names import OldName, make_getattr_for_old_names
from tissue_sim.recording.formats.assumption import Assumption
from tissue_sim.recording.formats.guesses import ColumnGuess, FileInterpretation, InterpretationOverrides, TableGroup
from tissue_sim.recording.formats.interpretation import get_command_line_channel_name
from tissue_sim.recording.formats.pairing import uses_gauge_length
from tissue_sim.recording.formats.vocabulary import MACHINES
from tissue_sim.recording.measures import ENGINEERING, MEASURES
from tissue_sim.recording.recording import Recording
from tissue_sim.settings import make_shallow_read_only_copy

__getattr__ = make_getattr_for_old_names(__name__, {"Wishes": "ImportOptions", "Imported": "ImportResult"})


@dataclass(frozen=True)
class ImportOptions:
    """Options of the user for all files of an import; they override the content of the files.

    Attributes:
        stated: hints about the columns and the kind of test.
        specimen: key of ``[[specimen]]`` -> value: ``radius_mm``, ``area_mm2``, ``height_mm``; or ``shape`` and its
            sizes.
        test: further keys of ``[[test]]`` -> value: ``tool``, ``tool_radius_mm``, ``friction``, ``speed_mm_s``, ...
        laws: laws that are fitted; None: a few laws for most soft materials.
        zero: meaning of a load at zero displacement: ``"preload"`` or ``"sensor"``; None: the curve decides.
    """

    stated: InterpretationOverrides = field(default_factory=InterpretationOverrides)
    specimen: Mapping[str, float | str] = field(default_factory=lambda: make_shallow_read_only_copy({}))
    test: Mapping[str, Any] = field(default_factory=lambda: make_shallow_read_only_copy({}))
    laws: tuple[str, ...] | None = None
    zero: str | None = None


@dataclass(frozen=True, eq=False)
class ReplicateFile:
    """One input file whose recordings are replicates of one test.

    Attributes:
        understanding: interpretation of the file.
        reading: reading of the tables.
        motions: motions of their recordings, in order.
    """

    understanding: FileInterpretation
    reading: TableGroup
    motions: tuple[RecordedMotion, ...]

    @property
    def file(self) -> Path:
        """Path of the file."""
        return self.understanding.file


@dataclass(frozen=True)
class LoadAtZeroInterpretation:
    """Interpretation of a recorded load that is not zero at zero displacement.

    Attributes:
        value: ``"preload"``: the displacement was zeroed at a preload; ``"sensor"``: the load cell was not zeroed.
        shift: distance of contact before the zero, m; negative for a load against the direction of loading.
        load: load at zero displacement, N; negative for a load against the direction of loading.
    """

    value: str
    shift: float
    load: float


@dataclass(frozen=True)
class CampaignLine:
    """One ``key = value`` line of a campaign file with the reason of the value, which is written as a comment.

    A value of None is unknown; the user must fill in the line.
    """

    key: str
    value: Any
    reason: str = ""


@dataclass(frozen=True, eq=False)
class ImportedTest:
    """Table ``[[test]]`` of the campaign that an import writes.

    Attributes:
        name: unique name.
        kind: kind of test; None: the user must state the kind.
        parts: files with the replicates.
        specimen: name of the specimen; None: the test needs no specimen.
        lines: lines of the table except name, specimen, recordings and columns.
        columns: lines of the table ``[test.columns]``: channel -> column and unit.
        reason: evidence that the files are replicates.
        zero: interpretation of a load at zero displacement; None: the load starts from zero.
    """

    name: str
    kind: str | None
    parts: tuple[ReplicateFile, ...]
    specimen: str | None
    lines: tuple[CampaignLine, ...]
    columns: tuple[CampaignLine, ...]
    reason: str = ""
    zero: LoadAtZeroInterpretation | None = None


@dataclass(frozen=True, eq=False)
class ImportResult:
    """Result of an import.

    Attributes:
        files: interpretation of each file, in the order of the input.
        tests: tests of the campaign.
        specimens: name -> lines of the table ``[[specimen]]``.
        text: text of the campaign (TOML).
        missing: one phrase for each entry that only the user knows; empty: nothing is missing.
        problem: reason why a complete campaign does not run; None: the campaign runs, or information is missing.
        warnings: sentences for the user.
        output, picture: written files; None: not written.
    """

    files: tuple[FileInterpretation, ...]
    tests: tuple[ImportedTest, ...]
    specimens: Mapping[str, tuple[CampaignLine, ...]]
    text: str
    missing: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    problem: str | None = None
    output: Path | None = None
    picture: Path | None = None

    @property
    def assumptions(self) -> tuple[tuple[str, Assumption], ...]:
        """Pairs (file name, assumption) of all files: about the file, its tables, then its recordings."""
        return list_file_name_assumption_pairs(self.tests)

    @property
    def questions(self) -> tuple[str, ...]:
        """Questions that the user must decide by a flag, each once, with the files that they concern."""
        return list_questions_of_tests(self.tests)

    complete = OldName("is_complete")

    @property
    def is_complete(self) -> bool:
        """Whether `calibration.calibrate` accepts the campaign, and no question is open."""
        return not self.missing and self.problem is None and not self.questions


def list_file_name_assumption_pairs(tests: Sequence[ImportedTest]) -> tuple[tuple[str, Assumption], ...]:
    """Return the pairs (file name, assumption) of all files of the tests, each pair once.

    The assumptions of one file are about the file, then about its tables, then about its recordings.
    """
    found: dict[tuple[str, Assumption], None] = {}
    for test in tests:
        for part in test.parts:
            for each in (*part.understanding.assumptions, *part.reading.assumptions,
                         *(each for motion in part.motions for each in motion.assumptions)):
                found[part.file.name, each] = None
    return tuple(found)


def list_questions_of_tests(tests: Sequence[ImportedTest]) -> tuple[str, ...]:
    """Return one sentence for each question that the user must decide by a flag, with the files that it concerns."""
    asked: dict[str, list[str]] = {}
    for name, each in list_file_name_assumption_pairs(tests):
        if each.needs_user_decision:
            asked.setdefault(each.question_text, []).append(name)
    return tuple(f"{', '.join(dict.fromkeys(names))}: {question}" for question, names in asked.items())


def make_json_dictionary_of_import(imported: ImportResult) -> dict[str, Any]:
    """Return the result of an import as a dictionary of JSON types, with lengths in mm.

    Returns:
        Dictionary with the keys ``campaign``, ``picture``, ``files``, ``tests``, ``assumptions``, ``questions``,
        ``missing``, ``problem`` and ``warnings``.
    """
    return {
        "campaign": None if imported.output is None else str(imported.output),
        "picture": None if imported.picture is None else str(imported.picture),
        "files": [_make_file_entry(each, imported) for each in imported.files],
        "tests": [{"name": test.name, "kind": test.kind, "recordings": [str(part.file) for part in test.parts],
                   "replicates": sum(len(part.motions) for part in test.parts), "reason": test.reason}
                  for test in imported.tests],
        "assumptions": [{"file": name, **each.to_json()} for name, each in imported.assumptions],
        "questions": list(imported.questions), "missing": list(imported.missing), "problem": imported.problem,
        "warnings": list(imported.warnings)}


def _make_file_entry(understanding: FileInterpretation, imported: ImportResult) -> dict[str, Any]:
    """Return the dictionary that describes a file under the key ``files`` of `make_json_dictionary_of_import`."""
    parts = [part for test in imported.tests for part in test.parts if part.understanding is understanding]
    recordings = [_make_recording_entry(motion, recording.name or part.reading.name, len(recording))
                  for part in parts if part.motions
                  for motion, recording in zip(part.motions, part.reading.recordings, strict=True)]
    recordings += [_make_modulus_table_entry(recording, recording.name or part.reading.name)
                   for part in parts if not part.motions for recording in part.reading.recordings]
    first = recordings[0]
    return {"file": str(understanding.file), "format": understanding.format, "delimiter": understanding.delimiter,
            "decimal_mark": understanding.decimal_mark, "encoding": understanding.encoding,
            "units": {column.channel: column.unit for part in parts for column in part.reading.columns},
            "columns": {column.channel: column.to_campaign_entry() for part in parts[:1]
                        for column in part.reading.columns},
            "kind": parts[0].reading.kind.kind,
            "unused_columns": list(dict.fromkeys(name for part in parts for name in part.reading.unused)),
            **{key: first[key] for key in ("contact_mm", "contact_interval_mm", "segments", "cycles", "failure")},
            "recordings": recordings,
            "warnings": [*understanding.warnings, *(remark for part in parts for remark in part.reading.remarks),
                         *(warning for part in parts for motion in part.motions for warning in motion.warnings)]}


def _make_modulus_table_entry(recording: Recording, name: str) -> dict[str, Any]:
    """Return the dictionary that describes a table of moduli under ``recordings``, without entries about a motion."""
    frequency = recording.channel("frequency")
    empty = dict.fromkeys(("rate_Hz", "duration_s", "contact_mm", "contact_interval_mm", "contact", "failure"))
    return {"name": name, "points": len(recording), **empty, "segments": [], "cycles": 0,
            "frequency_Hz": [float(frequency.min()), float(frequency.max())]}


def _make_recording_entry(motion: RecordedMotion, name: str, points: int) -> dict[str, Any]:
    """Return the dictionary that describes a recording with `points` samples under ``recordings``; lengths in mm."""
    contact = motion.contact
    channel, in_mm = ("displacement_mm", 1e3) if motion.channel == "displacement" else ("strain", 1.0)
    return {"name": name, "points": points, "rate_Hz": motion.rate, "duration_s": motion.duration,
            "contact_mm": contact.displacement * 1e3 if in_mm > 1 and contact is not None
            and contact.has_air_before_contact else None,
            "contact_interval_mm": None if in_mm == 1 or contact is None or contact.status == "none"
            else [end * 1e3 if math.isfinite(end) else None for end in contact.interval],
            "contact": None if contact is None else contact.status,
            "segments": [{"name": each.name, "first": each.first, "last": each.last} for each in motion.segments],
            "cycles": motion.loading_cycle_count,
            "failure": None if motion.failure is None else {
                "mode": motion.failure.mode, f"at_{channel}": motion.failure.displacement * in_mm,
                "lost": motion.failure.lost, "recovered": motion.failure.recovered}}


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
