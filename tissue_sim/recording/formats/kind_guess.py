"""Find the kind of test of a table from its columns, its words, and the signs and zeros of its values.

Words are collected from headers, titles, names of sheets, columns of labels, and the name of the file.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.recording.control import find_final_oscillation_or_none
from tissue_sim.recording.formats.assumption import AlternativeValue, Assumption
from tissue_sim.recording.formats.guesses import ColumnGuess, KindGuess
from tissue_sim.recording.formats.kind_words import KindHint, KnownTestWithoutKind, NamedTest, find_named_tests
from tissue_sim.recording.formats.sources import FileContent, NumberTable
from tissue_sim.recording.formats.vocabulary import MachineFormat, normalize_header_text
from tissue_sim.recording.recording import LOADS, MOTIONS, Recording
from tissue_sim.units import split_header_and_known_unit


@dataclass(frozen=True)
class SignAndZeroSettings:
    """Settings of `set_column_signs_and_zeros`.

    Attributes:
        start_offset: largest first displacement, as a fraction of the travel, of a displacement that counts from
            contact. A larger first displacement is subtracted, because it refers to a zero of the machine.
        at_rest: largest motion of a specimen at rest, as a fraction of the largest motion.
    """

    start_offset: float = 0.02
    at_rest: float = 0.05


#: Settings that the functions of this module use.
_SIGN_SETTINGS = SignAndZeroSettings()


def set_column_signs_and_zeros(columns: Sequence[ColumnGuess], recordings: Sequence[Recording],
                               starts: Sequence[float | None],
                               kind: str | None, stated: Collection[str]) -> tuple[ColumnGuess, ...]:
    """Set signs and zeros of columns: displacement and force increase under load; stretch and stress keep their sign.

    Args:
        columns: columns with the signs of the file.
        recordings: recordings of these columns without outliers.
        starts: displacement of each recording at its first sample, m, also if the sample is an outlier; None: no
            displacement, or an unknown value.
        kind: kind of test; None: unknown.
        stated: channels whose sign the user states.
    """
    turned: dict[str, ColumnGuess] = {}
    for column in columns:
        if column.channel in ("displacement", "displacement 2"):
            own = starts if column.channel == "displacement" else [None] * len(recordings)
            column = _set_sign_and_zero_of_displacement_column(column, recordings, own, stated)
        elif column.channel == "stretch" and column.role != "stretch" and kind == "lubricated_compression" \
                and "stretch" not in stated \
                and _is_majority_true(each.channel("stretch").max() - 1.0 > 1.0 - each.channel("stretch").min()
                                      for each in recordings):
            column = replace(column, sign=-1, reason=f"{column.reason}; positive in compression, so turned")
        turned[column.channel] = column
    for channel in LOADS:
        if channel in turned and channel not in stated:
            turned[channel] = _set_sign_of_load_column(turned[channel], recordings, starts, turned)
    return tuple(turned.values())


def _set_sign_and_zero_of_displacement_column(column: ColumnGuess, recordings: Sequence[Recording],
                                              starts: Sequence[float | None], stated: Collection[str]) -> ColumnGuess:
    """Return the column of the displacement with its sign and zero; see `set_column_signs_and_zeros`."""
    displacements = [each.channel(column.channel) for each in recordings]
    # A gap that oscillates shows cycles of compression, and its mean is no displacement.
    static = [] if column.channel != "displacement" or _is_gap(column) else [
        offset for each in recordings if (offset := _compute_mean_displacement_if_oscillating(each)) is not None]
    if 2 * len(static) > len(recordings):
        return column if "displacement" in stated or sum(static) >= 0 else replace(
            column, sign=-1, reason=f"{column.reason}; it oscillates around a negative offset, so turned")
    if "displacement" not in stated \
        and _is_majority_true(compute_largest_deviation_from_first_value(each) < 0 for each in displacements):
        column = replace(column, sign=-1, reason=f"{column.reason}; it falls under load, so turned")
    begins = [float(each[0]) if start is None else start for each, start in zip(displacements, starts, strict=True)]
    if any(abs(start) > _SIGN_SETTINGS.start_offset * np.ptp(each)
           for each, start in zip(displacements, begins, strict=True)):
        column = replace(column, offset="start", reason=f"{column.reason}; begins away from zero, so counted from the "
                         "first sample")
    return column


def _compute_mean_displacement_if_oscillating(recording: Recording) -> float | None:
    """Return the mean displacement, m, of a recording that oscillates from its first sample on.

    The result is 0 for an oscillation around zero, and None without an oscillation or for a start from rest.
    """
    displacement = recording.channel("displacement")
    loads = [name for name in LOADS if name in recording]
    if not loads:
        return None
    load = recording.channel(loads[0])
    time = recording.time if "time" in recording and np.ptp(recording.time) > 0 else None
    found = find_final_oscillation_or_none(displacement, load, time)
    if found is None or found.returns or abs(displacement[0] - found.mean) > 1.1 * found.amplitude:
        return None
    return found.mean if abs(found.mean) > found.amplitude else 0.0


def _set_sign_of_load_column(column: ColumnGuess, recordings: Sequence[Recording], starts: Sequence[float | None],
                             columns: Mapping[str, ColumnGuess]) -> ColumnGuess:
    """Return the column of a load with the sign for which load and motion, measured from rest, are correlated."""
    rest = {name: value for name, value in MOTIONS.items() if name != "displacement"}
    # Without a column of the motion, the displacement is that of a constant speed.
    motion = next((name for name in MOTIONS if name in columns), "displacement")
    direction = columns[motion].sign if motion in columns else 1

    def is_against_motion(recording: Recording, start: float | None) -> bool:
        """Return whether motion and load, both measured from rest, have a negative correlation."""
        path, load = recording.channel(motion), recording.channel(column.channel)
        path = direction * (path - rest.get(motion, path[0] if start is None else start))
        nearest = int(np.argmin(np.abs(path)))
        # The load at rest is unknown if the recording begins far from rest, or if the first sample is lost.
        is_known = start is not None or motion in rest
        shows_rest = is_known and abs(path[nearest]) <= _SIGN_SETTINGS.at_rest * float(np.abs(path).max())
        at_rest = float(load[nearest]) if shows_rest else 0.0
        return float(np.sum(path * (load - at_rest))) < 0

    if _is_majority_true(is_against_motion(recording, start) for recording,
                         start in zip(recordings, starts, strict=True)):
        return replace(column, sign=-1, reason=f"{column.reason}; against the motion, so turned")
    return column


def _is_majority_true(answers: Iterable[bool]) -> bool:
    """Return whether more than half of the booleans are true."""
    answers = list(answers)
    return 2 * sum(answers) > len(answers)


def compute_largest_deviation_from_first_value(values: np.ndarray) -> float:
    """Return the deviation from the first value with the largest magnitude, with its sign."""
    away = values - values[0]
    return float(away[np.argmax(np.abs(away))])


@dataclass(frozen=True)
class KindHintSettings:
    """Limits of the search for names of tests.

    Attributes:
        title_rows: number of rows above a table that are searched.
        sheet_rows: number of rows of a sheet without numbers that are searched.
        most_labels: largest number of different labels of a column that names tests.
    """

    title_rows: int = 40
    sheet_rows: int = 60
    most_labels: int = 20


#: Settings that the functions of this module use.
_SETTINGS = KindHintSettings()


def make_hints_from_text_above_and_sheet_name(numbers: NumberTable) -> list[KindHint]:
    """Return two texts that may name the test: the text above a table, and the name of its sheet."""
    above = "\n".join(" ".join(row.cells) for row in numbers.above[-_SETTINGS.title_rows:])
    return [KindHint(above, "above the numbers"), KindHint(numbers.table.name, "in the name of the sheet")]


def make_hints_from_file_top_and_text_sheets(source: FileContent, found: Sequence[NumberTable]) -> list[KindHint]:
    """Return texts that may name the test: the top of a file without sheets, and each sheet without numbers."""
    first = found[0]
    top = "\n".join(" ".join(row.cells) for row in first.above[:_SETTINGS.title_rows])
    hints = [KindHint(top, "at the top of the file")] if not first.table.name else []
    with_numbers = {id(numbers.table) for numbers in found}
    return hints + [KindHint("\n".join(" ".join(row.cells) for row in table.rows[:_SETTINGS.sheet_rows]),
                             f"in sheet {table.name!r}")
                    for table in source.tables if id(table) not in with_numbers]


def make_header_hint_without_unregistered_tests(own: Sequence[str], others: Sequence[str]) -> KindHint:
    """Return one hint: headers of the columns that are read, and other headers that name no test without a kind.

    A header of a column that is not read is omitted if it names a test without a kind, such as a bending strain.
    """
    where = "in the headers"
    harmless = [name for name in others
                if all(each.unknown is None for each in find_named_tests([KindHint(name, where)]))]
    return KindHint(" ".join((*own, *harmless)), where)


def collect_label_hints(numbers: NumberTable) -> list[KindHint]:
    """Return the texts in the label columns of a table as hints for the kind of test.

    Raises:
        InputError: the rows are of different tests. Words for directions of loading alone may name phases of one test.
    """
    hints = []
    width = max(len(row.cells) for row in numbers.rows)
    for place in (place for place in range(width) if place not in numbers.columns):
        labels = list(dict.fromkeys(row.cells[place] for row in numbers.rows if place < len(row.cells)
                                    and row.cells[place]))
        if not 1 <= len(labels) <= _SETTINGS.most_labels:
            continue
        where = f"in column {numbers.get_column_header(place) or place + 1!r}"
        named = [find_named_tests([KindHint(label, where)]) for label in labels]
        specific = any(each.kind is None or not KINDS[each.kind].is_default_of_direction
                       for tests in named for each in tests)
        if specific and len({tuple((each.kind, each.unknown) for each in tests) for tests in named}) > 1:
            raise InputError(f"the rows are of different tests ({', '.join(labels)} {where}); write each test to a "
                             "separate file", line=numbers.rows[0].line)
        hints.append(KindHint("\n".join(labels), where))
    return hints


#: Assumption about compression, completes the reason of a guess.
_BETWEEN_PLATES = ("assumed homogeneous, between plates without friction; with glued plates, the kind is "
                   "bonded_compression, with friction, friction_compression")
#: Subject of the assumption about the kind of test.
KIND_OF_TEST = "kind of test"


def guess_kind(recordings: Sequence[Recording], columns: Sequence[ColumnGuess], hints: Sequence[KindHint],
               machine: MachineFormat | None, stated: str | None = None) -> KindGuess:
    """Return the most probable kind of test of a table, with the evidence.

    A word for a test without a registered kind (`UNKNOWN_TESTS`) has precedence over all other evidence. Exception: a
    kind that the file names by two words, such as "uniaxial tension", has precedence over the name of the file.

    Args:
        recordings: recordings of the table with the signs of the file.
        columns: columns of the table.
        hints: texts with words for a test, in the order of decreasing reliability; the name of the file is the last.
        machine: machine that wrote the file; None: unknown.
        stated: kind that the user states, which has precedence over all evidence; None: not stated.
    """
    named = find_named_tests(hints)
    if stated is not None:
        return KindGuess(stated, "stated", against=_list_evidence_against_stated_kind(stated, named), is_stated=True)
    refused = _find_unregistered_named_test_or_none(named, hints)
    if refused is not None:
        return KindGuess(None, f"{refused.word!r} {refused.where}", refused=refused)
    by_columns, by_words = _guess_kind_by_shear_strain_or_stretch(recordings, columns), _guess_by_words(named, hints)
    if by_words is not None and columns and _lacks_load(by_words, columns):
        return _refuse_kind_without_all_loads(by_words, named)
    if by_columns is None and by_words is not None and _is_motion_normal_to_shear(by_words, columns):
        return KindGuess(None, "the gap is a motion along the axis of the plates", against=(by_words.reason,))
    if by_columns is not None and by_words is not None and by_columns.kind != by_words.kind:
        return _select_kind_by_columns_or_words(by_columns, by_words, columns)
    found = by_columns or by_words or _guess_compression_by_negative_signs(recordings, columns, machine)
    return found or KindGuess(None, "the file does not state how the specimen was loaded")


def _lacks_load(guess: KindGuess, columns: Sequence[ColumnGuess]) -> bool:
    """Return whether the kind has several loads, of which the table lacks one."""
    kind, channels = KINDS[guess.kind or ""], {column.channel for column in columns}
    return kind.load_count > 1 and not any(set(names) <= channels for names in kind.channels)


def _refuse_kind_without_all_loads(guess: KindGuess, named: Sequence[NamedTest]) -> KindGuess:
    """Return the refusal of a table with one load whose words name a kind with several loads."""
    own = next(each for each in named if each.kind == guess.kind)
    kind = KINDS[guess.kind or ""]
    unknown = KnownTestWithoutKind(kind.name, kind.title.lower(), (), (
        f"a test with {kind.load_count} loads ({', '.join(kind.load_names)}), and the table has one load. Name the "
        "missing columns with --column"
        f"{', or state --kind equibiaxial_tension if the stretches are equal' if kind.has_several_motions else ''}"))
    return KindGuess(None, guess.reason, refused=replace(own, kind=None, unknown=unknown))


def _is_motion_normal_to_shear(guess: KindGuess, columns: Sequence[ColumnGuess]) -> bool:
    """Return whether a guessed shear contradicts a displacement that is the gap, which is the thickness in shear."""
    kind = KINDS[guess.kind or ""]
    return kind.closed_form is not None and kind.closed_form.rest == 0.0 and any(
        column.channel == "displacement" and _is_gap(column) for column in columns)


def _is_gap(column: ColumnGuess) -> bool:
    """Return whether the header of a column is the gap of a rheometer: the distance between its plates."""
    return normalize_header_text(split_header_and_known_unit(column.header)[0]) == "gap"


def _select_kind_by_columns_or_words(by_columns: KindGuess, by_words: KindGuess,
                                     columns: Sequence[ColumnGuess]) -> KindGuess:
    """Select one of two different guesses.

    The kind by words is selected if the kind has these columns and the same direction of loading. Otherwise, the kind
    by columns is selected, and a kind by words with another closed form is an alternative.
    """
    channels = {column.channel for column in columns}
    from_columns, named = KINDS[by_columns.kind or ""], KINDS[by_words.kind or ""]
    if named.sign == from_columns.sign and any(set(pair) <= channels for pair in named.channels):
        return replace(by_words, reason=f"{by_words.reason}; {by_columns.reason}")
    other = () if named.closed_form is from_columns.closed_form or by_words.is_weak else (named.name,)
    return replace(by_columns, against=(by_words.reason,), alternatives=other)


def check_kind_and_list_remarks(guess: KindGuess, tables: Sequence[NumberTable], *, any_test: bool) -> tuple[str, ...]:
    """Return a remark about evidence against a stated kind; check that the tables of a guessed kind name one test.

    Args:
        guess: kind of test of the tables.
        tables: tables with equal columns.
        any_test: whether the tables may name different tests.

    Raises:
        InputError: see `require_same_test_in_all_tables`.
    """
    if guess.is_stated and guess.against:
        return (f"kind of test as stated ({guess.kind}), though {'; '.join(guess.against)}",)
    if not guess.is_stated and guess.refused is None and not any_test:
        require_same_test_in_all_tables([make_hints_from_text_above_and_sheet_name(numbers) for numbers in tables])
    return ()


def require_same_test_in_all_tables(texts: Sequence[Sequence[KindHint]]) -> None:
    """Check that the words of all tables name the same test, because tables with equal columns are replicates.

    Args:
        texts: hints of each table.

    Raises:
        InputError: the words name different tests; with the words.
    """
    found: dict[frozenset[str], str] = {}
    for hints in texts:
        named = find_named_tests(hints)
        tests = frozenset(each.kind_or_unregistered_title for each in named)
        if tests:
            found.setdefault(tests, " and ".join(dict.fromkeys(each.word for each in named)))
    if len(found) > 1:
        words = "; ".join(map(repr, found.values()))
        raise InputError(f"holds different tests with the same columns ({words} above the numbers); write each test "
                         "to a separate file")


def make_kind_assumption(guess: KindGuess) -> Assumption:
    """Return the assumption about the kind of test: evidence, counter-evidence, and alternative kinds."""
    return Assumption(KIND_OF_TEST, guess.kind or "not known", () if guess.is_stated else (guess.reason,),
                      guess.against,
                      tuple(AlternativeValue(kind, None, f"--kind {kind}") for kind in guess.alternatives),
                      f"--kind {guess.kind}" if guess.kind else "--kind", guess.is_stated)


def _list_evidence_against_stated_kind(kind: str, named: Sequence[NamedTest]) -> tuple[str, ...]:
    """Return the evidence in the words of the file against a kind that the user states."""
    found = []
    for each in named:
        if each.unknown is not None:
            found.append(f"{each.word!r} {each.where} names {each.unknown.title}, which is {each.unknown.difference}")
        elif each.kind != kind and KINDS[each.kind or kind].sign != KINDS[kind].sign:
            found.append(f"{each.word!r} {each.where} names {each.kind}")
    return tuple(dict.fromkeys(found))


def _find_unregistered_named_test_or_none(named: Sequence[NamedTest], hints: Sequence[KindHint]) -> NamedTest | None:
    """Return the first word for a test without a registered kind that other words do not overrule; None: no word."""
    of_file = {hint.where for hint in hints if hint.is_file_name}
    known = [each for each in named if each.kind is not None and each.where not in of_file]
    for each in named:
        if each.unknown is None:
            continue
        overruled = each.where in of_file and (bool(known) if each.is_short else
                                               any(other.is_named_by_several_words for other in known))
        if not overruled:
            return each
    return None


def _guess_kind_by_shear_strain_or_stretch(recordings: Sequence[Recording],
                                           columns: Sequence[ColumnGuess]) -> KindGuess | None:
    """Return the kind that a shear strain, an angle or the range of a stretch shows; None: no such column."""
    roles, channels = {column.role for column in columns}, {column.channel for column in columns}
    several = [name for name, kind in KINDS.items() if kind.has_several_motions
               and any(set(names) <= channels for names in kind.channels)]
    if several:
        return KindGuess(several[0], "the table has a motion and a load for each of two axes")
    if {"angle", "torque"} <= roles:
        return KindGuess("torsion", "the table has an angle and a torque")
    if "shear strain" in roles:
        return KindGuess("simple_shear", "the table has a shear strain")
    if "stretch" not in roles:
        return None
    values = np.concatenate([each.channel("stretch") for each in recordings])
    low, high = 1.0 - values.min(), values.max() - 1.0
    if low > 0.1 * high and high > 0.1 * low:
        return KindGuess("uniaxial_tension", "stretches on both sides of 1: tension and compression")
    return KindGuess("uniaxial_tension", "stretches above 1") if high > low else \
        KindGuess("lubricated_compression", f"stretches below 1; {_BETWEEN_PLATES}")


def _guess_by_words(named: Sequence[NamedTest], hints: Sequence[KindHint]) -> KindGuess | None:
    """Return the kind of the first text that names exactly one kind; None: no such text.

    If the headers only name a direction of loading, a title with the same direction determines the kind.
    """
    levels: list[NamedTest] = []
    for hint in hints:
        here = _omit_words_of_direction([each for each in named if each.where == hint.where
                                         and each.kind is not None])
        if len({each.kind for each in here}) == 1:
            levels.append(here[0])
    if not levels:
        return None
    first, *others = levels
    of_file = {hint.where for hint in hints if hint.is_file_name}
    title = next((each for each in others if each.where not in of_file), None)
    if title is not None and first.where == hints[0].where and _get_loading_sign_of_named_kind(title) \
        == _get_loading_sign_of_named_kind(first):
        first = title
    conflicts = [each for each in levels if each.kind != first.kind and not (
        each.where == hints[0].where and _get_loading_sign_of_named_kind(each)
        == _get_loading_sign_of_named_kind(first)) and not each.is_short]
    kind = first.kind
    between = f"; {_BETWEEN_PLATES}" if kind == "lubricated_compression" else ""
    return KindGuess(kind, f"{first.word!r} {first.where}{between}", is_weak=first.where in of_file,
                     against=tuple(f"{each.word!r} {each.where}" for each in conflicts),
                     alternatives=tuple(dict.fromkeys(each.kind for each in conflicts if each.kind)))


def _omit_words_of_direction(named: list[NamedTest]) -> list[NamedTest]:
    """Return the words without single words for the direction of loading, if other words name a kind."""
    specific = [each for each in named if each.is_named_by_several_words
                or not KINDS[each.kind or ""].is_default_of_direction]
    return specific or named


def _get_loading_sign_of_named_kind(named: NamedTest) -> float:
    """Return 1 for a kind that stretches the specimen, and -1 for compression."""
    return KINDS[named.kind or ""].sign


def _guess_compression_by_negative_signs(recordings: Sequence[Recording], columns: Sequence[ColumnGuess],
                                         machine: MachineFormat | None ) -> KindGuess | None:
    """Return compression if load and displacement, or the strain, are negative; None: no evidence."""
    roles = {column.role for column in columns}
    if recordings and {"displacement", "force"} <= roles and machine is not None and machine.compresses_negative:
        motion, load = (compute_largest_deviation_from_first_value(np.asarray(recordings[0].channel(name)))
                        for name in ("displacement", "force"))
        if motion < 0 and load < 0:
            return KindGuess("lubricated_compression", f"displacement and load are negative, the sign of compression "
                             f"of {machine.title}; {_BETWEEN_PLATES}")
    if "strain" in roles and recordings and "stretch" in recordings[0] \
            and compute_largest_deviation_from_first_value(recordings[0].channel("stretch")) < 0:
        return KindGuess("lubricated_compression", f"strains are negative; {_BETWEEN_PLATES}")
    return None
