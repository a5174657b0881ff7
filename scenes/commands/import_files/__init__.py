"""`tissue-sim import FILES... -o campaign.toml`: read files of a test machine and write a campaign."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scenes.commands.shared.console import make_results_console, print_json
from scenes.commands.shared.exit_code import ExitCode
from scenes.commands.shared.parsing import (
    InputErrorArgumentParser,
    add_json_flag,
    add_overwrite_flag,
    make_integer_parser,
    parse_contact_interface_or_friction,
    parse_positive_number,
)
from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.specimen import specimen_sizes
from tissue_sim.specimen.specimen import add_indefinite_article, map_shape_keys_to_required

SUMMARY = "read data files of a test machine, detect their format and write a campaign file"
EXAMPLE = "tissue-sim import gel_1.csv gel_2.csv gel_3.csv -o gel.toml --radius-mm 10 --height-mm 12"
#: Channel name on the command line -> channel of a recording.
_CHANNELS = {"time": "time", "displacement": "displacement", "force": "force", "stretch": "stretch",
             "strain": "strain", "shear_strain": "shear strain", "shear strain": "shear strain",
             "stress": "nominal stress", "nominal_stress": "nominal stress", "nominal stress": "nominal stress",
             "temperature": "temperature"}
#: Sizes of a specimen that are allowed without --shape.
_GENERAL_SIZES = ("radius_mm", "area_mm2", "height_mm")
#: Flags that become keys of the tests in the campaign.
_TEST_KEYS = ("tool", "tool_radius_mm", "friction", "speed_mm_s", "max_strain", "control")


def add_arguments(parser: InputErrorArgumentParser) -> None:
    """Declare the arguments of `tissue-sim import`."""
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
    add_overwrite_flag(parser)
    add_json_flag(parser)
    parser.set_defaults(run=run, resume_hint="nothing was written")


def run(arguments) -> int:
    """Import the files and print the result; `ExitCode.GOAL_MISSED` if the campaign is incomplete.

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
    if arguments.json:
        print_json(make_json_dictionary_of_import(imported))
    else:
        from scenes.commands.import_files.results import print_import_result

        print_import_result(imported, make_results_console())
    return ExitCode.DONE if imported.is_complete else ExitCode.GOAL_MISSED


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
    laws = None if arguments.laws is None else tuple(name.strip() for name in arguments.laws.split(","))
    for law in laws or ():
        LAWS.find(law, "--laws")
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
