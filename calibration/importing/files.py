"""Import files of test machines: write a campaign, and a picture of the interpretation of the files."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from calibration.campaign.campaign import load_campaign
from calibration.campaign.measured import read_measured_curves
from calibration.importing.afm import is_afm_file, read_afm_file_as_indentation_replicates
from calibration.importing.campaign_lines import (
    DEFAULT_LAWS,
    get_specimen_sizes_by_priority,
    make_fit_lines,
    make_specimen_lines_and_missing,
    make_test_lines_and_missing,
)
from calibration.importing.campaign_text import FILL_IN, format_campaign
from calibration.importing.decimal_marks import copy_interpretations_with_common_decimal_mark
from calibration.importing.flags import reject_contradicting_options, reject_unused_options
from calibration.importing.grouping import group_into_tests, have_same_speed_and_travel
from calibration.importing.imported import (
    CampaignLine,
    ImportedTest,
    ImportOptions,
    ImportResult,
    LoadAtZeroInterpretation,
    ReplicateFile,
    list_questions_of_tests,
)
from calibration.importing.motion import analyse_recorded_motion
from calibration.importing.picture import render_import_as_png_bytes
from calibration.importing.sidecar import (
    copy_interpretation_with_sidecar_data,
    find_test_kind_in_sidecar,
    read_matching_sidecar_or_empty,
)
from calibration.importing.size_assumptions import copy_interpretation_with_size_assumptions
from calibration.importing.sizes_of_tables import copy_with_question_on_contradicting_sizes
from calibration.importing.zero import interpret_and_correct_load_at_zero, select_laws_linear_in_parameters_or_neo_hooke
from tissue_sim.bounded import run_in_sandbox
from tissue_sim.errors import InputError, located_and_converted_errors, shorten_text_in_middle
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.files import write_bytes, write_text
from tissue_sim.recording.formats.guesses import FileInterpretation
from tissue_sim.recording.formats.sizes import SizeOrSpeedInMillimetres
from tissue_sim.recording.formats.understanding import interpret_file
from tissue_sim.settings import make_shallow_read_only_copy

#: Sizes of a specimen without a stated shape.
_OWN_SIZES = frozenset({"radius_mm", "area_mm2", "height_mm"})
#: Largest number of characters for the errors of all files in one sentence.
_ERROR_CHARACTERS = 240


def import_files(files: Iterable[str | Path], output: str | Path | None = None, wishes: ImportOptions | None = None, *,
                 overwrite: bool = False) -> ImportResult:
    """Interpret files of measurements and write a campaign.

    Args:
        files: texts, spreadsheets, arrays or AFM files: replicates of a test, or several tests.
        output: path of the campaign (``.toml``); a picture of the interpretation is written to the same folder
            (``.png``). None: no files are written.
        wishes: options of the user, which override the content of the files; None: no options.
        overwrite: whether existing output files are replaced.

    Returns:
        The interpretation. `ImportResult.missing` lists information that only the user knows; the campaign has a line
        for each item.

    Raises:
        InputError: files that cannot be interpreted, in one sentence, or an existing output. No file is written then.
    """
    wishes, paths = wishes or ImportOptions(), [Path(file) for file in files]
    output = None if output is None else Path(output)
    _check_inputs_differ_and_output_is_new(paths, output, overwrite)
    reject_contradicting_options(wishes)
    understood = copy_interpretations_with_common_decimal_mark(
        [copy_with_question_on_contradicting_sizes(copy_interpretation_with_size_assumptions(each, wishes), wishes)
         for each in _interpret_files(paths, wishes)])
    controlled = wishes.test.get("control")
    parts = [ReplicateFile(each, reading, tuple(analyse_recorded_motion(recording, reading.kind.kind, controlled)
                                                for recording in reading.recordings))
             for each in understood for reading in each.readings]
    groups = [(name, *_interpret_and_correct_load_at_zero(alike, wishes), reason) for name, alike,
              reason in group_into_tests(parts)]
    parts = [part for _, alike, *_ in groups for part in alike]
    tests, specimens, missing = _build_tests_specimens_and_missing(groups, wishes)
    reject_unused_options(wishes, understood, tests)
    fit = make_fit_lines(tests, wishes)

    def format_campaign_for_folder(folder: Path, questions: Sequence[str] = ()) -> str:
        """Return the text of the campaign (TOML) with the paths of its recordings relative to `folder`."""
        return format_campaign(tests, specimens, fit, folder, questions)

    text = format_campaign_for_folder(Path() if output is None else output.parent, list_questions_of_tests(tests))
    imported = ImportResult(tuple(understood), tests, make_shallow_read_only_copy(specimens), text, missing,
                            _collect_warnings(parts, tests))
    if not missing:
        imported = replace(imported, problem=_find_reason_against_calibration(format_campaign_for_folder))
    if output is None:
        return imported
    picture = output.with_suffix(".png")
    drawn = render_import_as_png_bytes(imported)
    write_text(output, text)
    write_bytes(picture, drawn)
    return replace(imported, output=output, picture=picture)


def _check_inputs_differ_and_output_is_new(paths: Sequence[Path], output: Path | None, overwrite: bool) -> None:
    """Check that the paths of an import differ, and that the output is a new TOML file (unless `overwrite`).

    Raises:
        InputError: no input, a repeated input, an output that is no TOML file, that is an input, or that exists while
            `overwrite` is False.
    """
    if not paths:
        raise InputError("files must contain at least one path; got none. Name the files to import.", field="files")
    for i, path in enumerate(paths):
        with located_and_converted_errors(file=path):
            if path.resolve() in {other.resolve() for other in paths[:i]}:
                raise InputError("files must differ; this file is given twice. Remove the repetition, because each "
                                 "replicate counts once.")
    if output is None:
        return
    if output.suffix.lower() != ".toml":
        raise InputError(f"output must end in .toml, because a campaign is a TOML file; got {output.suffix!r}. Give "
                         "another name.", file=output)
    for each in (output, output.with_suffix(".png")):
        if each.resolve() in {path.resolve() for path in paths}:
            raise InputError("output must differ from the files to import; this file is one of them. Give another name "
                             "for the campaign.", file=each)
        if each.exists() and not overwrite:
            raise InputError("output must be a new file; this file exists already. Give another name, or replace the "
                             "file with --overwrite.", file=each)


def _interpret_files(paths: Sequence[Path], wishes: ImportOptions) -> list[FileInterpretation]:
    """Interpret all files; return one interpretation for each file, in the order of `paths`.

    Raises:
        InputError: names all files that cannot be interpreted.
    """
    understood, faults = [], []
    for path in paths:
        try:
            understood.append(_interpret_file_with_sidecar(path, wishes))
        except InputError as error:
            faults.append(error)
    if len(faults) == 1:
        raise faults[0]
    if faults:
        length = _ERROR_CHARACTERS // len(faults)
        problems = (shorten_text_in_middle(f"{Path(each.file or '').name}: {each.problem}", max(length, 20))
                    for each in faults)
        raise InputError(f"{len(faults)} of {len(paths)} files cannot be imported: {'; '.join(problems)}")
    return understood


def _interpret_file_with_sidecar(path: Path, wishes: ImportOptions) -> FileInterpretation:
    """Interpret one file with its sidecar ``NAME.json``.

    Stress and strain of the file are read instead of force and displacement if the file has both and the size of the
    specimen is unknown.
    """
    stated = wishes.stated
    if stated.format in ("afm", "jpk", "bruker") or (not stated.format
                                                     and run_in_sandbox(is_afm_file, path, file=path)):
        return read_afm_file_as_indentation_replicates(path)
    said = read_matching_sidecar_or_empty(path)
    speed, height = wishes.test.get("speed_mm_s"), wishes.specimen.get("height_mm")
    stated = replace(stated, kind=stated.kind or find_test_kind_in_sidecar(said),
                     speed=None if speed is None else 1e-3 * speed,
                     height=None if height is None else 1e-3 * float(height))
    found = copy_interpretation_with_sidecar_data(run_in_sandbox(interpret_file, path, stated, file=path), said,
                                                  kind_stated=wishes.stated.kind is not None)
    # Without the size of the specimen a force gives no modulus; stress and strain in the file give one.
    lacking = [reading for reading in found.readings if {"displacement", "force"} <= set(
        reading.recordings[0].channels)
               and not _has_height_and_cross_section(get_specimen_sizes_by_priority(reading, wishes))]
    if lacking and not stated.columns:
        direct = run_in_sandbox(interpret_file, path, replace(stated, direct=True), file=path)
        if all({"nominal stress"} <= {column.channel for column in reading.columns} for reading in direct.readings):
            return direct
    return found


def _has_height_and_cross_section(sizes: Mapping[str, SizeOrSpeedInMillimetres]) -> bool:
    """Return whether height and cross-section of the specimen are known, so that a force gives a stress.

    Keys other than `_OWN_SIZES` belong to a shape that the user states; these sizes count as complete.
    """
    return not sizes.keys() <= _OWN_SIZES or ("height_mm" in sizes and ("radius_mm" in sizes or "area_mm2" in sizes))


def _interpret_and_correct_load_at_zero(parts: Sequence[ReplicateFile], wishes: ImportOptions
                                        ) -> tuple[tuple[ReplicateFile, ...], LoadAtZeroInterpretation | None]:
    """Return the replicates, extended by the assumption about their load at zero displacement, and this assumption.

    The second value is None if the load is zero at zero displacement.
    """
    sizes = {key: size.value for key, size in get_specimen_sizes_by_priority(parts[0].reading, wishes).items()}
    laws = select_laws_linear_in_parameters_or_neo_hooke(wishes.laws or DEFAULT_LAWS["analytical"])
    return interpret_and_correct_load_at_zero(parts, sizes, laws, wishes.zero)


def _build_tests_specimens_and_missing(
    groups: Sequence[tuple[str, tuple[ReplicateFile, ...], LoadAtZeroInterpretation | None, str]],
    wishes: ImportOptions
    ) -> tuple[tuple[ImportedTest, ...], dict[str, tuple[CampaignLine, ...]], tuple[str, ...]]:
    """Return the tests of the campaign, its specimens, and the missing information.

    Args:
        groups: (name, replicates, interpretation of the load at zero, reason of the grouping) of each test.
        wishes: options of the user.

    Returns:
        Tests; name -> lines of each specimen, equal specimens once; and the missing information, one phrase per item.
    """
    tests: list[ImportedTest] = []
    specimens: dict[str, tuple[CampaignLine, ...]] = {}
    missing: list[str] = []
    for name, parts, zero, reason in groups:
        reading = parts[0].reading
        kind = KINDS[reading.kind.kind] if reading.kind.kind else None
        needs = "displacement" in reading.recordings[0] or (kind is not None and kind.closed_form is None)
        specimen = None
        if needs:
            lines, lacks = make_specimen_lines_and_missing(reading, wishes, kind)
            missing += [what for what in lacks if what not in missing]
            values = [(line.key, line.value) for line in lines]
            # An equal test of another name has another specimen; a different test may share a specimen.
            others = {test.specimen for test in tests if test.kind == reading.kind.kind
                      and have_same_speed_and_travel(test.parts[0], parts[0])}
            specimen = next((known for known, other in specimens.items() if known not in others
                             and [(line.key, line.value) for line in other] == values), None)
            if specimen is None:
                specimen = name if specimens else "specimen"
                specimens[specimen] = lines
        keys, lacks = make_test_lines_and_missing(parts, wishes)
        missing += [what for what in lacks if what not in missing]
        columns = tuple(
            CampaignLine(column.channel, column.to_campaign_entry(), column.reason if lack is None
                         else f"{FILL_IN}: {lack}; {column.reason}")
            for column in reading.columns for lack in [column.missing_information_text_or_none])
        tests.append(ImportedTest(name, reading.kind.kind, tuple(parts), specimen, tuple(keys), columns, reason,
                                  zero))
    if len(specimens) > 1 and "specimen" in specimens:
        # With several specimens, each is named after its first test.
        first = next(test.name for test in tests if test.specimen == "specimen")
        specimens = {first if key == "specimen" else key: lines for key, lines in specimens.items()}
        tests = [replace(test, specimen=first) if test.specimen == "specimen" else test for test in tests]
    return tuple(tests), specimens, tuple(missing)


def _find_reason_against_calibration(format_campaign_for_folder: Callable[[Path], str]) -> str | None:
    """Return the reason why the complete campaign cannot be calibrated, or None if it can be calibrated.

    The campaign is written to a temporary folder and read.

    Args:
        format_campaign_for_folder: returns the text of the campaign for a folder.
    """
    with tempfile.TemporaryDirectory() as place:
        path = Path(place).resolve() / "campaign.toml"
        try:
            write_text(path, format_campaign_for_folder(path.parent))
            read_measured_curves(load_campaign(path))
        except InputError as error:
            there = error.file if error.file is not None and Path(error.file) != path else None
            return str(InputError(error.problem, file=there, line=error.line, field=error.field))
    return None


def _collect_warnings(parts: Sequence[ReplicateFile], tests: Sequence[ImportedTest]) -> tuple[str, ...]:
    """Return the warnings of all files and of tests fitted as one material, as sentences without repetition."""
    found: dict[str, None] = {}
    for kind in dict.fromkeys(test.kind for test in tests if test.kind):
        names = [test.name for test in tests if test.kind == kind]
        if len(names) > 1:
            found[f"{len(names)} tests of {kind} are fitted as one material; import different materials one by one"
                  ] = None
    for part in parts:
        for warning in (*part.understanding.warnings, *part.reading.remarks,
                        *(each for motion in part.motions for each in motion.warnings)):
            found.setdefault(f"{part.file.name}: {warning}", None)
    return tuple(found)
