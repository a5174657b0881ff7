"""Make the lines of a campaign for specimens, tests and fit from interpreted files and the options of the user.

The signals give the lines about omitted samples, the contact offset and relaxation. All files get one decimal mark, so
that replicates have equal options.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from calibration.importing.imported import (
    CampaignLine,
    ImportedTest,
    ImportOptions,
    ReplicateFile,
    is_test_key_used_by_kind,
)
from calibration.importing.specimen_sizes import explain_unusable_size_or_empty
from calibration.importing.zero import PRELOAD
from tissue_sim.experiment.kinds.kind import KINDS, SizeNames, TestKind
from tissue_sim.experiment.tools.tool import list_shapes_without_file
from tissue_sim.laws import LAWS
from tissue_sim.recording.contact import (
    INTERVAL_DEVIATIONS,
    relative_modulus_error_from_contact,
)
from tissue_sim.recording.formats.assumption import MODULUS_TOLERANCE
from tissue_sim.recording.formats.guesses import FileInterpretation, TableGroup
from tissue_sim.recording.formats.modulus_tables import has_moduli
from tissue_sim.recording.formats.sizes import SizeOrSpeedInMillimetres, find_sizes_and_speed_in_mm
from tissue_sim.recording.moduli import add_storage_and_loss_modulus
from tissue_sim.recording.recording import MIN_POINTS, Recording
from tissue_sim.recording.screening import ControlledQuantityFindings
from tissue_sim.recording.segments import get_positive_motion_load_and_units
from tissue_sim.settings import make_shallow_read_only_copy
from tissue_sim.specimen import SPECIMENS, specimen_sizes
from tissue_sim.specimen.specimen import get_size_declarations_of_shape

#: Bounds of a fitted contact offset, in its standard deviations.
_OFFSET_BOUNDS = 3.0
#: Smallest and largest relaxed fraction of the stiffness at the start of a fit.
_FRACTIONS = (0.1, 0.9)
#: Largest number of Prony terms at the start of a fit to tables of moduli.
_MOST_START_TERMS = 5


def make_outlier_leave_out_lines(parts: Sequence[ReplicateFile]) -> list[CampaignLine]:
    """Return the line ``leave_out`` of a test as a list of one line; an empty list without outliers.

    The line contains the sample numbers of the outliers, from 1, and the reason of the first outlier.
    """
    found: dict[str, list[int]] = {}
    reasons: list[str] = []
    for part in parts:
        several = len(part.motions) > 1
        for number, motion in enumerate(part.motions, start=1):
            samples = sorted({sample for each in motion.screening.left_out for sample in each.samples})
            if samples:
                found[f"{part.file.stem}_{number}" if several else part.file.stem] = samples
                reasons += [each.sentence for each in motion.screening.left_out]
    if not found:
        return []
    more = f"; and {len(reasons) - 1} more" if len(reasons) > 1 else ""
    alone = sum(len(part.motions) for part in parts) == 1
    return [CampaignLine("leave_out", next(iter(found.values())) if alone else found, f"{reasons[0]}{more}")]


class _ZeroMeanContactOffsetPriorInMm(NamedTuple):
    """Zero-mean normal prior of a fitted contact offset.

    Attributes:
        prior: standard deviation, mm.
        bound: largest absolute value, mm.
        reason: reason of the fit in one sentence.
    """

    prior: float
    bound: float
    reason: str


def make_contact_offset_lines(tests: Sequence[ImportedTest], *, bounded: bool) -> list[CampaignLine]:
    """Return the lines of ``[fit]`` that fit a contact offset; an empty list if no offset is needed.

    The offset is fitted if the displacement was zeroed at a preload, or if the interval of contact after motion in air
    is too wide for the modulus.

    Args:
        tests: imported tests.
        bounded: whether the method supports bounds of the offset.
    """
    found = [*_iterate_offset_priors_from_preloads(tests),
             *(_iterate_offset_priors_of_unclear_contacts(tests) if bounded else ())]
    if not found:
        return []
    widest = max(found, key=lambda each: each.prior)
    lines = [CampaignLine("offset", "fit", widest.reason),
             CampaignLine("offset_prior_mm", float(f"{widest.prior:.2g}"), "covers that distance")]
    if bounded:
        lines.append(CampaignLine("offset_bounds_mm", float(f"{widest.bound:.2g}"), "largest offset"))
    return lines


def _iterate_offset_priors_from_preloads(tests: Sequence[ImportedTest]) -> Iterator[_ZeroMeanContactOffsetPriorInMm]:
    """Yield a prior of the contact offset, mm, for each test whose displacement was zeroed at a preload."""
    for test in tests:
        if test.zero is None or test.zero.value != PRELOAD:
            continue
        shift = 1e3 * abs(test.zero.shift)
        side = "after contact" if test.zero.load > 0 else "before the force of the specimen is zero"
        yield _ZeroMeanContactOffsetPriorInMm(shift, _OFFSET_BOUNDS * shift,
                                              f"{test.name}: the displacement was zeroed at a preload of "
                                              f"{test.zero.load:.3g} N, about {shift:.2g} mm {side}")


def _iterate_offset_priors_of_unclear_contacts(
        tests: Sequence[ImportedTest]) -> Iterator[_ZeroMeanContactOffsetPriorInMm]:
    """Yield a prior of the contact offset, mm, for each recording whose contact is too uncertain for the modulus.

    The limit is `MODULUS_TOLERANCE`; only tests with motion in air before contact are examined.
    """
    for test in tests:
        if not any(line.key == "contact" for line in test.lines):
            continue
        for part in test.parts:
            for recording, motion in zip(part.reading.recordings, part.motions, strict=True):
                contact = motion.contact
                if contact is None or motion.channel != "displacement":
                    continue
                kept = recording if motion.kept is None else recording.select(motion.kept)
                kind = KINDS.get(test.kind) if test.kind else None
                displacement, load, _ = get_positive_motion_load_and_units(kept, kind)
                time = kept.time if "time" in kept else None
                displacement, load = contact.subtract_contact_zero_and_drift(displacement, load, time)
                pressed = displacement >= 0
                error = relative_modulus_error_from_contact(displacement[pressed], load[pressed],
                                                            None if time is None else time[pressed], contact)
                half = 0.5e3 * (contact.interval[1] - contact.interval[0])
                if error > MODULUS_TOLERANCE:
                    yield _ZeroMeanContactOffsetPriorInMm(half / INTERVAL_DEVIATIONS, half,
                                                          f"{test.name}: contact is known to "
                                                          f"{half:.2g} mm, which changes the modulus by "
                                                          f"{100 * error:.2g} %")


def make_prony_term_start_lines(tests: Sequence[ImportedTest]) -> list[CampaignLine]:
    """Return the line ``start`` of ``[fit]`` (start values of one Prony term) as a list of one line.

    The values are from the first test that an elastic law cannot describe; without such a test the list is empty.
    """
    for test in tests:
        for part in test.parts:
            for motion in part.motions:
                control = motion.screening.control
                if control is not None and motion.rate is not None and needs_viscoelasticity(control):
                    lost = control.creep / (1 + control.creep) if control.pattern == "creep" else control.relaxation
                    low, high = _FRACTIONS
                    start = {"viscoelastic.terms[0].g": float(f"{min(max(1.2 * lost, low), high):.2g}"),
                             "viscoelastic.terms[0].tau_s": float(f"{control.time_constant:.3g}")}
                    reason = control.sentence.partition("; state")[0]
                    return [CampaignLine("start", start, f"{test.name}: {reason}")]
    return []


def make_start_lines_of_moduli(tables: Sequence[Recording]) -> list[CampaignLine]:
    """Return the line ``start`` of ``[fit]`` with Prony terms for tables of moduli, one term for each decade or so.

    The relaxation times are evenly spaced, on a logarithmic axis, between the inverses of the angular frequencies. The
    fractions are equal, and their sum is that of the decrease of the storage modulus.
    """
    frequency = np.concatenate([table.channel("frequency") for table in tables])
    storage = [add_storage_and_loss_modulus(table).channel("storage modulus") for table in tables]
    low, high = float(frequency.min()), float(frequency.max())
    count = int(np.clip(round(math.log10(high / low)), 1, _MOST_START_TERMS))
    edges = np.geomspace(1.0 / (2.0 * np.pi * high), 1.0 / (2.0 * np.pi * low), 2 * count + 1)
    lowest, highest = _FRACTIONS
    lost = min(max(1.0 - float(np.mean([each.min() / each.max() for each in storage])), lowest), highest)
    start: dict[str, float] = {}
    for i, time in enumerate(edges[1::2]):
        start[f"viscoelastic.terms[{i}].g"] = float(f"{lost / count:.2g}")
        start[f"viscoelastic.terms[{i}].tau_s"] = float(f"{time:.2g}")
    return [CampaignLine("start", start, f"relaxation times within 1 / omega of {low:.3g} to {high:.3g} Hz; add or "
                         "remove terms")]


def needs_viscoelasticity(control: ControlledQuantityFindings) -> bool:
    """Return whether a hold shows relaxation or creep that an elastic law cannot describe.

    A recording of creep needs viscoelasticity if its loading has too few samples for an elastic fit.
    """
    if control.time_constant is None:
        return False
    return not control.can_elastic_law_describe_loading or (control.pattern == "creep" and control.loading < MIN_POINTS)


def copy_interpretations_with_common_decimal_mark(understood: Sequence[FileInterpretation]) -> list[FileInterpretation]:
    """Copy the option ``decimal`` of some files to the options of all other files that have the same decimal mark.

    A file with thousands separators states its decimal mark in the campaign. Replicates with smaller numbers have no
    separators; with the same option, they remain replicates.
    """
    stated = {reading.options["decimal"] for each in understood for reading in each.readings
              if "decimal" in reading.options}
    if len(stated) != 1:
        return list(understood)
    mark, = stated

    def add_decimal_option_if_same_mark(each: FileInterpretation, reading: TableGroup) -> TableGroup:
        """Return the reading with the option ``decimal``; unchanged if the file has another mark or open questions."""
        if "decimal" in reading.options or "columns" not in reading.options or each.decimal_mark != mark or any(
                assumption.needs_user_decision for assumption in each.assumptions):
            return reading
        options = dict(reading.options)
        columns = options.pop("columns")
        return replace(reading, options=make_shallow_read_only_copy({**options, "decimal": mark, "columns": columns}))

    return [replace(each, readings=tuple(add_decimal_option_if_same_mark(each, reading) for reading in each.readings))
            for each in understood]


def explain_why_campaign_states_decimal_mark(parts: Sequence[ReplicateFile]) -> str:
    """Return the reason why a campaign states the decimal mark of its files; empty if no assumption concerns it."""
    found = [assumption for part in parts for assumption in part.understanding.assumptions
             if assumption.subject in ("thousands separator", "decimal mark")]
    found.sort(key=lambda each: each.subject, reverse=True)
    return "" if not found else f"{found[0].subject}: {found[0].value}; {'; '.join(found[0].evidence)}"


#: Method of the fit -> laws that are fitted if the user states none.
DEFAULT_LAWS = {"analytical": ("neo_hooke", "mooney_rivlin", "reduced_polynomial_2", "ogden_1"),
                "inverse_fem": ("neo_hooke", "reduced_polynomial_2")}
#: Ratio of bulk modulus to initial shear modulus of a simulated tissue, if the user does not state it.
_BULK_RATIO = 1000.0


def get_specimen_sizes_by_priority(reading: TableGroup, wishes: ImportOptions) -> dict[str, SizeOrSpeedInMillimetres]:
    """Return the sizes of the specimen that the user, the sidecar or the file states: key in ``[[specimen]]`` -> size.

    Sizes that the user states override those of the sidecar, and sizes of the sidecar override those of the file.
    """
    found = find_sizes_and_speed_in_mm(reading.stated, reading.kind.kind)
    found |= {key: SizeOrSpeedInMillimetres(key, float(value), "in the sidecar of the recording")
              for key, value in reading.specimen.items() if key != "shape"}
    if any(key in wishes.specimen for key in ("radius_mm", "area_mm2")):
        found = {key: size for key, size in found.items() if key not in ("radius_mm", "area_mm2")}
    return found | {key: SizeOrSpeedInMillimetres(key, float(value), "stated") for key, value in wishes.specimen.items()
                    if key != "shape"}


def make_specimen_lines_and_missing(reading: TableGroup, wishes: ImportOptions, kind: TestKind | None
                                    ) -> tuple[tuple[CampaignLine, ...], list[str]]:
    """Return the lines of ``[[specimen]]`` for a reading, and one phrase for each missing size."""
    sizes = get_specimen_sizes_by_priority(reading, wishes)
    shape, reason = wishes.specimen.get("shape"), "stated"
    if not wishes.specimen and reading.specimen.get("shape") in SPECIMENS:
        shape, reason = reading.specimen["shape"], "in the sidecar of the recording"
    if shape is not None:
        return _make_shape_lines_and_missing(str(shape), sizes, reason)
    if kind is not None and kind.has_several_motions:
        return _make_shape_lines_and_missing("block", sizes, "a sheet; height along axis 1, length along axis 2",
                                             "--shape block ")
    lines, missing = [], []
    is_round = kind is not None and kind.size_names.is_round
    flat = not is_round and ("area_mm2" in sizes or (
        kind is not None and kind.has_gripped_ends and "radius_mm" not in sizes))
    lines.append(CampaignLine("shape", "prism" if flat else "cylinder"))
    height = (SizeNames() if kind is None else kind.size_names).height[0]
    for key, what in (("area_mm2", "cross-section") if flat else ("radius_mm", "radius"), ("height_mm", height)):
        if key in sizes:
            lines.append(CampaignLine(key, sizes[key].value, sizes[key].reason))
        else:
            flag = f"--{key.replace('_', '-')}"
            also = " (or --radius-mm)" if key == "area_mm2" else ""
            unclear = explain_unusable_size_or_empty(reading, key)
            lines.append(CampaignLine(key, None, f"{what} of the specimen, {unclear or 'which no file states'}; "
                                      f"{flag}{also}"))
            missing.append(f"the {what} of the specimen ({flag}{also}{f'; {unclear}' if unclear else ''})")
    return tuple(lines), missing


def _make_shape_lines_and_missing(shape: str, sizes: Mapping[str, SizeOrSpeedInMillimetres], reason: str,
                                  shape_flag: str = "") -> tuple[tuple[CampaignLine, ...], list[str]]:
    """Return the lines of ``[[specimen]]`` with a known shape, and one phrase for each missing size."""
    lines, missing = [CampaignLine("shape", shape, reason)], []
    for key, declared in get_size_declarations_of_shape(shape).items():
        flag = f"{shape_flag}--{key.replace('_', '-')}"
        if key in sizes:
            lines.append(CampaignLine(key, sizes[key].value, sizes[key].reason))
        elif declared.absent is None:
            lines.append(CampaignLine(key, None, f"of the specimen, which no file states; {flag}"))
            missing.append(f"the {specimen_sizes()[key].field.replace('_', ' ')} of the specimen ({flag})")
    return tuple(lines), missing


def make_test_lines_and_missing(parts: Sequence[ReplicateFile],
                                wishes: ImportOptions) -> tuple[list[CampaignLine], list[str]]:
    """Return the lines of a ``[[test]]`` for its replicates, and one phrase for each missing entry.

    The lines of name, specimen, recordings and columns are not included.
    """
    reading, missing = parts[0].reading, []
    lines = [CampaignLine("kind", reading.kind.kind, reading.kind.reason if reading.kind.kind else
                          f"{reading.kind.reason}; one of {', '.join(KINDS)} (--kind)")]
    if reading.kind.kind is None:
        missing.append("the kind of test (--kind)")
    missing += [f"{what} (--{'scale' if what.startswith('the scale') else 'unit'} "
                f"{_get_channel_name_in_flag(column.channel)}=...)" for column in reading.columns
                if (what := column.missing_information_text_or_none)]
    lines += [CampaignLine(key, value, explain_why_campaign_states_decimal_mark(parts) if key == "decimal" else "")
              for key, value in reading.options.items() if key != "columns"]
    kind = KINDS[reading.kind.kind] if reading.kind.kind else None
    test = dict(wishes.test)
    if kind is not None and kind.tool_stated:
        more, lacks = _make_tool_lines_and_missing(test, reading)
        lines, missing = [*lines, *more], [*missing, *lacks]
    if kind is not None and kind.face.stated and "friction" not in test:
        lines.append(CampaignLine("friction", None, "coefficient of friction of both plates, or \"stick\"; --friction"))
        missing.append("the friction of the plates (--friction)")
    lines += _make_lines_of_signals(parts, is_control_stated="control" in test)
    lines += make_outlier_leave_out_lines(parts)
    lines += _make_speed_lines(parts, test.pop("speed_mm_s", None))
    lines += [CampaignLine(key, value, "stated") for key,
              value in test.items() if is_test_key_used_by_kind(key, value, kind)]
    return lines, missing


def _make_speed_lines(parts: Sequence[ReplicateFile], stated: float | None) -> list[CampaignLine]:
    """Return the line ``speed_mm_s`` for recordings without displacement or without time; otherwise an empty list."""
    reading = parts[0].reading
    if reading.speed is not None:
        speed, source = reading.speed
        return [CampaignLine("speed_mm_s", round(1e3 * speed, 9),
                             "no column of the motion: displacement = speed x time from "
                             f"the first sample; {source}")]
    has_clock = any(motion.rate is not None for part in parts for motion in part.motions)
    if has_clock or "displacement" not in reading.recordings[0]:
        return []
    if stated is not None:
        return [CampaignLine("speed_mm_s", stated, "no clock; stated")]
    found = find_sizes_and_speed_in_mm(reading.stated, None).get("speed_mm_s")
    return [] if found is None else [CampaignLine("speed_mm_s", found.value, f"no clock; {found.reason}")]


def _make_tool_lines_and_missing(test: Mapping[str, Any], reading: TableGroup) -> tuple[list[CampaignLine], list[str]]:
    """Return the lines of shape, radius and friction of an indenter, and one phrase for each missing entry.

    Args:
        test: keys of ``[[test]]`` that the user states.
        reading: reading of a file, whose metadata may name the tool.
    """
    lines: list[CampaignLine] = []
    missing: list[str] = []
    said = reading.recordings[0].metadata
    shapes = ", ".join(shape for shape in list_shapes_without_file() if shape != "plate")
    for key, what, flag in (("tool", "the shape of the tool", "--tool"),
                            ("tool_radius_mm", "the radius of the tool", "--tool-radius-mm")):
        if key in test:
            continue
        if key in said:
            lines.append(CampaignLine(key, said[key], "in the file"))
            continue
        lines.append(CampaignLine(key, None, f"{what}{f', {shapes}' if key == 'tool' else ''}; {flag}"))
        missing.append(f"{what} ({flag})")
    shape = test.get("tool", said.get("tool", "flat"))
    if "friction" not in test and shape != "flat":
        lines.append(CampaignLine("friction", "stick",
                                  f"taken so: tissue does not slip on a {shape}, and can lift off"))
    return lines, missing


def _make_lines_of_signals(parts: Sequence[ReplicateFile], *, is_control_stated: bool) -> list[CampaignLine]:
    """Return ``contact = "find"`` for air before contact, ``failure = "cut"`` for a failure, ``control = "force"``.

    Args:
        parts: replicates of one test.
        is_control_stated: whether the user states the controlled quantity.
    """
    lines = []
    motions = [(part.file.name, motion) for part in parts for motion in part.motions]
    air = [(name, motion.contact) for name,
           motion in motions if motion.starts_in_air_or_none_if_unclear and motion.contact is not None]
    kind = KINDS.get(parts[0].reading.kind.kind or "")
    if kind is not None and kind.load_count > 1:
        air = []  # The contact of a test with several loads is that of the recording.
    zeroed = any("zeroing" in recording.metadata for part in parts for recording in part.reading.recordings)
    if air and not zeroed and all(motion.starts_in_air_or_none_if_unclear is not None for _, motion in motions):
        name, contact = air[0]
        lines.append(CampaignLine("contact", "find",
                                  f"{name}: {contact.in_words(motions[0][1].found.units)}"))
    failed = next(((name, motion) for name, motion in motions if motion.failure is not None), None)
    if failed is not None and failed[1].failure is not None:
        said = failed[1].failure.in_words(failed[1].found.units)
        lines.append(CampaignLine("failure", "cut", f"{failed[0]}: {said}; fitted up to there"))
    driven = [control for _, motion in motions if (control := motion.screening.control) is not None
              and control.quantity == "force" and not control.equal_samples and motion.rate is not None]
    # A table of moduli has no motion.
    if driven and not is_control_stated and len(driven) == len(motions):
        reason = "held while the displacement creeps" if driven[0].pattern == "creep" else "a line in time"
        lines.append(CampaignLine("control", "force", f"{motions[0][0]}: the force is {reason}"))
    return lines


def _get_channel_name_in_flag(channel: str) -> str:
    """Return the name of a channel as the user types it in a flag: ``shear_strain`` in ``--unit shear_strain=...``."""
    return channel.removesuffix(" 2").replace("nominal stress", "stress").replace(" ", "_")


def make_fit_lines_and_missing(tests: Sequence[ImportedTest], wishes: ImportOptions
                               ) -> tuple[list[CampaignLine], list[str]]:
    """Return the lines of ``[fit]`` and one phrase for each missing entry.

    The lines are method, laws, bulk ratio, contact offset and viscoelastic start values.
    """
    kinds = [KINDS[test.kind] for test in tests if test.kind]
    missing: list[str] = []
    tables = [recording for test in tests for part in test.parts for recording in part.reading.recordings
              if has_moduli(part.reading)]
    closed = all(kind.closed_form is not None for kind in kinds)
    method = "analytical" if closed and not tables else "inverse_fem"
    why = ("every test has a closed form" if closed else
           f"{next(kind.name for kind in kinds if kind.closed_form is None)} has no closed form")
    if closed and tables:
        why = "weights moduli by their noise; every test has a closed form"
    only_tables = all(has_moduli(part.reading) for test in tests for part in test.parts)
    laws, reason = (("neo_hooke",), "moduli at one strain determine one modulus") if only_tables else \
        (DEFAULT_LAWS[method], "of two parameters at most")
    lines = [CampaignLine("method", method, why),
             CampaignLine("laws", list(wishes.laws or laws), "stated" if wishes.laws else reason)]
    if wishes.laws and all(name in LAWS and LAWS[LAWS.get_name_of_alias(name)].is_compressible for name in wishes.laws):
        return [*lines, *make_contact_offset_lines(tests, bounded=closed)], missing
    if any(kind.has_lateral_wall for kind in kinds):
        lines.append(CampaignLine("bulk_ratio", None, "K / mu0; the test measures K + 4/3 mu0 only"))
        missing.append("the ratio K / mu0 of the specimen in confined compression (fit.bulk_ratio, or bulk.K_Pa in "
                       "fit.start and a test with free sides)")
    elif not closed:
        lines.append(CampaignLine("bulk_ratio", _BULK_RATIO,
                                  "K / mu0; gels and soft tissues hardly change their volume"))
    return [*lines, *make_contact_offset_lines(tests, bounded=closed), *(
        make_start_lines_of_moduli(tables) if tables else make_prony_term_start_lines(tests))], missing
