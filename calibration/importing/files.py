"""Import files of test machines: write a campaign, and a picture of the interpretation of the files.

The sidecar of a recording states kind of test, specimen and tool. Files are grouped into replicates of one test and
into separate tests; the curves of an atomic force microscope or nanoindenter are replicates of an indentation.
"""

from __future__ import annotations

import hashlib
import re
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from calibration.campaign.campaign import load_campaign
from calibration.campaign.measured import REPLICATE_TOLERANCE, read_measured_curves
from calibration.importing.campaign_lines import (
    DEFAULT_LAWS,
    copy_interpretations_with_common_decimal_mark,
    get_specimen_sizes_by_priority,
    make_fit_lines_and_missing,
    make_specimen_lines_and_missing,
    make_test_lines_and_missing,
)
from calibration.importing.campaign_text import FILL_IN, format_campaign
from calibration.importing.imported import (
    CampaignLine,
    ImportedTest,
    ImportOptions,
    ImportResult,
    LoadAtZeroInterpretation,
    ReplicateFile,
    list_questions_of_tests,
    reject_contradicting_options,
    reject_unused_options,
)
from calibration.importing.motion import analyse_recorded_motion
from calibration.importing.picture import render_import_as_png_bytes
from calibration.importing.specimen_sizes import (
    copy_interpretation_with_size_assumptions,
    copy_with_question_on_contradicting_sizes,
)
from calibration.importing.zero import interpret_and_correct_load_at_zero, select_laws_linear_in_parameters_or_neo_hooke
from tissue_sim.bounded import run_in_sandbox
from tissue_sim.decode import read_json_value
from tissue_sim.errors import InputError, located_and_converted_errors, shorten_text_in_middle
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.files import ZIP_MAGIC, read_bytes, read_first_bytes_or_empty, write_bytes, write_text
from tissue_sim.recording.file import read_recordings
from tissue_sim.recording.formats.guesses import FileInterpretation, KindGuess, TableGroup
from tissue_sim.recording.formats.modulus_tables import has_moduli
from tissue_sim.recording.formats.sizes import SizeOrSpeedInMillimetres, make_size_signature
from tissue_sim.recording.formats.understanding import interpret_file
from tissue_sim.recording.recording import SIZE_DEPENDENT
from tissue_sim.recording.screening import VISCOELASTIC_REMEDY
from tissue_sim.settings import make_shallow_read_only_copy


def read_matching_sidecar_or_empty(path: Path) -> Mapping[str, Any]:
    """Return the metadata in the sidecar ``NAME.json`` of a recording ``NAME.csv``.

    The result is empty without a sidecar, or if the digest in the sidecar differs from that of the recording.
    """
    sidecar = path.with_suffix(".json")
    if path.suffix.lower() != ".csv" or not sidecar.is_file():
        return {}
    with suppress(InputError):
        said = read_json_value(sidecar, "the sidecar of a recording")
        digest = hashlib.sha256(read_bytes(path, "a recording")).hexdigest()
        if isinstance(said, Mapping) and said.get("sha256") == digest:
            return said
    return {}


def find_test_kind_in_sidecar(said: Mapping[str, Any]) -> str | None:
    """Return the kind of test that a sidecar states; None if the kind is absent or not registered."""
    kind = said.get("kind")
    return kind if isinstance(kind, str) and kind in KINDS else None


def copy_interpretation_with_sidecar_data(found: FileInterpretation, said: Mapping[str, Any], *,
                                          kind_stated: bool) -> FileInterpretation:
    """Return a copy of the interpretation of a file with the kind of test, specimen sizes and tool of its sidecar.

    Args:
        found: interpretation of the file.
        said: metadata, see `read_matching_sidecar_or_empty`.
        kind_stated: whether the user states the kind.
    """
    if not said:
        return found
    reason, kind = f"in {found.file.with_suffix('.json').name}", find_test_kind_in_sidecar(said)
    specimen = said.get("specimen")
    sizes = {key: value for key, value in specimen.items() if key == "shape" or isinstance(value, int | float)} \
        if isinstance(specimen, Mapping) else {}
    tool = said.get("tool")
    about = {"tool": tool.get("shape"), "tool_radius_mm": tool.get("radius_mm")} if isinstance(tool, Mapping) else \
        {"tool": tool, "tool_radius_mm": said.get("tool_radius_mm")}
    about = {key: value for key, value in about.items() if value is not None}

    def add_sidecar_data_to_reading(reading: TableGroup) -> TableGroup:
        """Return a copy of a reading with the kind of test, the specimen sizes and the tool that the sidecar states."""
        guess = reading.kind if kind is None or kind_stated else KindGuess(kind, reason)
        return replace(reading, kind=guess, specimen=make_shallow_read_only_copy(sizes),
                       recordings=tuple(each.with_metadata(**about) for each in reading.recordings))

    return replace(found, readings=tuple(map(add_sidecar_data_to_reading, found.readings)))


_SUFFIXES = (".jpk-force", ".jpk-force-map", ".jpk-qi-data", ".jpk-qi-series", ".ibw", ".spm")
#: How the texts of AFM Workshop and of afmformats begin.
_HEADS = (b"Force-Distance Curve", b"# afmformats")


def is_afm_file(path: Path) -> bool:
    """Return whether a file contains force curves of an AFM.

    AFM files are recognised by their suffix or their first bytes; a zip archive that is no spreadsheet counts as AFM.
    """
    if path.suffix.lower() in _SUFFIXES:
        return True
    head = read_first_bytes_or_empty(path, 64)
    if head.startswith(_HEADS):
        return True
    if not head.startswith(ZIP_MAGIC):
        return False
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    # Python cannot list this archive: it is damaged, unreadable, or of a newer version of the zip format, for which
    # zipfile raises NotImplementedError. The reader of the file then reports the reason.
    except (zipfile.BadZipFile, OSError, NotImplementedError):
        return False
    return not any(name in ("[Content_Types].xml", "content.xml") or name.startswith("xl/") for name in names)


def read_afm_file_as_indentation_replicates(path: Path) -> FileInterpretation:
    """Read a file of force curves of an AFM, and interpret the curves as replicates of a needle indentation.

    Raises:
        InputError: as `tissue_sim.recording.formats.afm.read_afm`.
    """
    read_bytes(path, "force curves of an AFM")
    recordings = read_recordings(path, format="afm")
    kind = KindGuess("needle_indentation", "force curves of an AFM press a tip into the specimen")
    reading = TableGroup("", (), (), make_shallow_read_only_copy({"format": "afm"}), recordings, kind, 1)
    return FileInterpretation(path, "afm", "afm", None, None, None, (reading,))


#: The number at the end of a name: ``EF10_A3``, ``Specimen_RawData_1``, ``gel (2)``.
_NUMBER = re.compile(r"[ _.\-]*\(?\d+\)?$")


def group_into_tests(parts: Sequence[ReplicateFile]) -> list[tuple[str, tuple[ReplicateFile, ...], str]]:
    """Group files into tests, and return (name, replicates, reason) of each test.

    The names of replicates differ only in the number at their end. Replicates have equal columns, an equal kind of
    test, equal stated sizes, and equal motions within `REPLICATE_TOLERANCE`. A gripped specimen is pulled up to its
    failure, so that only the speed of its motion is compared.
    """
    alike: dict[tuple, list[list[ReplicateFile]]] = {}
    counted = _find_replicate_stem_by_file(list(dict.fromkeys(part.file for part in parts)))
    for part in parts:
        reading = part.reading
        stem = counted[part.file]
        key = (stem, reading.name, reading.kind.kind, repr(sorted(reading.options.items(), key=str)),
               make_size_signature(reading.stated, reading.kind.kind), repr(sorted(reading.specimen.items())),
               tuple((column.channel, column.header, column.unit) for column in reading.columns))
        clusters = alike.setdefault(key, [])
        cluster = next((each for each in clusters if have_same_speed_and_travel(each[0], part)), None)
        if cluster is None:
            clusters.append([part])
        else:
            cluster.append(part)
    groups: list[tuple[str, tuple[ReplicateFile, ...], str]] = []
    for (stem, name, *_), clusters in alike.items():
        for cluster in clusters:
            one = len(cluster) == 1
            parts_of_name = [cluster[0].file.stem if one else stem, name]
            title = _make_unique_test_name("_".join(filter(None, parts_of_name)), [each for each, *_ in groups])
            groups.append((title, tuple(cluster), _describe_replicates(cluster, len(clusters))))
    return groups


def _find_replicate_stem_by_file(files: Sequence[Path]) -> dict[Path, str]:
    """Return file -> name that replicates have in common: the name of the file without the number at its end.

    Numbers that differ widely, such as in ``gel_10`` and ``gel_50``, are part of the name of the specimen.
    """
    bases: dict[str, list[Path]] = {}
    for file in files:
        bases.setdefault(_NUMBER.sub("", file.stem), []).append(file)
    found: dict[Path, str] = {}
    for base, alike in bases.items():
        numbers = [int(match[1]) for file in alike if (match := re.search(r"(\d+)\)?$", file.stem))]
        close = bool(numbers) and max(numbers) - min(numbers) <= 2 * len(numbers) + 2
        found |= {file: base if base and close else file.stem for file in alike}
    return found


def have_same_speed_and_travel(first: ReplicateFile, second: ReplicateFile) -> bool:
    """Return whether speed and largest displacement of two files agree within `REPLICATE_TOLERANCE`, relative.

    The displacements of a gripped specimen are not compared, because the specimen is pulled up to its failure.
    """
    kind = KINDS[first.reading.kind.kind] if first.reading.kind.kind else None
    pairs = []
    if not first.motions or not second.motions:
        return True
    a, b = first.motions[0], second.motions[0]
    if a.speed and b.speed:
        pairs.append((a.speed, b.speed))
    if kind is None or not kind.has_gripped_ends:
        pairs.append((max(map(abs, a.reach)), max(map(abs, b.reach))))
    return all(max(pair) <= (1 + REPLICATE_TOLERANCE) * min(pair) for pair in pairs)


def _describe_replicates(cluster: Sequence[ReplicateFile], clusters: int) -> str:
    """Return one sentence that explains why the files of a cluster form one test.

    Args:
        cluster: files with equal motions.
        clusters: number of clusters with the same name.
    """
    replicates = sum(len(part.reading.recordings) for part in cluster)
    apart = "; files of the same name that move otherwise are tests of their own" if clusters > 1 else ""
    if len(cluster) > 1:
        return (f"replicates: {len(cluster)} files whose names differ in their number only, alike in columns and "
                f"motion{apart}")
    if replicates > 1:
        return f"replicates: {replicates} tables of one file with the same columns{apart}"
    return f"one recording{apart}"


def _make_unique_test_name(name: str, taken: Sequence[str]) -> str:
    """Return the name of a test; a number is appended if another test already has this name."""
    number = 2
    found = name
    while found in taken:
        found, number = f"{name}_{number}", number + 1
    return found


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
    parts = [ReplicateFile(each, reading, () if has_moduli(reading) else tuple(
        analyse_recorded_motion(recording, reading.kind.kind, controlled, reading.channels_without_unit)
        for recording in reading.recordings))
             for each in understood for reading in each.readings]
    groups = [(name, *_interpret_and_correct_load_at_zero(alike, wishes), reason) for name, alike,
              reason in group_into_tests(parts)]
    parts = [part for _, alike, *_ in groups for part in alike]
    tests, specimens, missing = _build_tests_specimens_and_missing(groups, wishes)
    reject_unused_options(wishes, understood, tests)
    fit, more = make_fit_lines_and_missing(tests, wishes)
    missing = (*missing, *more)

    def format_campaign_for_folder(folder: Path, questions: Sequence[str] = ()) -> str:
        """Return the text of the campaign (TOML) with the paths of its recordings relative to `folder`."""
        return format_campaign(tests, specimens, fit, folder, questions)

    text = format_campaign_for_folder(Path() if output is None else output.parent, list_questions_of_tests(tests))
    imported = ImportResult(tuple(understood), tests, make_shallow_read_only_copy(specimens), text, missing,
                            _collect_warnings(parts, tests, fits_relaxation=any(line.key == "start" for line in fit)))
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
    if has_moduli(parts[0].reading):
        return tuple(parts), None
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
        needs = any(name in reading.recordings[0] for name in SIZE_DEPENDENT) or (
            kind is not None and kind.closed_form is None)
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


def _collect_warnings(parts: Sequence[ReplicateFile], tests: Sequence[ImportedTest], *,
                      fits_relaxation: bool) -> tuple[str, ...]:
    """Return the warnings of all files and of tests fitted as one material, as sentences without repetition.

    Args:
        parts: replicates of all tests.
        tests: tests of the campaign.
        fits_relaxation: whether the campaign has start values of a Prony term.
    """
    found: dict[str, None] = {}
    for kind in dict.fromkeys(test.kind for test in tests if test.kind):
        alike = [test for test in tests if test.kind == kind]
        if len(alike) > 1:
            files = [part.file for test in alike for part in test.parts]
            remedy = ", by the columns (--column) or sheets (--sheet) of each" if len(set(files)) < len(files) else ""
            found[f"{len(alike)} tests of {kind} are fitted as one material; import different materials one by one"
                  f"{remedy}"] = None
    for part in parts:
        for warning in (*part.understanding.warnings, *part.reading.remarks,
                        *(each for motion in part.motions for each in motion.warnings)):
            said = warning.replace(VISCOELASTIC_REMEDY, "the campaign fits one relaxation term (start)") \
                if fits_relaxation else warning
            found.setdefault(f"{part.file.name}: {said}", None)
    return tuple(found)
