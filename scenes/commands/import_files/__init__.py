"""`tissue-sim import FILES... -o campaign.toml`: files of a test machine in, a campaign that runs out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from scenes.commands.shared.console import print_json, results_console
from scenes.commands.shared.parsing import Parser, add_json, add_overwrite, at_least, interface, positive
from tissue_sim.errors import InputError, nearest
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.specimen import specimen_sizes
from tissue_sim.specimen.specimen import keys_of, with_article

SUMMARY = "understand files of a test machine and write a campaign of them"
EXAMPLE = "tissue-sim import gel_1.csv gel_2.csv gel_3.csv -o gel.toml --radius-mm 10 --height-mm 12"
#: What a person may call a channel, and how recordings do; a strain is read as a stretch.
_CHANNELS = {"time": "time", "displacement": "displacement", "force": "force", "stretch": "stretch",
             "strain": "strain", "shear_strain": "shear strain", "shear strain": "shear strain",
             "stress": "nominal stress", "nominal_stress": "nominal stress", "nominal stress": "nominal stress",
             "temperature": "temperature"}
#: Keys of a specimen that need no shape.
_OWN_FLAGS = ("radius_mm", "area_mm2", "height_mm")
_TEST_KEYS = ("tool", "tool_radius_mm", "friction", "speed_mm_s", "max_strain")


def add_arguments(parser: Parser) -> None:
    parser.add_argument("files", type=Path, nargs="+", metavar="FILE",
                        help="text in any usual encoding, xlsx, xls, ods, mat, tdms, h5, or a file of an AFM")
    parser.add_argument("-o", dest="output", type=Path, metavar="CAMPAIGN.toml",
                        help="campaign to write, with a picture of what was understood beside it; without it "
                             "nothing is written")
    test = parser.add_argument_group("what the files do not state (the campaign has a line to fill in for it)")
    test.add_argument("--kind", choices=tuple(KINDS), metavar="KIND", help=", ".join(KINDS))
    test.add_argument("--shape", choices=_shapes(),
                      help="shape of the specimen (default: cylinder, or its cross-section)")
    test.add_argument("--radius-mm", type=positive, metavar="N", help="radius of a cylindrical specimen")
    test.add_argument("--area-mm2", type=positive, metavar="N",
                      help="cross-section of the specimen, instead of the radius")
    test.add_argument("--height-mm", type=positive, metavar="N",
                      help="height of the specimen; gauge length in tension, thickness in shear")
    for key, size in specimen_sizes().items():
        if key not in _OWN_FLAGS:
            test.add_argument(f"--{key.replace('_', '-')}", type=positive, metavar="N",
                              help=f"{size.field.replace('_', ' ')} of a specimen: {', '.join(size.shapes)}")
    test.add_argument("--tool", metavar="SHAPE", help="tool of an indentation: flat, round, cone, sphere")
    test.add_argument("--tool-radius-mm", type=positive, metavar="N", help="radius of the tool")
    test.add_argument("--friction", type=interface, metavar="HOW",
                      help="interface of the plates: a coefficient of friction, or stick")
    test.add_argument("--speed-mm-s", type=positive, metavar="N",
                      help="constant speed, for files without a column of time or without one of the motion")
    test.add_argument("--max-strain", type=positive, metavar="N", help="largest strain that is fitted")
    test.add_argument("--zero", choices=("preload", "sensor"),
                      help="why the force is not zero at zero displacement: the displacement was zeroed at a preload, "
                           "or the load cell was not zeroed (default: decided by the curve)")
    test.add_argument("--laws", metavar="LAW,...", help="laws to fit (default: a few of one or two parameters)")
    columns = parser.add_argument_group(
        "columns, instead of those found (CHANNEL: time, displacement, force, stretch, strain, shear_strain, stress)")
    for flag, value, text in (
            ("--column", "CHANNEL=COLUMN", "header, number or letter of a column; then only named columns are read"),
            ("--unit", "CHANNEL=UNIT", "mm, um, in, N, mN, gf, lbf, kPa, psi, s, min, %%, ..."),
            ("--measure", "CHANNEL=MEASURE", "of a strain: engineering, logarithmic, green_lagrange, almansi; of a "
                                             "stress: engineering, true, second_piola_kirchhoff"),
            ("--scale", "CHANNEL=N", "factor of the values; for V and counts the SI units in 1 V or 1 count"),
            ("--sign", "CHANNEL=1|-1", "-1 turns a column")):
        columns.add_argument(flag, action="append", default=[], metavar=value, help=f"{text}; once for each")
    columns.add_argument("--format", metavar="NAME", help="machine: mts, bluehill, zwick, exponent, mach1, mecmesin, "
                                                          "trios, afm (default: found)")
    columns.add_argument("--sheet", action="append", metavar="NAME",
                         help="sheet of a spreadsheet; once for each replicate")
    columns.add_argument("--delimiter", metavar="C", help="delimiter between the columns of a text (default: found)")
    columns.add_argument("--decimal", choices=(".", ","), metavar=".|,",
                         help="decimal mark of the numbers; the other one separates thousands (default: found)")
    columns.add_argument("--curve", action="append", type=at_least(1), metavar="N",
                         help="number of the recording in the file, from 1; once for each (default: all)")
    columns.add_argument("--one-material", action="store_true",
                         help="tables of a file are replicates of one material, whatever their titles")
    columns.add_argument("--skip-lines", type=at_least(0), default=0, metavar="N", help="lines at the top to leave out")
    add_overwrite(parser)
    add_json(parser)
    parser.set_defaults(run=run, resume_hint="nothing was written")


def run(arguments) -> int:
    from calibration.importing.files import import_files
    from calibration.importing.imported import to_json

    if arguments.overwrite and arguments.output is None:
        raise InputError("nothing is written without -o, so nothing can be replaced. Leave the flag out",
                         field="--overwrite")
    imported = import_files(arguments.files, arguments.output, _wishes(arguments), overwrite=arguments.overwrite)
    if arguments.json:
        print_json(to_json(imported))
    else:
        from scenes.commands.import_files.results import print_imported

        print_imported(imported, results_console())
    # The goal is a campaign that runs.
    return 0 if imported.complete else 1


def _wishes(arguments):
    from calibration.importing.imported import Wishes
    from tissue_sim.laws import LAWS
    from tissue_sim.recording.formats import FORMATS
    from tissue_sim.recording.formats.guesses import Stated
    from tissue_sim.units import to_si

    units, scales = _pairs(arguments.unit, "--unit"), _pairs(arguments.scale, "--scale")
    for channel, unit in units.items():
        try:
            to_si(unit)
        except InputError as error:
            raise InputError(f"{channel}: {error.problem}", field="--unit") from None
    signs = {channel: _number(text, "--sign") for channel, text in _pairs(arguments.sign, "--sign").items()}
    for channel, sign in signs.items():
        if sign not in (1, -1):
            raise InputError(f"{channel}: {sign:g} is not a sign; give 1 or -1", field="--sign")
    if arguments.format is not None:
        FORMATS.find(arguments.format, "--format")
    laws = None if arguments.laws is None else tuple(name.strip() for name in arguments.laws.split(","))
    for law in laws or ():
        LAWS.find(law, "--laws")
    if arguments.radius_mm is not None and arguments.area_mm2 is not None:
        raise InputError("a specimen has a radius or a cross-section; give one of --radius-mm and --area-mm2",
                         field="--area-mm2")
    stated = Stated(_pairs(arguments.column, "--column"), units,
                    {channel: _positive(text) for channel, text in scales.items()},
                    {channel: int(sign) for channel, sign in signs.items()}, arguments.kind, arguments.format,
                    _sheets(arguments.sheet), arguments.delimiter, arguments.skip_lines,
                    measures=_pairs(arguments.measure, "--measure"), decimal=arguments.decimal, curve=arguments.curve,
                    one_material=arguments.one_material)
    specimen = _specimen(arguments)
    test = {key: value for key in _TEST_KEYS if (value := getattr(arguments, key)) is not None}
    return Wishes(stated, specimen, test, laws, arguments.zero)


def _shapes() -> tuple[str, ...]:
    """Of specimens whose sizes are flags."""
    return tuple(dict.fromkeys(shape for size in specimen_sizes().values() for shape in size.shapes))


def _specimen(arguments) -> dict[str, float | str]:
    keys = dict.fromkeys((*_OWN_FLAGS, *specimen_sizes()))
    stated = {key: value for key in keys if (value := getattr(arguments, key)) is not None}
    shape = arguments.shape
    has = _OWN_FLAGS if shape is None else keys_of(shape)
    if other := next((key for key in stated if key not in has), None):
        words = f"no size of a cylinder; add --shape {specimen_sizes()[other].shapes[0]}" if shape is None else (
            f"{with_article(shape)} has none; leave it out")
        raise InputError(words, field=f"--{other.replace('_', '-')}")
    return stated if shape is None else {"shape": shape, **stated}


def _pairs(texts: Sequence[str], flag: str) -> dict[str, str]:
    """``["force=3"]`` -> ``{"force": "3"}``."""
    found: dict[str, str] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals or not value:
            raise InputError(f"{text!r} is not CHANNEL=...; write it like force=...", field=flag)
        if name not in _CHANNELS:
            raise InputError(f"unknown channel {name!r}{nearest(name, _CHANNELS)}", field=flag)
        if _CHANNELS[name] in found:
            raise InputError(f"{name} is given twice", field=flag)
        found[_CHANNELS[name]] = value
    return found


def _number(text: str, flag: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"{text!r} is not a number", field=flag) from None


def _positive(text: str) -> float:
    value = _number(text, "--scale")
    if not 0 < value < float("inf"):
        raise InputError(f"{text} is not positive; the direction is said by --sign", field="--scale")
    return value


def _sheets(names: list[str] | None) -> Any:
    """A number counts sheets from 1."""
    if names is None:
        return None
    sheets = [int(name) if name.isdigit() else name for name in names]
    return sheets[0] if len(sheets) == 1 else sheets
