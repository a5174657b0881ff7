"""`tissue-sim import FILES... -o campaign.toml`: read files of a test machine and write a campaign."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenes.commands.shared.command import Command, CommandResult, ExitCode
from scenes.commands.shared.console import TABLES, make_table_with_headings, print_sentence
from scenes.commands.shared.parsing import (
    InputErrorArgumentParser,
    add_overwrite_flag,
    make_integer_parser,
    parse_contact_interface_or_friction,
    parse_positive_number,
)
from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.specimen import specimen_sizes
from tissue_sim.specimen.specimen import add_indefinite_article, map_shape_keys_to_required
from tissue_sim.units import get_display_unit_and_factor

if TYPE_CHECKING:
    from rich.console import Console

    from calibration.importing.imported import ImportResult, ReplicateFile
    from calibration.importing.motion import RecordedMotion

#: Channel name on the command line -> channel of a recording.
_CHANNELS = {"time": "time", "displacement": "displacement", "force": "force", "stretch": "stretch",
             "strain": "strain", "shear_strain": "shear strain", "shear strain": "shear strain",
             "stress": "nominal stress", "nominal_stress": "nominal stress", "nominal stress": "nominal stress",
             "temperature": "temperature", "angle": "angle", "torque": "torque", "displacement_2": "displacement 2",
             "force_2": "force 2", "stretch_2": "stretch 2", "strain_2": "strain 2", "stress_2": "nominal stress 2",
             "frequency": "frequency",
             "storage_modulus": "storage modulus", "loss_modulus": "loss modulus", "loss_factor": "loss factor",
             "complex_modulus": "complex modulus"}
#: Sizes of a specimen that are allowed without --shape.
_GENERAL_SIZES = ("radius_mm", "area_mm2", "height_mm")
#: Flags that become keys of the tests in the campaign.
_TEST_KEYS = ("tool", "tool_radius_mm", "friction", "speed_mm_s", "max_strain", "control")
#: Delimiter -> its name.
_DELIMITER_NAMES = {"\t": "tab", " ": "spaces", ",": "comma", ";": "semicolon", "|": "bar", None: ""}


def _add_file_and_test_flags(parser: InputErrorArgumentParser) -> None:
    """Add the data files, the campaign file, and the flags of specimen and test."""
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE",
                        help="data file: text in any common encoding, xlsx, xls, ods, mat, tdms, h5, or a file of an "
                        "atomic force microscope")
    parser.add_argument("-o", dest="output", type=Path, metavar="CAMPAIGN.toml",
                        help="write this campaign file, and a figure of the curves in its folder; without -o the "
                        "result is only printed")
    test = parser.add_argument_group(
        "information that the files do not contain (without the flag the campaign has a line to fill in)")
    test.add_argument("--kind", choices=tuple(KINDS), metavar="KIND", help=f"kind of test: {', '.join(KINDS)}")
    test.add_argument("--shape", choices=_list_shapes_whose_sizes_are_flags(),
                      help="shape of the specimen (default: cylinder, or a prism with --area-mm2)")
    test.add_argument("--radius-mm", type=parse_positive_number, metavar="N", help="radius of a cylindrical specimen")
    test.add_argument("--area-mm2", type=parse_positive_number, metavar="N",
                      help="cross-sectional area of the specimen, instead of the radius")
    test.add_argument("--height-mm", type=parse_positive_number, metavar="N",
                      help="height of the specimen; gauge length in tension, thickness in shear")
    for key, size in specimen_sizes().items():
        if key not in _GENERAL_SIZES:
            test.add_argument(f"--{key.replace('_', '-')}", type=parse_positive_number, metavar="N",
                              help=f"{size.field.replace('_', ' ')} of a specimen of shape {' or '.join(size.shapes)}")
    test.add_argument("--tool", metavar="SHAPE", help="shape of the indentation tool: flat, round, cone, sphere")
    test.add_argument("--tool-radius-mm", type=parse_positive_number, metavar="N",
                      help="radius of the indentation tool")
    test.add_argument("--friction", type=parse_contact_interface_or_friction, metavar="CONTACT",
                      help="contact between plates and specimen: bonded, stick, frictionless or a friction coefficient")
    test.add_argument("--speed-mm-s", type=parse_positive_number, metavar="N",
                      help="constant speed of the test, for files without a time or displacement column")
    test.add_argument("--max-strain", type=parse_positive_number, metavar="N", help="largest strain used in the fit")
    test.add_argument("--control", choices=("displacement", "force"),
                      help="quantity that the machine controls: a force that stays equal to the last digit is held, or "
                      "its sensor is saturated (default: determined from the curve)")
    test.add_argument("--zero", choices=("preload", "sensor"),
                      help="reason for a force at zero displacement: the displacement was zeroed at a preload, or the "
                      "sensor was not zeroed (default: determined from the curve)")
    test.add_argument("--laws", metavar="LAW,...",
                      help="material laws to fit (default: laws with one or two parameters)")


def _add_column_flags(parser: InputErrorArgumentParser) -> None:
    """Add the flags of format and columns."""
    columns = parser.add_argument_group(
        "columns, where the detection is wrong (CHANNEL: time, displacement, force, stretch, strain, shear_strain, "
        "stress)")
    for flag, value, text in (
            ("--column", "CHANNEL=COLUMN", "header, number or letter of the column; only the named columns are read"),
            ("--unit", "CHANNEL=UNIT", "unit of the column: mm, um, in, N, mN, gf, lbf, kPa, psi, s, min, %%, ..."),
            ("--measure", "CHANNEL=MEASURE", "strain measure engineering, logarithmic, green_lagrange or almansi; "
             "stress measure engineering, true or second_piola_kirchhoff"),
            ("--scale", "CHANNEL=N", "factor of the values; for V and counts the SI value of 1 V or 1 count"),
            ("--sign", "CHANNEL=1|-1", "-1 reverses the sign of the column")):
        columns.add_argument(flag, action="append", default=[], metavar=value, help=f"{text}; once for each")
    columns.add_argument("--format", metavar="NAME", help="file format: mts, bluehill, zwick, exponent, mach1, "
                         "mecmesin, trios, afm (default: detected)")
    columns.add_argument("--sheet", action="append", metavar="NAME",
                         help="sheet of a spreadsheet, by name or number; once for each replicate")
    columns.add_argument("--delimiter", metavar="C", help="delimiter of the columns of a text file (default: detected)")
    columns.add_argument("--decimal", choices=(".", ","), metavar=".|,",
                         help="decimal mark; the other one separates thousands (default: detected)")
    columns.add_argument("--curve", action="append", type=make_integer_parser(1), metavar="N",
                         help="number of a recording in the file, from 1; once for each recording (default: all)")
    columns.add_argument("--one-material", action="store_true",
                         help="treat all tables of a file as replicates of one material, even if their titles differ")
    columns.add_argument("--skip-lines", type=make_integer_parser(0), default=0, metavar="N",
                         help="number of lines to skip at the top")


def _run(arguments: Namespace) -> CommandResult:
    """Import the files; `ExitCode.GOAL_MISSED` if the campaign is incomplete.

    Raises:
        InputError: files that cannot be read, contradictory flags, or an output file that cannot be written.
    """
    from calibration.importing.files import import_files
    from calibration.importing.imported import make_json_dictionary_of_import

    if arguments.overwrite and arguments.output is None:
        raise InputError("has an effect only with -o. Leave this flag out, or add -o",
                         field="--overwrite")
    imported = import_files(arguments.files, arguments.output, _make_import_options(arguments),
                            overwrite=arguments.overwrite)
    return CommandResult(lambda: make_json_dictionary_of_import(imported),
                         lambda console: print_import_result(imported, console),
                         ExitCode.DONE if imported.is_complete else ExitCode.GOAL_MISSED)


def _make_import_options(arguments):
    """Return the options of `calibration.importing` from the flags of columns, specimen and test.

    Raises:
        InputError: an unknown channel, unit, format or law, or contradictory flags.
    """
    from calibration.importing.imported import ImportOptions
    from tissue_sim.laws import LAWS
    from tissue_sim.recording.formats import FORMATS
    from tissue_sim.recording.formats.guesses import InterpretationOverrides
    from tissue_sim.units import get_si_factor_and_offset

    units, scales = _parse_channel_values(arguments.unit, "--unit"), _parse_channel_values(arguments.scale, "--scale")
    for channel, unit in units.items():
        try:
            get_si_factor_and_offset(unit)
        except InputError as error:
            raise InputError(f"{channel}: {error.problem}", field="--unit") from None
    signs = {channel: _parse_flag_number(text, "--sign")
             for channel, text in _parse_channel_values(arguments.sign, "--sign").items()}
    for channel, sign in signs.items():
        if sign not in (1, -1):
            raise InputError(f"the sign of {channel} must be 1 or -1; got {sign:g}", field="--sign")
    if arguments.format is not None:
        FORMATS.find(arguments.format, "--format")
    laws = None if arguments.laws is None else tuple(LAWS.find(name.strip(), "--laws").name
                                                     for name in arguments.laws.split(","))
    if arguments.radius_mm is not None and arguments.area_mm2 is not None:
        raise InputError("cannot be combined with --radius-mm. Give one of them", field="--area-mm2")
    hints = InterpretationOverrides(_parse_channel_values(arguments.column, "--column"), units,
                                    {channel: _parse_positive_scale_factor(text)
                                     for channel, text in scales.items()},
                                    {channel: int(sign) for channel, sign in signs.items()}, arguments.kind,
                                    arguments.format,
                                    _parse_one_or_several_sheets(arguments.sheet), arguments.delimiter,
                                    arguments.skip_lines,
                                    measures=_parse_channel_values(arguments.measure, "--measure"),
                                    decimal=arguments.decimal,
                                    curve=arguments.curve, one_material=arguments.one_material)
    specimen = _make_campaign_specimen_keys(arguments)
    test = {key: value for key in _TEST_KEYS if (value := getattr(arguments, key)) is not None}
    return ImportOptions(hints, specimen, test, laws, arguments.zero)


def _list_shapes_whose_sizes_are_flags() -> tuple[str, ...]:
    """Return the shapes of specimens whose sizes are flags."""
    return tuple(dict.fromkeys(shape for size in specimen_sizes().values() for shape in size.shapes))


def _make_campaign_specimen_keys(arguments) -> dict[str, float | str]:
    """Return the keys of the specimen in the campaign.

    Raises:
        InputError: a size that the shape does not have.
    """
    keys = dict.fromkeys((*_GENERAL_SIZES, *specimen_sizes()))
    stated = {key: value for key in keys if (value := getattr(arguments, key)) is not None}
    shape = arguments.shape
    allowed = _GENERAL_SIZES if shape is None else map_shape_keys_to_required(shape)
    if other := next((key for key in stated if key not in allowed), None):
        problem = f"is not a size of a cylinder. Add --shape {specimen_sizes()[other].shapes[0]}" if shape is None \
            else f"is not a size of {add_indefinite_article(shape)}. Leave this flag out"
        raise InputError(problem, field=f"--{other.replace('_', '-')}")
    return stated if shape is None else {"shape": shape, **stated}


def _parse_channel_values(texts: Sequence[str], flag: str) -> dict[str, str]:
    """Read the values of a repeated flag, texts such as ``force=3`` (channel, then value).

    Returns:
        Value of each channel of the recording by its name.

    Raises:
        InputError: a text without ``=``, or an unknown or repeated channel.
    """
    found: dict[str, str] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals or not value:
            raise InputError(f"must have the form CHANNEL=VALUE, such as force=3; got {text!r}", field=flag)
        if name not in _CHANNELS:
            raise InputError(f"unknown channel {name!r}{make_hint_with_similar_or_known_words(name, _CHANNELS)}",
                             field=flag)
        if _CHANNELS[name] in found:
            raise InputError(f"{name} is given twice. Give it once", field=flag)
        found[_CHANNELS[name]] = value
    return found


def _parse_flag_number(text: str, flag: str) -> float:
    """Convert the value of a flag to a number; the InputError of another text names the flag."""
    try:
        return float(text)
    except ValueError:
        raise InputError(f"must be a number; got {text!r}", field=flag) from None


def _parse_positive_scale_factor(text: str) -> float:
    """Convert a value of ``--scale`` to a positive number."""
    value = _parse_flag_number(text, "--scale")
    if not 0 < value < float("inf"):
        raise InputError(f"must be positive; got {text}. Use --sign to reverse a column", field="--scale")
    return value


def _parse_one_or_several_sheets(names: list[str] | None) -> Any:
    """Return the sheets of ``--sheet``: one, a list of several, or None; a number is an index from 1."""
    if names is None:
        return None
    sheets = [int(name) if name.isdigit() else name for name in names]
    return sheets[0] if len(sheets) == 1 else sheets


def print_import_result(imported: ImportResult, console: Console) -> None:
    """Print the recordings, the assumptions, warnings, written files and missing information of an import."""
    from calibration.importing.campaign_text import describe_unused_columns_of_each_file

    files = make_table_with_headings("file", "format", "test", "samples", "Hz", "reaches", "contact", "cycles",
                                     "segments", text=3)
    for column in (0, 1, 2, 6, 8):
        files.columns[column].no_wrap, files.columns[column].overflow = False, "fold"
    files.columns[8].justify = "left"
    rows = [(test.name, part, number, motion) for test in imported.tests for part in test.parts
            for number, motion in enumerate(part.motions, start=1)]
    for name, part, number, motion in rows[:TABLES.max_recordings]:
        several = f" {number}" if len(part.motions) > 1 else ""
        files.add_row(part.file.name + several, _describe_file_format(part), name,
                      str(len(part.reading.recordings[number - 1])),
                      "-" if motion.rate is None else f"{motion.rate:.3g}", _format_largest_channel_value(part, motion),
                      _format_contact_displacement_interval(motion), str(motion.loading_cycle_count),
                      ", ".join(_list_segment_names_or_counts(motion)))
    tables = [(test.name, part, recording) for test in imported.tests for part in test.parts
              if not part.motions for recording in part.reading.recordings]
    for name, table, recording in tables:
        frequency = recording.channel("frequency")
        files.add_row(table.file.name, _describe_file_format(table), name, str(len(recording)), "-",
                      f"{frequency.min():.3g} to {frequency.max():.3g} Hz", "-", "-", "moduli over frequency")
    console.print(files)
    if len(rows) > TABLES.max_recordings:
        print_sentence(console, f"and {len(rows) - TABLES.max_recordings} more recordings")
    console.print()
    _print_assumption_table(imported, console)
    for test in imported.tests:
        print_sentence(console, f"{test.name}: {test.kind or 'kind unknown'}; {test.reason}")
    for each in describe_unused_columns_of_each_file(imported.tests):
        print_sentence(console, f"columns not used: {each}")
    for warning in imported.warnings:
        print_sentence(console, f"note: {warning}")
    if imported.output is not None:
        console.print(f"wrote {imported.output} and {imported.picture}", markup=False, emoji=False, soft_wrap=True)
    for question in imported.questions:
        print_sentence(console, f"question: {question}")
    if imported.missing:
        remedy = "" if imported.output is None else f". Add the flags, or fill in the lines in {imported.output}"
        print_sentence(console, f"missing information: {'; '.join(imported.missing)}{remedy}")
    elif imported.problem:
        print_sentence(console, f"the campaign cannot be calibrated yet: {imported.problem}")
    elif imported.output is not None and not imported.questions:
        print_sentence(console, f"next: tissue-sim calibrate {imported.output} -o results")


def _print_assumption_table(imported: ImportResult, console: Console) -> None:
    """Print the table of the assumptions, without columns that are empty in all rows."""
    from rich.markup import escape

    from calibration.importing.campaign_text import HEADINGS, make_assumption_rows

    rows = [row.cell_texts for row in make_assumption_rows(imported.tests)]
    if not rows:
        return
    used = [i for i in range(len(HEADINGS)) if any(cell_texts[i] for cell_texts in rows)]
    table = make_table_with_headings(*(HEADINGS[i] for i in used), text=len(used))
    for column in table.columns:
        column.no_wrap, column.overflow = False, "fold"
    for cell_texts in rows:
        table.add_row(*(escape(cell_texts[i]) for i in used))
    console.print(table)
    console.print()


def _describe_file_format(part: ReplicateFile) -> str:
    """Return format, delimiter, number style and encoding of a file, such as ``bluehill, comma``."""
    understood = part.understanding
    mark = _DELIMITER_NAMES.get(understood.delimiter, str(understood.delimiter))
    comma = "decimal comma" if understood.decimal_mark == "," else ""
    encoding = understood.encoding if understood.encoding not in (None, "utf-8") else ""
    thousands = "thousands separator" if any(each.subject == "thousands separator"
                                             for each in understood.assumptions) else ""
    return ", ".join(filter(None, (understood.format, mark, comma, thousands, encoding)))


def _format_largest_channel_value(part: ReplicateFile, motion: RecordedMotion) -> str:
    """Return the largest displacement, stretch or shear strain of a motion in its display unit.

    A question mark follows a value whose unit is unknown.
    """
    if motion.channel in part.reading.channels_without_unit:
        return f"{max(motion.reach, key=abs):.4g} ?"
    unit, factor = get_display_unit_and_factor("m") if motion.channel == "displacement" else ("", 1.0)
    return f"{max(motion.reach, key=abs) * factor:.4g} {unit}".strip()


def _format_contact_displacement_interval(motion: RecordedMotion) -> str:
    """Return the displacement of the first contact, as in the file, with its 95 % interval."""
    contact = motion.contact
    if contact is None or contact.status == "none":
        return "-"
    if not motion.starts_in_air_or_none_if_unclear:
        return "?" if motion.starts_in_air_or_none_if_unclear is None else "no air"
    factor, unit = (1e3, " mm") if motion.channel == "displacement" else (1.0, "")
    low, high = (factor * end for end in contact.interval)
    return f"{factor * contact.displacement:.3g} ({low:.3g} to {high:.3g}){unit}"


def _list_segment_names_or_counts(motion: RecordedMotion) -> list[str]:
    """Return the names of the segments; of more than four segments the number of each, such as ``8 ramp``."""
    names = [segment.name for segment in motion.segments]
    if len(names) <= 4:
        return names
    return [f"{names.count(name)} {name}" for name in dict.fromkeys(names)]


COMMAND = Command("import", "read data files of a test machine, detect their format and write a campaign file",
                  "tissue-sim import gel_1.csv gel_2.csv gel_3.csv -o gel.toml --radius-mm 10 --height-mm 12", _run,
                  needs=(_add_file_and_test_flags, _add_column_flags, add_overwrite_flag))
