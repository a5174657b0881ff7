"""List the assumptions about the columns of a table, and alternatives that the evidence does not exclude."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.recording.cleaning import remove_outliers_and_saturation
from tissue_sim.recording.formats.assumption import AlternativeValue, Assumption
from tissue_sim.recording.formats.guesses import ColumnGuess, InterpretationOverrides
from tissue_sim.recording.formats.pairing import add_measure_conversion_to_column, is_converted_by_gauge_length
from tissue_sim.recording.formats.vocabulary import (
    MachineFormat,
    classify_column_source_or_empty,
    normalize_header_text,
)
from tissue_sim.recording.measures import (
    ENGINEERING,
    MEASURES,
    find_measure_name_in_header_or_none,
    list_other_measures_named_by_words,
)
from tissue_sim.recording.recording import CHANNELS, Recording
from tissue_sim.units import UNITS, split_header_and_known_unit


def list_value_pairs_valid_in_both_interpretations(first: Sequence[Recording], second: Sequence[Recording], channel: str
                                                   ) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return a channel of two interpretations of a table, only samples that are valid in both.

    A sample that is invalid in one reading is omitted in both, because one lost value of 9999 would determine the
    result of the comparison.

    Args:
        first: recordings of the first reading.
        second: recordings of the second reading, with other columns, in the same order.
        channel: name of a channel in both readings.

    Returns:
        For each recording, the values of both readings, each of shape (k,). The list is empty if the readings have
        different numbers of samples, or if one of them has too many outliers.
    """
    if [len(each) for each in first] != [len(each) for each in second]:
        return []
    try:
        masks = [_make_mask_without_outliers_and_saturation(one) & _make_mask_without_outliers_and_saturation(other)
                 for one, other in zip(first, second, strict=True)]
    except InputError:
        return []
    return [(one.channel(channel)[mask], other.channel(channel)[mask])
            for one, other, mask in zip(first, second, masks, strict=True)]


def _make_mask_without_outliers_and_saturation(recording: Recording) -> np.ndarray:
    """Return whether each sample is neither an outlier nor saturated, shape (n,)."""
    _, screening = remove_outliers_and_saturation(recording)
    return ~np.isin(np.arange(1, len(recording) + 1), screening.left_out_sample_numbers)


#: Columns -> recordings of the table.
Read = Callable[[Sequence[ColumnGuess]], tuple[Recording, ...]]


@dataclass(frozen=True)
class ColumnComparisonSettings:
    """Thresholds for the comparison of columns.

    Attributes:
        largest_strain: strain above which numbers may be in % if their unit is missing or is a ratio, such as mm/mm.
            Specimens of soft tissue fail at smaller strains.
        largest_certain_strain: the same threshold for a shear strain, a stretch and a column that the user names;
            elastomers reach 10.
        agreement: largest relative difference of two strains that agree.
        same_unit: largest relative difference of a strain and of a displacement over the gauge length that agree; the
            displacement includes the compliance of the frame.
        noted_difference: relative difference above which two columns of the same quantity are reported.
        decisive_difference: relative difference above which equally plausible columns of the same quantity are a
            question to the user.
        correlation: correlation below which a column does not measure the same quantity.
        connected_range: relative range below which the sensor of a column is not connected.
    """

    largest_strain: float = 2.0
    largest_certain_strain: float = 12.0
    agreement: float = 0.02
    same_unit: float = 0.5
    noted_difference: float = 0.01
    decisive_difference: float = 0.05
    correlation: float = 0.9
    connected_range: float = 0.02


#: Settings that the functions of this module use.
_SETTINGS = ColumnComparisonSettings()
#: Channel -> reason of an inverted sign.
_TURNED = {"displacement": "falls under load", "force": "against the motion", "nominal stress": "against the motion",
           "stretch": "positive in compression"}


def get_command_line_channel_name(channel: str) -> str:
    """Return the name of a channel in options of the command line: ``stress`` for the nominal stress."""
    return channel.replace("nominal stress", "stress").replace(" ", "_")


def make_machine_assumption(machine: MachineFormat | None, hints: InterpretationOverrides) -> Assumption:
    """Return the assumption about the machine that wrote the file."""
    if machine is None:
        return Assumption("format", "table", ("no mark of a known machine",), flag="--format table",
                          is_stated=hints.format == "table")
    return Assumption("format", machine.title, () if hints.format else ("its marks are in the file",),
                      flag=f"--format {machine.name}", is_stated=hints.format is not None)


def iterate_column_assumptions(read: Read, columns: Sequence[ColumnGuess], recordings: Sequence[Recording],
                               others: Sequence[ColumnGuess],
                               hints: InterpretationOverrides) -> Iterator[Assumption]:
    """Yield the assumptions about role, unit, sign and measure of each column.

    Args:
        read: function that reads the table with given columns.
        columns: columns that are read.
        recordings: recordings of the columns.
        others: further columns with the same quantities.
        hints: hints of the user.
    """
    for column in columns:
        channel, flag = column.channel, get_command_line_channel_name("strain" if column.role == "strain"
                                                                      else column.channel)
        name = column.header or f"column {column.place}"
        is_named = bool(hints.columns)
        yield Assumption(f"column of {channel}", name, () if is_named else (column.reason.split(";")[0],),
                         is_stated=is_named,
                         flag=f"--column {flag}={_quote_for_command_line(column.header or str(column.place))}")
        yield _make_unit_assumption(read, column, columns, recordings, others, hints, flag)
        if channel not in ("time", "temperature"):
            is_signed = not hints.signs.keys().isdisjoint({channel.removesuffix(" 2"), column.role})
            turned = column.sign < 0
            evidence = () if is_signed else (
                (_TURNED.get(channel, "negative under load"),) if turned else ("positive under load",))
            yield Assumption(f"sign of {channel}", "turned" if turned else "as in the file", evidence,
                             flag=f"--sign {flag}={column.sign}", is_stated=is_signed)
        if channel in ("stretch", "nominal stress") or column.measure:
            yield _make_measure_assumption(read, column, columns, recordings, hints, flag)


def make_constant_speed_assumption(speed: tuple[float, str], recordings: Sequence[Recording]) -> Assumption:
    """Return the assumption of a constant speed for a table of time and force without a displacement."""
    value, source = speed
    against = []
    for recording in recordings:
        force = np.abs(recording.force)
        peak = int(np.argmax(force))
        if force[-1] < (1.0 - _SETTINGS.decisive_difference) * force[peak]:
            against = [f"the force falls after {recording.time[peak]:.4g} s: if the motion stopped or turned there, "
                       "only the part before counts"]
    return Assumption("displacement", f"{1e3 * value:.6g} mm/s x time from the first sample",
                      () if source == "stated" else (source,), tuple(against), flag=f"--speed-mm-s {1e3 * value:.6g}",
                      is_stated=source == "stated")


def compare_columns_and_replace_constant_ones(read: Read, columns: tuple[ColumnGuess, ...],
                                              recordings: tuple[Recording, ...], rivals: Sequence[ColumnGuess]
                                              ) -> tuple[tuple[ColumnGuess, ...], tuple[Recording, ...],
                                                         tuple[Assumption, ...], tuple[str, ...]]:
    """Compare each column with other columns of the same quantity.

    A column that was measured on the specimen, or corrected, is preferred. A constant column is replaced, because its
    sensor is not connected. Different columns of equal rank are a question to the user. Outliers are omitted.

    Args:
        read: function that reads the table with given columns.
        columns: columns that are read.
        recordings: recordings of the columns.
        rivals: other columns of the same quantities.

    Returns:
        Columns and recordings (with replaced constant columns), assumptions about differences, and sentences for the
        user.
    """
    assumptions: list[Assumption] = []
    remarks: list[str] = []
    for rival in rivals:
        column = next((each for each in columns if each.channel == rival.channel), None)
        if column is None or column.missing_information_text_or_none or rival.missing_information_text_or_none \
            or column.measure != rival.measure:
            continue
        swapped = tuple(replace(rival, sign=each.sign) if each is column else each for each in columns)
        try:
            other = read(swapped)
        except InputError:
            continue
        pairs = [pair for pair in list_value_pairs_valid_in_both_interpretations(recordings, other, column.channel)
                 if pair[0].size]
        if not pairs:
            continue
        own, its = (np.concatenate([pair[which] - pair[which][0] for pair in pairs]) for which in (0, 1))
        if np.ptp(its) == 0:
            continue
        if np.ptp(own) < _SETTINGS.connected_range * np.ptp(its) and rival.rank > column.rank:
            remarks.append(f"column {column.header!r} does not move, so that {rival.header!r} is read in its place")
            columns, recordings = swapped, other
            continue
        if np.ptp(own) == 0 or abs(np.corrcoef(own, its)[0, 1]) < _SETTINGS.correlation:
            continue
        ratio = float(np.ptp(its) / np.ptp(own))
        if abs(ratio - 1.0) <= _SETTINGS.noted_difference:
            continue
        means = f" ({rival.reason.split('; ')[-1]})" if is_converted_by_gauge_length(rival) else ""
        said = (f"{rival.header!r} has {abs(100 * (ratio - 1)):.0f} % {'more' if ratio > 1 else 'less'} "
                f"{column.channel} than {column.header!r}{means}")
        modulus = ratio if CHANNELS[column.channel] in ("force", "stress") else 1.0 / ratio
        is_question = rival.rank == column.rank and abs(ratio - 1.0) > _SETTINGS.decisive_difference
        flags = _make_flags_of_all_columns(swapped)
        alternatives = (AlternativeValue(rival.header, modulus, flags),) if is_question else ()
        if classify_column_source_or_empty(normalize_header_text(column.header)) == "specimen":
            said += "; the height must be the gauge length of this sensor"
        assumptions.append(Assumption(f"source of {column.channel}", column.header, () if is_question else (
            "measured on the specimen, corrected, or the more specific name",), (said,), alternatives,
            _make_flags_of_all_columns(columns) if is_question else ""))
        if not is_question:
            remarks.append(said)
    return columns, recordings, tuple(assumptions), tuple(remarks)


def _make_flags_of_all_columns(columns: Sequence[ColumnGuess]) -> str:
    """Return flags that name all columns, because a named column is read only with other named columns."""
    channels = [each.role if is_converted_by_gauge_length(each) else each.channel for each in columns]
    return " ".join(f"--column {get_command_line_channel_name(channel)}="
                    f"{_quote_for_command_line(each.header or str(each.place))}"
                    for channel, each in zip(channels, columns, strict=True))


def _quote_for_command_line(text: str) -> str:
    """Return a text in quotation marks, unless the text consists of letters and digits only."""
    return f'"{text}"' if not text.isalnum() else text


def _make_unit_assumption(read: Read, column: ColumnGuess, columns: Sequence[ColumnGuess],
                          recordings: Sequence[Recording],
                          others: Sequence[ColumnGuess], hints: InterpretationOverrides, flag: str) -> Assumption:
    """Return the assumption about the unit of a column, with % or a contradictory unit as an alternative."""
    channel, subject = column.channel, f"unit of {column.channel}"
    is_stated = not (hints.units.keys() | hints.scales.keys()).isdisjoint({channel.removesuffix(" 2"), column.role})
    alternatives = () if is_stated or not _is_strain_or_stretch_without_factor(column) \
        else _list_percent_as_alternative_if_plausible(
        read, column, columns, recordings, others, flag, is_named=bool(hints.columns))
    if column.unit is None and CHANNELS[channel] == "ratio" and column.scale is None:
        return Assumption(subject, "-", ("no unit in the file: a ratio",), alternatives=alternatives,
                          flag=f"--unit {flag}=-", is_stated=is_stated)
    value = column.unit or "not stated"
    if is_converted_by_gauge_length(column):
        if alternatives:
            return Assumption("unit of strain", column.strain_unit or "-", (column.reason.split("; ")[-1],), (),
                              alternatives, f"--unit {flag}={column.strain_unit}")
        return Assumption(subject, value, (column.reason.split("; ")[-1],))
    if column.other_unit is not None and not is_stated and column.unit is not None:
        own, other = (UNITS[unit][1] for unit in (column.unit, column.other_unit))
        grows = CHANNELS[channel] in ("force", "stress")
        rival = f"the {'cells have' if _has_cell_units(column) else 'row of units has'} {column.other_unit}"
        return Assumption(subject, value, (f"in the header {column.header!r}",), (rival,), (AlternativeValue(
                column.other_unit, other / own if grows else None if channel == "time" else own / other,
                f"--unit {flag}={column.other_unit}"),), f"--unit {flag}={column.unit}")
    if is_stated or column.missing_information_text_or_none:
        evidence: tuple[str, ...] = ()
    elif split_header_and_known_unit(column.header)[1] is not None:
        evidence = (f"in the header {column.header!r}",)
    elif _has_cell_units(column):
        evidence = ("after each number of the column",)
    else:
        evidence = (column.reason.split(";")[-1].strip() if "writes" in column.reason else "in the row of units",)
    return Assumption(subject, value, evidence, alternatives=alternatives,
                      flag=f"--unit {flag}={column.unit or '...'}", is_stated=is_stated)


def _has_cell_units(column: ColumnGuess) -> bool:
    """Return whether the cells of a column have units after their numbers."""
    return "unit after each number" in column.reason


def _is_strain_or_stretch_without_factor(column: ColumnGuess) -> bool:
    """Return whether the numbers of a column, without a unit or in mm/mm, are strains or stretches without a factor."""
    if column.strain_unit is not None:
        return UNITS.get(column.strain_unit) == UNITS["-"]
    return CHANNELS[column.channel] == "ratio" and column.scale is None and (
        column.unit is None or UNITS.get(column.unit) == UNITS["-"])


def _list_percent_as_alternative_if_plausible(read: Read, column: ColumnGuess, columns: Sequence[ColumnGuess],
                                              recordings: Sequence[Recording], others: Sequence[ColumnGuess], flag: str,
                                              *, is_named: bool) -> tuple[AlternativeValue, ...]:
    """Return the unit % as an alternative for large strains without a unit; empty if % is excluded.

    Another measure of strain, or displacement over gauge length, that agrees with the strains excludes %.
    """
    values = np.concatenate([own for own,
                             _ in list_value_pairs_valid_in_both_interpretations(recordings, recordings,
                                                                                 column.channel)])
    # A derived displacement is the strain times the gauge length, which is its scale in mm.
    length = 1e-3 * (column.scale or 1e3)
    largest = float(np.abs(values - (column.channel == "stretch" and column.role == "strain")).max()) / length
    is_sure = column.role != "strain" or is_named
    if column.measure or largest <= (_SETTINGS.largest_certain_strain if is_sure else _SETTINGS.largest_strain):
        return ()
    for other in others:
        same = (other.measure == column.measure
                and is_converted_by_gauge_length(other) == is_converted_by_gauge_length(column))
        if other.channel != column.channel or same or other.missing_information_text_or_none:
            continue
        try:
            rival = read([other if each is column else each for each in columns])
        except InputError:
            continue
        pairs = [pair for pair in list_value_pairs_valid_in_both_interpretations(recordings, rival, column.channel)
                 if pair[0].size]
        limit = (_SETTINGS.agreement if other.measure != column.measure else _SETTINGS.same_unit) * largest * length
        if pairs and max(float(np.abs(its - own).max()) for own, its in pairs) <= limit:
            return ()
    percent = replace(column, scale=0.01 * (column.scale or 1.0)) if is_converted_by_gauge_length(column) else replace(
        column, unit="%", offset=100.0 if column.offset == 1.0 else column.offset)
    ratio = _compute_modulus_ratio_from_largest_strains(read, column, percent, columns, recordings)
    return (AlternativeValue("%", ratio, f"--unit {flag}=%"),)


def _make_measure_assumption(read: Read, column: ColumnGuess, columns: Sequence[ColumnGuess],
                             recordings: Sequence[Recording], hints: InterpretationOverrides,
                             flag: str) -> Assumption:
    """Return the assumption about the measure of a strain or stress, with measures that other columns suggest."""
    words = normalize_header_text(column.header)
    named = find_measure_name_in_header_or_none(words, column.role)
    is_stated = not hints.measures.keys().isdisjoint({column.channel, column.role, flag})
    value = MEASURES[column.measure].title if column.measure else (
        "stretch" if column.role == "stretch" else f"engineering {'stress' if column.role == 'stress' else 'strain'}")
    evidence: tuple[str, ...] = ("words of the header",) if named and not is_stated else () if is_stated else (
        ("by convention, as the header names no measure",) if column.role != "stretch" else ("header",))
    if column.measure:
        evidence = (*evidence, MEASURES[column.measure].formula)
    others = list(list_other_measures_named_by_words(words, column.role)) if not is_stated else []
    if named is None and not is_stated:
        partner = {each.measure for each in columns
                   if each is not column and each.channel in ("stretch", "nominal stress")}
        if column.role == "stress" and partner & {"logarithmic", "almansi", "green_lagrange"}:
            others.append("true")
        elif column.role == "strain" and "true" in partner:
            others.append("logarithmic")
    alternatives = []
    for other in dict.fromkeys(others):
        bare = replace(column, measure=None, offset=None)
        changed = add_measure_conversion_to_column(bare, other)
        alternatives.append(
            AlternativeValue(other, _compute_fitted_modulus_ratio_or_none(read, column, changed, recordings, columns),
                             f"--measure {flag}={other}"))
    return Assumption(f"measure of {column.channel}", value, evidence, alternatives=tuple(alternatives),
                      flag=f"--measure {flag}={column.measure or ENGINEERING}", is_stated=is_stated)


def _compute_modulus_ratio_from_largest_strains(read: Read, column: ColumnGuess, changed: ColumnGuess,
                                                columns: Sequence[ColumnGuess],
                                                recordings: Sequence[Recording]) -> float | None:
    """Return the ratio of the shear moduli with the changed and with the original column of strain.

    The modulus of a small deformation is inverse to the strain. None: the column cannot be read with the change.
    """
    try:
        other = read([changed if each is column else each for each in columns])
    except InputError:
        return None
    rest = float(column.channel == "stretch")
    pairs = [pair for pair in list_value_pairs_valid_in_both_interpretations(recordings, other, column.channel)
             if pair[0].size]
    own, its = (max((float(np.abs(pair[which] - rest).max()) for pair in pairs), default=0.0) for which in (0, 1))
    return own / its if its > 0 else None


def _compute_fitted_modulus_ratio_or_none(read: Read, column: ColumnGuess, changed: ColumnGuess,
                                          recordings: Sequence[Recording],
                                          columns: Sequence[ColumnGuess]) -> float | None:
    """Return shear modulus with the changed column over that with the original column; None: not readable."""
    try:
        other = read([changed if each is column else each for each in columns])
    except InputError:
        return None
    own, its = _fit_shear_moduli_of_both_interpretations(recordings, other)
    return its / own if own and its else None


def _fit_shear_moduli_of_both_interpretations(first: Sequence[Recording],
                                              second: Sequence[Recording]) -> tuple[float | None, float | None]:
    """Return the least-squares shear moduli, Pa, of a neo-Hookean specimen for two readings of a table.

    The law is P = mu (l - l^-2). None: the readings have no stretch and stress.
    """
    if not all({"stretch", "nominal stress"} <= set(each.channels) for each in (*first, *second)):
        return None, None
    parts = [list_value_pairs_valid_in_both_interpretations(first, second, name)
             for name in ("stretch", "nominal stress")]
    if not parts[0]:
        return None, None
    stretches, stresses = ([np.concatenate([pair[which] for pair in part]) for which in (0, 1)] for part in parts)
    one, other = (_fit_shear_modulus_or_none(*each) for each in zip(stretches, stresses, strict=True))
    return one, other


def _fit_shear_modulus_or_none(stretch: np.ndarray, stress: np.ndarray) -> float | None:
    """Return the least-squares shear modulus, Pa; None without a finite value."""
    if not stretch.size or stretch.min() <= 0:
        return None
    shape = stretch - stretch**-2
    return float(np.dot(stress, shape) / np.dot(shape, shape)) if np.any(shape) else None
