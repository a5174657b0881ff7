"""Files of test machines in; a campaign, and a picture of what was understood, out."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from calibration.campaign.campaign import DEFAULT_OFFSET_PRIOR, load_campaign
from calibration.campaign.measured import read_measured
from calibration.importing.afm import is_afm, understand_afm
from calibration.importing.campaign_text import campaign_text
from calibration.importing.grouping import group, same_motion
from calibration.importing.imported import Imported, ImportedTest, Line, Part, Wishes
from calibration.importing.motion import describe_motion
from calibration.importing.picture import draw_imported
from tissue_sim.atomic_write import write_bytes, write_text
from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.experiment.tools.tool import shapes_without_file
from tissue_sim.frozen_mapping import read_only
from tissue_sim.recording.formats.guesses import Reading, Understanding
from tissue_sim.recording.formats.sizes import Size, find_sizes
from tissue_sim.recording.formats.understanding import reread, understand

_LAWS = {"analytical": ("neo_hooke", "mooney_rivlin", "reduced_polynomial_2", "ogden_1"),
         "inverse_fem": ("neo_hooke", "reduced_polynomial_2")}
#: K / mu0 of a simulated tissue where nobody says it.
_BULK_RATIO = 1000.0
#: Contact of a test whose travel is small, as a share of it.
_CONTACT_SHARE = 0.02


def import_files(files: Iterable[str | Path], output: str | Path | None = None, wishes: Wishes | None = None, *,
                 overwrite: bool = False) -> Imported:
    """Understand files of measurements and write a campaign of them.

    Args:
        files: texts, spreadsheets, arrays or AFM files: replicates of a test, or several tests.
        output: the campaign (``.toml``); a picture of what was understood goes beside it (``.png``). None: neither.
        wishes: what is stated, over what the files show.
        overwrite: replace both.

    Returns:
        What was understood. `Imported.missing` says what only a person can add; the campaign has a line for it.

    Raises:
        InputError: a file that cannot be understood, or several, in one sentence; an output that is there. Nothing is
            written then.
    """
    wishes, paths = wishes or Wishes(), [Path(file) for file in files]
    output = None if output is None else Path(output)
    _check(paths, output, overwrite)
    understood = _understand(paths, wishes)
    parts = [_part(each, reading) for each in understood for reading in each.readings]
    tests, specimens, missing = _tests(group(parts), wishes)
    fit = _fit(tests, wishes)
    folder = Path() if output is None else output.parent
    text = campaign_text(tests, specimens, fit, _noise(tests, fit), folder)
    imported = Imported(tuple(understood), tests, read_only(specimens), text, missing, _warnings(parts, tests))
    if not missing:
        imported = replace(imported, problem=_problem(text, folder))
    if output is None:
        return imported
    picture = output.with_suffix(".png")
    drawn = draw_imported(imported)
    write_text(output, text)
    write_bytes(picture, drawn)
    return replace(imported, output=output, picture=picture)


def _part(understanding: Understanding, reading: Reading) -> Part:
    """The tables with their motions; those with air before the contact are counted from there."""
    motions = tuple(map(describe_motion, reading.recordings))
    contacts = [motion.contact for motion in motions]
    air = [contact for contact in contacts if contact is not None and contact.found]
    if not air or not reading.columns or reading.missing or any(
            contact is None or contact.status not in ("found", "before") for contact in contacts):
        return Part(understanding, reading, motions)
    low, high = (1e3 * end for end in air[0].interval)
    reasons = {"displacement": f"touches at {1e3 * air[0].displacement:.4g} mm of the file (95 %: {low:.4g} to "
                               f"{high:.4g}){' and so on' if len(air) > 1 else ''}, so counted from the contact",
               "force": f"{air[0].force_zero:.3g} N in air, which is taken off"}
    columns = tuple(replace(column, offset="contact", reason=f"{column.reason}; {reasons[column.channel]}")
                    if column.channel in reasons and not isinstance(column.offset, float) else column
                    for column in reading.columns)
    counted = reread(understanding.file, replace(reading, columns=columns))
    again = tuple(replace(describe_motion(recording), contact=contact, warnings=motion.warnings)
                  for recording, contact, motion in zip(counted.recordings, contacts, motions, strict=True))
    return Part(understanding, counted, again)


def _check(paths: Sequence[Path], output: Path | None, overwrite: bool) -> None:
    if not paths:
        raise InputError("give at least one file", field="files")
    for i, path in enumerate(paths):
        if path.resolve() in {other.resolve() for other in paths[:i]}:
            raise InputError("is given twice; a replicate counts once", file=path)
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


def _understand(paths: Sequence[Path], wishes: Wishes) -> list[Understanding]:
    """Every file; those that cannot be understood are all named at once."""
    understood, faults = [], []
    for path in paths:
        try:
            understood.append(_one(path, wishes))
        except InputError as error:
            faults.append(error)
    if len(faults) == 1:
        raise faults[0]
    if faults:
        raise InputError(f"{len(faults)} of {len(paths)} files cannot be imported: {'; '.join(map(str, faults))}")
    return understood


def _one(path: Path, wishes: Wishes) -> Understanding:
    stated = wishes.stated
    if stated.format in ("afm", "jpk", "bruker") or (not stated.format and is_afm(path)):
        return understand_afm(path)
    found = understand(path, stated)
    # Without the size of the specimen a force says nothing; where the file has stress and strain, these do.
    lacking = [reading for reading in found.readings if {"displacement", "force"} <= {
        column.channel for column in reading.columns} and not _sized(_sizes(reading, wishes))]
    if lacking and not stated.columns:
        direct = understand(path, replace(stated, direct=True))
        if all({"nominal stress"} <= {column.channel for column in reading.columns} for reading in direct.readings):
            return direct
    return found


def _sizes(reading, wishes: Wishes) -> dict[str, Size]:
    found = find_sizes(reading.stated, reading.kind.kind)
    if any(key in wishes.specimen for key in ("radius_mm", "area_mm2")):
        found = {key: size for key, size in found.items() if key not in ("radius_mm", "area_mm2")}
    return found | {key: Size(key, value, "stated") for key, value in wishes.specimen.items()}


def _sized(sizes: Mapping[str, Size]) -> bool:
    return "height_mm" in sizes and ("radius_mm" in sizes or "area_mm2" in sizes)


def _tests(groups, wishes: Wishes) -> tuple[tuple[ImportedTest, ...], dict[str, tuple[Line, ...]], tuple[str, ...]]:
    """Tests, their specimens (equal ones once), and what is missing."""
    tests: list[ImportedTest] = []
    specimens: dict[str, tuple[Line, ...]] = {}
    missing: list[str] = []
    for name, parts, reason in groups:
        reading = parts[0].reading
        kind = KINDS[reading.kind.kind] if reading.kind.kind else None
        channels = {column.channel for column in reading.columns} or {"displacement", "force"}
        needs = "displacement" in channels or (kind is not None and kind.closed_form is None)
        specimen = None
        if needs:
            lines, lacks = _specimen(reading, wishes, kind)
            missing += [what for what in lacks if what not in missing]
            values = [(line.key, line.value) for line in lines]
            # The same test under another name was done on another specimen; another test may be done on this one.
            others = {test.specimen for test in tests if test.kind == reading.kind.kind
                      and same_motion(test.parts[0], parts[0])}
            specimen = next((known for known, other in specimens.items() if known not in others
                             and [(line.key, line.value) for line in other] == values), None)
            if specimen is None:
                specimen = name if specimens else "specimen"
                specimens[specimen] = lines
        keys, lacks = _keys(parts, wishes)
        missing += [what for what in lacks if what not in missing]
        columns = tuple(Line(column.channel, column.entry(),
                             f"{FILL}: {column.missing}; {column.reason}" if column.missing else column.reason)
                        for column in reading.columns)
        tests.append(ImportedTest(name, reading.kind.kind, tuple(parts), specimen, tuple(keys), columns, reason))
    if len(specimens) > 1 and "specimen" in specimens:
        # Its name stands beside those of the others now.
        first = next(test.name for test in tests if test.specimen == "specimen")
        specimens = {first if key == "specimen" else key: lines for key, lines in specimens.items()}
        tests = [replace(test, specimen=first) if test.specimen == "specimen" else test for test in tests]
    return tuple(tests), specimens, tuple(missing)


FILL = "FILL IN"


def _specimen(reading, wishes: Wishes, kind) -> tuple[tuple[Line, ...], list[str]]:
    sizes = _sizes(reading, wishes)
    lines, missing = [], []
    flat = "area_mm2" in sizes or (kind is not None and kind.gripped and "radius_mm" not in sizes)
    lines.append(Line("shape", "prism" if flat else "cylinder"))
    for key, what in (("area_mm2", "cross-section") if flat else ("radius_mm", "radius"),
                      ("height_mm", "gauge length" if kind is not None and kind.name == "uniaxial_tension" else
                       "thickness" if kind is not None and kind.name == "simple_shear" else "height")):
        if key in sizes:
            lines.append(Line(key, sizes[key].value, sizes[key].reason))
        else:
            flag = f"--{key.replace('_', '-')}"
            also = " (or --radius-mm)" if key == "area_mm2" else ""
            lines.append(Line(key, None, f"{what} of the specimen, which no file states; {flag}{also}"))
            missing.append(f"the {what} of the specimen ({flag}{also})")
    return tuple(lines), missing


def _keys(parts: Sequence[Part], wishes: Wishes) -> tuple[list[Line], list[str]]:
    """Keys of a ``[[test]]`` but for its name, specimen, recordings and columns."""
    reading, missing = parts[0].reading, []
    lines = [Line("kind", reading.kind.kind, reading.kind.reason if reading.kind.kind else
                  f"{reading.kind.reason}; one of {', '.join(KINDS)} (--kind)")]
    if reading.kind.kind is None:
        missing.append("the kind of test (--kind)")
    missing += [f"{what} (--{'scale' if what.startswith('the scale') else 'unit'} {_flag_name(column.channel)}=...)"
                for column in reading.columns if (what := column.missing)]
    lines += [Line(key, value) for key, value in reading.options.items() if key != "columns"]
    kind = KINDS[reading.kind.kind] if reading.kind.kind else None
    test = dict(wishes.test)
    if kind is not None and kind.tool_stated:
        said = reading.recordings[0].metadata
        for key in ("tool", "tool_radius_mm"):
            if key not in test and key in said:
                lines.append(Line(key, said[key], "in the file"))
            elif key not in test and (key == "tool" or test.get("tool") not in ("profile",)):
                shapes = ", ".join(shape for shape in shapes_without_file() if shape != "plate")
                lines.append(Line(key, None, f"shape of the tool: {shapes}; --tool" if key == "tool"
                                  else "radius of the tool; --tool-radius-mm"))
                missing.append("the shape of the tool (--tool)" if key == "tool"
                               else "the radius of the tool (--tool-radius-mm)")
        shape = test.get("tool", said.get("tool", "flat"))
        if "friction" not in test and shape != "flat":
            lines.append(Line("friction", "stick", f"taken so: tissue does not slip on a {shape}, and can lift off"))
    if kind is not None and kind.face.stated and "friction" not in test:
        lines.append(Line("friction", None, "coefficient of friction of both plates, or \"stick\"; --friction"))
        missing.append("the friction of the plates (--friction)")
    if "max_strain" not in test and (window := _window(parts, wishes)) is not None:
        lines.append(window)
    if "speed_mm_s" not in test and all(motion.rate is None for part in parts for motion in part.motions):
        speed = find_sizes(reading.stated, None).get("speed_mm_s")
        if speed is not None and any(column.channel == "displacement" for column in reading.columns):
            lines.append(Line("speed_mm_s", speed.value, f"no clock; {speed.reason}"))
    lines += [Line(key, value, "stated") for key, value in test.items()]
    return lines, missing


def _window(parts: Sequence[Part], wishes: Wishes) -> Line | None:
    """The strain of the first specimen that failed, and before which all are fitted."""
    strains: list[tuple[float, str]] = []
    for part in parts:
        height = _sizes(part.reading, wishes).get("height_mm")
        for motion in part.motions:
            if motion.failure is None or motion.failure.recovered or (motion.channel == "displacement" and not height):
                continue
            length = 1e-3 * height.value if height is not None and motion.channel == "displacement" else 1.0
            said = motion.failure.in_words(stressed=motion.channel != "displacement")
            strains.append((motion.failure.displacement / length, f"{part.file.name}: {said}; fitted up to there"))
    if not strains:
        return None
    strain, reason = min(strains)
    # Downwards, so that the first sample after it stays out.
    return Line("max_strain", math.floor(1e4 * strain) / 1e4, reason)


def _flag_name(channel: str) -> str:
    """A channel as a flag takes it."""
    return {"nominal stress": "stress"}.get(channel, channel.replace(" ", "_"))


def _fit(tests: Sequence[ImportedTest], wishes: Wishes) -> list[Line]:
    kinds = [KINDS[test.kind] for test in tests if test.kind]
    closed = all(kind.closed_form is not None for kind in kinds)
    method = "analytical" if closed else "inverse_fem"
    why = ("every test has a closed form" if closed else
           f"{next(kind.name for kind in kinds if kind.closed_form is None)} has no closed form")
    lines = [Line("method", method, why),
             Line("laws", list(wishes.laws or _LAWS[method]), "stated" if wishes.laws else "of two parameters at most")]
    if not closed:
        lines.append(Line("bulk_ratio", _BULK_RATIO, "K / mu0; gels and soft tissues hardly change their volume"))
    return lines


def _noise(tests: Sequence[ImportedTest], fit: Sequence[Line]) -> list[Line]:
    """How well the contacts of small tests are known, where the usual assumption would be as large as their travel."""
    travels = [max(motion.reach) for test in tests for part in test.parts for motion in part.motions
               if motion.channel == "displacement"]
    simulated = any(line == ("method", "inverse_fem") for line in ((each.key, each.value) for each in fit))
    if not simulated or not travels or _CONTACT_SHARE * min(travels) > DEFAULT_OFFSET_PRIOR or min(travels) <= 0:
        return []
    return [Line("contact_jitter_mm", float(f"{_CONTACT_SHARE * min(travels) * 1e3:.2g}"),
                 f"taken as {100 * _CONTACT_SHARE:g} % of the travel")]


def _problem(text: str, folder: Path) -> str | None:
    """Why the campaign cannot be calibrated as it stands."""
    # Beside its place, for its paths are relative; where that folder is not there yet they are made so.
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".import_") as place:
        path = Path(place).parent / f"{Path(place).name}.toml"
        try:
            write_text(path, text)
            read_measured(load_campaign(path))
        except InputError as error:
            there = error.file if error.file is not None and Path(error.file) != path else None
            return str(InputError(error.problem, file=there, line=error.line, field=error.field))
        finally:
            path.unlink(missing_ok=True)
    return None


def _warnings(parts: Sequence[Part], tests: Sequence[ImportedTest]) -> tuple[str, ...]:
    found: dict[str, Any] = {}
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
