"""Make the lines of a campaign for specimens, tests and fit from interpreted files and the options of the user."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from calibration.importing.decimal_marks import explain_why_campaign_states_decimal_mark
from calibration.importing.flags import is_test_key_used_by_kind
from calibration.importing.imported import CampaignLine, ImportedTest, ImportOptions, ReplicateFile
from calibration.importing.signal_lines import (
    make_contact_offset_lines,
    make_outlier_leave_out_lines,
    make_prony_term_start_lines,
)
from calibration.importing.size_assumptions import explain_unusable_size_or_empty
from tissue_sim.experiment.kinds.kind import KINDS, TestKind
from tissue_sim.experiment.tools.tool import list_shapes_without_file
from tissue_sim.recording.formats.guesses import TableGroup
from tissue_sim.recording.formats.sizes import SizeOrSpeedInMillimetres, find_sizes_and_speed_in_mm
from tissue_sim.specimen import SPECIMENS, specimen_sizes
from tissue_sim.specimen.specimen import get_size_declarations_of_shape

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
    lines, missing = [], []
    flat = "area_mm2" in sizes or (kind is not None and kind.has_gripped_ends and "radius_mm" not in sizes)
    lines.append(CampaignLine("shape", "prism" if flat else "cylinder"))
    for key, what in (("area_mm2", "cross-section") if flat else ("radius_mm", "radius"),
                      ("height_mm", "gauge length" if kind is not None and kind.name == "uniaxial_tension" else
                       "thickness" if kind is not None and kind.name == "simple_shear" else "height")):
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


def _make_shape_lines_and_missing(shape: str, sizes: Mapping[str, SizeOrSpeedInMillimetres],
                                  reason: str) -> tuple[tuple[CampaignLine, ...], list[str]]:
    """Return the lines of ``[[specimen]]`` with a stated shape, and one phrase for each missing size."""
    lines, missing = [CampaignLine("shape", shape, reason)], []
    for key, declared in get_size_declarations_of_shape(shape).items():
        flag = f"--{key.replace('_', '-')}"
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
    lines += _make_air_and_failure_lines(parts)
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


def _make_air_and_failure_lines(parts: Sequence[ReplicateFile]) -> list[CampaignLine]:
    """Return ``contact = "find"`` for air before contact and ``failure = "cut"`` for a failure; else no line."""
    lines = []
    motions = [(part.file.name, motion) for part in parts for motion in part.motions]
    air = [(name, motion.contact) for name,
           motion in motions if motion.starts_in_air_or_none_if_unclear and motion.contact is not None]
    zeroed = any("zeroing" in recording.metadata for part in parts for recording in part.reading.recordings)
    if air and not zeroed and all(motion.starts_in_air_or_none_if_unclear is not None for _, motion in motions):
        name, contact = air[0]
        lines.append(CampaignLine("contact", "find",
                                  f"{name}: {contact.in_words(stressed=motions[0][1].found.stressed)}"))
    failed = next(((name, motion) for name, motion in motions if motion.failure is not None), None)
    if failed is not None and failed[1].failure is not None:
        said = failed[1].failure.in_words(stressed=failed[1].found.stressed)
        lines.append(CampaignLine("failure", "cut", f"{failed[0]}: {said}; fitted up to there"))
    return lines


def _get_channel_name_in_flag(channel: str) -> str:
    """Return the name of a channel as the user types it in a flag: ``shear_strain`` in ``--unit shear_strain=...``."""
    return {"nominal stress": "stress"}.get(channel, channel.replace(" ", "_"))


def make_fit_lines(tests: Sequence[ImportedTest], wishes: ImportOptions) -> list[CampaignLine]:
    """Return the lines of ``[fit]``: method, laws, bulk ratio, contact offset and viscoelastic start values."""
    kinds = [KINDS[test.kind] for test in tests if test.kind]
    closed = all(kind.closed_form is not None for kind in kinds)
    method = "analytical" if closed else "inverse_fem"
    why = ("every test has a closed form" if closed else
           f"{next(kind.name for kind in kinds if kind.closed_form is None)} has no closed form")
    lines = [CampaignLine("method", method, why),
             CampaignLine("laws", list(wishes.laws or DEFAULT_LAWS[method]),
                          "stated" if wishes.laws else "of two parameters at most")]
    if not closed:
        lines.append(CampaignLine("bulk_ratio", _BULK_RATIO,
                                  "K / mu0; gels and soft tissues hardly change their volume"))
    return [*lines, *make_contact_offset_lines(tests, bounded=closed), *make_prony_term_start_lines(tests)]
