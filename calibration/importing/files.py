"""Import files of test machines: write a campaign, and a picture of the interpretation of the files."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from calibration.campaign.campaign import load_campaign
from calibration.campaign.measured import read_measured
from calibration.importing.afm import interpret_afm_file, is_afm
from calibration.importing.campaign_text import FILL_IN, format_campaign
from calibration.importing.decimal_marks import describe_decimal_mark, share_decimal_mark
from calibration.importing.flags import applies_to_kind, check_options, require_used
from calibration.importing.grouping import group_into_tests, has_same_motion
from calibration.importing.imported import (
    Imported,
    ImportedTest,
    ImportOptions,
    Line,
    Part,
    Zero,
    list_questions_of_tests,
)
from calibration.importing.motion import describe_motion
from calibration.importing.picture import draw_imported
from calibration.importing.sidecar import add_sidecar, find_stated_kind, read_sidecar
from calibration.importing.signal_lines import (
    format_left_out_samples,
    format_offset_settings,
    format_viscoelastic_start,
)
from calibration.importing.size_assumptions import add_size_assumptions, describe_unclear_statement
from calibration.importing.sizes_of_tables import compare_table_sizes
from calibration.importing.zero import add_zero_assumption, select_linear_laws
from tissue_sim.atomic_write import write_bytes, write_text
from tissue_sim.bounded import bounded
from tissue_sim.errors import InputError, located, shortened
from tissue_sim.experiment.kinds.kind import KINDS, TestKind
from tissue_sim.experiment.tools.tool import list_shapes_without_file
from tissue_sim.frozen_mapping import read_only
from tissue_sim.recording.formats.guesses import FileInterpretation, TableGroup
from tissue_sim.recording.formats.sizes import SizeOrSpeed, find_sizes
from tissue_sim.recording.formats.understanding import interpret_file
from tissue_sim.specimen import SPECIMENS, specimen_sizes
from tissue_sim.specimen.specimen import get_shape_sizes

_LAWS = {"analytical": ("neo_hooke", "mooney_rivlin", "reduced_polynomial_2", "ogden_1"),
         "inverse_fem": ("neo_hooke", "reduced_polynomial_2")}
#: Ratio of bulk modulus to initial shear modulus of a simulated tissue, if the user does not state it.
_BULK_RATIO = 1000.0
#: Sizes of a specimen without a stated shape.
_OWN_SIZES = frozenset({"radius_mm", "area_mm2", "height_mm"})
#: Largest number of characters for the errors of all files in one sentence.
_ERROR_CHARACTERS = 240


def import_files(files: Iterable[str | Path], output: str | Path | None = None, wishes: ImportOptions | None = None, *,
                 overwrite: bool = False) -> Imported:
    """Interpret files of measurements and write a campaign.

    Args:
        files: texts, spreadsheets, arrays or AFM files: replicates of a test, or several tests.
        output: path of the campaign (``.toml``); a picture of the interpretation is written to the same folder
            (``.png``). None: no files are written.
        wishes: options of the user, which override the content of the files.
        overwrite: whether existing output files are replaced.

    Returns:
        The interpretation. `Imported.missing` lists information that only the user knows; the campaign has a line for
        each item.

    Raises:
        InputError: files that cannot be interpreted, in one sentence, or an existing output. No file is written then.
    """
    wishes, paths = wishes or ImportOptions(), [Path(file) for file in files]
    output = None if output is None else Path(output)
    _check_paths(paths, output, overwrite)
    check_options(wishes)
    understood = share_decimal_mark([compare_table_sizes(add_size_assumptions(each, wishes), wishes)
                                    for each in _interpret_files(paths, wishes)])
    controlled = wishes.test.get("control")
    parts = [Part(each, reading, tuple(describe_motion(recording, reading.kind.kind, controlled)
                                       for recording in reading.recordings))
             for each in understood for reading in each.readings]
    groups = [(name, *_add_zero(alike, wishes), reason) for name, alike, reason in group_into_tests(parts)]
    parts = [part for _, alike, *_ in groups for part in alike]
    tests, specimens, missing = _build_tests(groups, wishes)
    require_used(wishes, understood, tests)
    fit = _make_fit_lines(tests, wishes)

    def text_in(folder: Path, questions: Sequence[str] = ()) -> str:
        """Return the text of the campaign with paths relative to `folder`."""
        return format_campaign(tests, specimens, fit, folder, questions)

    text = text_in(Path() if output is None else output.parent, list_questions_of_tests(tests))
    imported = Imported(tuple(understood), tests, read_only(specimens), text, missing, _collect_warnings(parts, tests))
    if not missing:
        imported = replace(imported, problem=_find_problem(text_in))
    if output is None:
        return imported
    picture = output.with_suffix(".png")
    drawn = draw_imported(imported)
    write_text(output, text)
    write_bytes(picture, drawn)
    return replace(imported, output=output, picture=picture)


def _check_paths(paths: Sequence[Path], output: Path | None, overwrite: bool) -> None:
    """Raise an `InputError` for repeated inputs, and for an output that cannot be written."""
    if not paths:
        raise InputError("give at least one file", field="files")
    for i, path in enumerate(paths):
        with located(file=path):
            if path.resolve() in {other.resolve() for other in paths[:i]}:
                raise InputError("is given twice; a replicate counts once")
    if output is None:
        return
    if output.suffix.lower() != ".toml":
        raise InputError("a campaign is a TOML file; give a name that ends in .toml", file=output)
    for each in (output, output.with_suffix(".png")):
        if each.resolve() in {path.resolve() for path in paths}:
            raise InputError("is one of the files to import; give another name for the campaign", file=each)
        if each.exists() and not overwrite:
            raise InputError("exists already; give another name, or say that it is to be replaced (--overwrite)",
                             file=each)


def _interpret_files(paths: Sequence[Path], wishes: ImportOptions) -> list[FileInterpretation]:
    """Interpret all files.

    Raises:
        InputError: names all files that cannot be interpreted.
    """
    understood, faults = [], []
    for path in paths:
        try:
            understood.append(_interpret_file(path, wishes))
        except InputError as error:
            faults.append(error)
    if len(faults) == 1:
        raise faults[0]
    if faults:
        length = _ERROR_CHARACTERS // len(faults)
        problems = (shortened(f"{Path(each.file or '').name}: {each.problem}", max(length, 20)) for each in faults)
        raise InputError(f"{len(faults)} of {len(paths)} files cannot be imported: {'; '.join(problems)}")
    return understood


def _interpret_file(path: Path, wishes: ImportOptions) -> FileInterpretation:
    """Interpret one file with its sidecar, and read stress and strain if the size of the specimen is unknown."""
    stated = wishes.stated
    if stated.format in ("afm", "jpk", "bruker") or (not stated.format and bounded(is_afm, path, file=path)):
        return interpret_afm_file(path)
    said = read_sidecar(path)
    speed, height = wishes.test.get("speed_mm_s"), wishes.specimen.get("height_mm")
    stated = replace(stated, kind=stated.kind or find_stated_kind(said), speed=None if speed is None else 1e-3 * speed,
                     height=None if height is None else 1e-3 * float(height))
    found = add_sidecar(bounded(interpret_file, path, stated, file=path), said,
                        kind_stated=wishes.stated.kind is not None)
    # Without the size of the specimen a force gives no modulus; stress and strain in the file give one.
    lacking = [reading for reading in found.readings if {"displacement", "force"} <= set(
        reading.recordings[0].channels) and not _has_height_and_section(_merge_sizes(reading, wishes))]
    if lacking and not stated.columns:
        direct = bounded(interpret_file, path, replace(stated, direct=True), file=path)
        if all({"nominal stress"} <= {column.channel for column in reading.columns} for reading in direct.readings):
            return direct
    return found


def _merge_sizes(reading: TableGroup, wishes: ImportOptions) -> dict[str, SizeOrSpeed]:
    """Return key -> size of the specimen; the user overrides the sidecar, and the sidecar overrides the file."""
    found = find_sizes(reading.stated, reading.kind.kind)
    found |= {key: SizeOrSpeed(key, float(value), "in the sidecar of the recording")
              for key, value in reading.specimen.items() if key != "shape"}
    if any(key in wishes.specimen for key in ("radius_mm", "area_mm2")):
        found = {key: size for key, size in found.items() if key not in ("radius_mm", "area_mm2")}
    return found | {key: SizeOrSpeed(key, float(value), "stated") for key, value in wishes.specimen.items()
                    if key != "shape"}


def _has_height_and_section(sizes: Mapping[str, SizeOrSpeed]) -> bool:
    """Return whether the sizes give height and cross-section; other keys belong to a stated shape."""
    return not sizes.keys() <= _OWN_SIZES or ("height_mm" in sizes and ("radius_mm" in sizes or "area_mm2" in sizes))


def _add_zero(parts: Sequence[Part], wishes: ImportOptions) -> tuple[tuple[Part, ...], Zero | None]:
    """Add the meaning of a load at zero displacement to the replicates of a test."""
    sizes = {key: size.value for key, size in _merge_sizes(parts[0].reading, wishes).items()}
    laws = select_linear_laws(wishes.laws or _LAWS["analytical"])
    return add_zero_assumption(parts, sizes, laws, wishes.zero)


def _build_tests(groups: Sequence[tuple[str, tuple[Part, ...], Zero | None, str]], wishes: ImportOptions
           ) -> tuple[tuple[ImportedTest, ...], dict[str, tuple[Line, ...]], tuple[str, ...]]:
    """Return the tests, their specimens (equal ones once), and the missing information."""
    tests: list[ImportedTest] = []
    specimens: dict[str, tuple[Line, ...]] = {}
    missing: list[str] = []
    for name, parts, zero, reason in groups:
        reading = parts[0].reading
        kind = KINDS[reading.kind.kind] if reading.kind.kind else None
        needs = "displacement" in reading.recordings[0] or (kind is not None and kind.closed_form is None)
        specimen = None
        if needs:
            lines, lacks = _make_specimen_lines(reading, wishes, kind)
            missing += [what for what in lacks if what not in missing]
            values = [(line.key, line.value) for line in lines]
            # An equal test of another name has another specimen; a different test may share a specimen.
            others = {test.specimen for test in tests if test.kind == reading.kind.kind
                      and has_same_motion(test.parts[0], parts[0])}
            specimen = next((known for known, other in specimens.items() if known not in others
                             and [(line.key, line.value) for line in other] == values), None)
            if specimen is None:
                specimen = name if specimens else "specimen"
                specimens[specimen] = lines
        keys, lacks = _make_test_lines(parts, wishes)
        missing += [what for what in lacks if what not in missing]
        columns = tuple(Line(column.channel, column.to_campaign_entry(),
                             f"{FILL_IN}: {what}; {column.reason}" if (what := column.missing_information)
                             else column.reason) for column in reading.columns)
        tests.append(ImportedTest(name, reading.kind.kind, tuple(parts), specimen, tuple(keys), columns, reason,
                                  zero))
    if len(specimens) > 1 and "specimen" in specimens:
        # With several specimens, each is named after its first test.
        first = next(test.name for test in tests if test.specimen == "specimen")
        specimens = {first if key == "specimen" else key: lines for key, lines in specimens.items()}
        tests = [replace(test, specimen=first) if test.specimen == "specimen" else test for test in tests]
    return tuple(tests), specimens, tuple(missing)


def _make_specimen_lines(reading: TableGroup, wishes: ImportOptions, kind: TestKind | None
                         ) -> tuple[tuple[Line, ...], list[str]]:
    """Return the lines of the specimen of a reading, and the missing sizes."""
    sizes = _merge_sizes(reading, wishes)
    shape, reason = wishes.specimen.get("shape"), "stated"
    if not wishes.specimen and reading.specimen.get("shape") in SPECIMENS:
        shape, reason = reading.specimen["shape"], "in the sidecar of the recording"
    if shape is not None:
        return _make_shape_lines(str(shape), sizes, reason)
    lines, missing = [], []
    flat = "area_mm2" in sizes or (kind is not None and kind.has_gripped_ends and "radius_mm" not in sizes)
    lines.append(Line("shape", "prism" if flat else "cylinder"))
    for key, what in (("area_mm2", "cross-section") if flat else ("radius_mm", "radius"),
                      ("height_mm", "gauge length" if kind is not None and kind.name == "uniaxial_tension" else
                       "thickness" if kind is not None and kind.name == "simple_shear" else "height")):
        if key in sizes:
            lines.append(Line(key, sizes[key].value, sizes[key].reason))
        else:
            flag = f"--{key.replace('_', '-')}"
            also = " (or --radius-mm)" if key == "area_mm2" else ""
            unclear = describe_unclear_statement(reading, key)
            lines.append(Line(key, None, f"{what} of the specimen, {unclear or 'which no file states'}; {flag}{also}"))
            missing.append(f"the {what} of the specimen ({flag}{also}{f'; {unclear}' if unclear else ''})")
    return tuple(lines), missing


def _make_shape_lines(shape: str, sizes: Mapping[str, SizeOrSpeed], reason: str) -> tuple[tuple[Line, ...], list[str]]:
    """Return the lines of a specimen with a stated shape, and the missing sizes."""
    lines, missing = [Line("shape", shape, reason)], []
    for key, declared in get_shape_sizes(shape).items():
        flag = f"--{key.replace('_', '-')}"
        if key in sizes:
            lines.append(Line(key, sizes[key].value, sizes[key].reason))
        elif declared.absent is None:
            lines.append(Line(key, None, f"of the specimen, which no file states; {flag}"))
            missing.append(f"the {specimen_sizes()[key].field.replace('_', ' ')} of the specimen ({flag})")
    return tuple(lines), missing


def _make_test_lines(parts: Sequence[Part], wishes: ImportOptions) -> tuple[list[Line], list[str]]:
    """Return the lines of a ``[[test]]`` without name, specimen, recordings and columns, and missing information."""
    reading, missing = parts[0].reading, []
    lines = [Line("kind", reading.kind.kind, reading.kind.reason if reading.kind.kind else
                  f"{reading.kind.reason}; one of {', '.join(KINDS)} (--kind)")]
    if reading.kind.kind is None:
        missing.append("the kind of test (--kind)")
    missing += [f"{what} (--{'scale' if what.startswith('the scale') else 'unit'} {_flag_name(column.channel)}=...)"
                for column in reading.columns if (what := column.missing_information)]
    lines += [Line(key, value, describe_decimal_mark(parts) if key == "decimal" else "")
              for key, value in reading.options.items() if key != "columns"]
    kind = KINDS[reading.kind.kind] if reading.kind.kind else None
    test = dict(wishes.test)
    if kind is not None and kind.tool_stated:
        more, lacks = _make_tool_lines(test, reading)
        lines, missing = [*lines, *more], [*missing, *lacks]
    if kind is not None and kind.face.stated and "friction" not in test:
        lines.append(Line("friction", None, "coefficient of friction of both plates, or \"stick\"; --friction"))
        missing.append("the friction of the plates (--friction)")
    lines += _make_air_and_failure_lines(parts)
    lines += format_left_out_samples(parts)
    lines += _make_speed_lines(parts, test.pop("speed_mm_s", None))
    lines += [Line(key, value, "stated") for key, value in test.items() if applies_to_kind(key, value, kind)]
    return lines, missing


def _make_speed_lines(parts: Sequence[Part], stated: float | None) -> list[Line]:
    """Return the line ``speed_mm_s`` for recordings without displacement or without time."""
    reading = parts[0].reading
    if reading.speed is not None:
        speed, source = reading.speed
        return [Line("speed_mm_s", round(1e3 * speed, 9), "no column of the motion: displacement = speed x time from "
                     f"the first sample; {source}")]
    has_clock = any(motion.rate is not None for part in parts for motion in part.motions)
    if has_clock or "displacement" not in reading.recordings[0]:
        return []
    if stated is not None:
        return [Line("speed_mm_s", stated, "no clock; stated")]
    found = find_sizes(reading.stated, None).get("speed_mm_s")
    return [] if found is None else [Line("speed_mm_s", found.value, f"no clock; {found.reason}")]


def _make_tool_lines(test: Mapping[str, Any], reading: TableGroup) -> tuple[list[Line], list[str]]:
    """Return the lines of the tool of an indentation and of its friction, and the missing information."""
    lines: list[Line] = []
    missing: list[str] = []
    said = reading.recordings[0].metadata
    shapes = ", ".join(shape for shape in list_shapes_without_file() if shape != "plate")
    for key, what, flag in (("tool", "the shape of the tool", "--tool"),
                            ("tool_radius_mm", "the radius of the tool", "--tool-radius-mm")):
        if key in test:
            continue
        if key in said:
            lines.append(Line(key, said[key], "in the file"))
            continue
        lines.append(Line(key, None, f"{what}{f', {shapes}' if key == 'tool' else ''}; {flag}"))
        missing.append(f"{what} ({flag})")
    shape = test.get("tool", said.get("tool", "flat"))
    if "friction" not in test and shape != "flat":
        lines.append(Line("friction", "stick", f"taken so: tissue does not slip on a {shape}, and can lift off"))
    return lines, missing


def _make_air_and_failure_lines(parts: Sequence[Part]) -> list[Line]:
    """Return the lines for air before contact, and for samples after a failure."""
    lines = []
    motions = [(part.file.name, motion) for part in parts for motion in part.motions]
    air = [(name, motion.contact) for name, motion in motions if motion.air and motion.contact is not None]
    zeroed = any("zeroing" in recording.metadata for part in parts for recording in part.reading.recordings)
    if air and not zeroed and all(motion.air is not None for _, motion in motions):
        name, contact = air[0]
        lines.append(Line("contact", "find", f"{name}: {contact.in_words(stressed=motions[0][1].found.stressed)}"))
    failed = next(((name, motion) for name, motion in motions if motion.failure is not None), None)
    if failed is not None and failed[1].failure is not None:
        said = failed[1].failure.in_words(stressed=failed[1].found.stressed)
        lines.append(Line("failure", "cut", f"{failed[0]}: {said}; fitted up to there"))
    return lines


def _flag_name(channel: str) -> str:
    """Return the name of a channel in a flag."""
    return {"nominal stress": "stress"}.get(channel, channel.replace(" ", "_"))


def _make_fit_lines(tests: Sequence[ImportedTest], wishes: ImportOptions) -> list[Line]:
    """Return the lines of ``[fit]``."""
    kinds = [KINDS[test.kind] for test in tests if test.kind]
    closed = all(kind.closed_form is not None for kind in kinds)
    method = "analytical" if closed else "inverse_fem"
    why = ("every test has a closed form" if closed else
           f"{next(kind.name for kind in kinds if kind.closed_form is None)} has no closed form")
    lines = [Line("method", method, why),
             Line("laws", list(wishes.laws or _LAWS[method]), "stated" if wishes.laws else "of two parameters at most")]
    if not closed:
        lines.append(Line("bulk_ratio", _BULK_RATIO, "K / mu0; gels and soft tissues hardly change their volume"))
    return [*lines, *format_offset_settings(tests, bounded=closed), *format_viscoelastic_start(tests)]


def _find_problem(text_in: Callable[[Path], str]) -> str | None:
    """Return the reason why the campaign cannot be calibrated; None: it can.

    Args:
        text_in: returns the text of the campaign for a folder.
    """
    with tempfile.TemporaryDirectory() as place:
        path = Path(place).resolve() / "campaign.toml"
        try:
            write_text(path, text_in(path.parent))
            read_measured(load_campaign(path))
        except InputError as error:
            there = error.file if error.file is not None and Path(error.file) != path else None
            return str(InputError(error.problem, file=there, line=error.line, field=error.field))
    return None


def _collect_warnings(parts: Sequence[Part], tests: Sequence[ImportedTest]) -> tuple[str, ...]:
    """Return the warnings of all files, each once."""
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
