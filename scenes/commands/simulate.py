"""`tissue-sim simulate SCENE`: force against displacement, from a material file."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from pathlib import Path

from scenes.console import print_json, progress_console, results_console
from scenes.parsing import (
    Parser,
    add_json,
    add_later_options,
    add_overwrite,
    at_least,
    later_answer,
    new_file,
    not_negative,
    positive,
)
from tissue_sim.errors import ConvergenceError, InputError, nearest

SUMMARY = "simulate a test and print force against displacement"
EXAMPLE = "tissue-sim simulate needle_indentation --material m.material.json --tool-radius-mm 8 --figure needle.png"
#: Names only: scenes and fields themselves need numpy, and help must answer at once. A test holds these against them.
SCENE_NAMES = ("lubricated_compression", "bonded_compression", "needle_indentation")
LATER_SCENES = ("friction_compression",)
FIELDS = ("displacement", "von_mises", "cauchy_rr", "cauchy_zz", "cauchy_rz", "cauchy_hoop", "pressure", "energy", "J")
MOST_POINTS = 100_000
FIGURE_SUFFIXES = (".png", ".svg", ".pdf")


def add_arguments(parser: Parser) -> None:
    parser.add_argument("scene", metavar="SCENE", help=" or ".join(SCENE_NAMES))
    parser.add_argument("--material", type=Path, required=True, metavar="FILE", help="NAME.material.json")
    parser.add_argument("--depth-mm", type=positive, metavar="N", default=10.0,
                        help="largest tool displacement (default: 10)")
    parser.add_argument("--points", type=at_least(2, MOST_POINTS), metavar="N", default=21,
                        help="points of the curve, rest included (default: 21)")
    parser.add_argument("--resolution", choices=("fast", "accurate"), default="fast",
                        help="fast: force within 1 %%; accurate: within 0.2 %% (default: fast)")
    parser.add_argument("--radius-mm", type=positive, metavar="N", default=40.0, help="of the cylinder (default: 40)")
    parser.add_argument("--height-mm", type=positive, metavar="N", default=70.0, help="of the cylinder (default: 70)")
    parser.add_argument("--speed-mm-s", type=positive, metavar="N", default=0.248, help="of the tool (default: 0.248)")
    tool = parser.add_argument_group("tool and interfaces (defaults: those of the scene)")
    tool.add_argument("--tool", metavar="SHAPE", help="flat, a needle with a flat face; plate in compression")
    tool.add_argument("--tool-radius-mm", type=positive, metavar="N", help="of the needle (default: 8)")
    tool.add_argument("--edge-radius-mm", type=not_negative, metavar="N",
                      help="of the rounding between face and shaft (default: 0)")
    tool.add_argument("--friction", metavar="HOW", help="tool's face: bonded, stick (can lift off) or frictionless")
    tool.add_argument("--friction-base", metavar="HOW", help="base: bonded or frictionless")
    tool.add_argument("--friction-wall", metavar="HOW", help="shaft of the needle: stick or frictionless")
    weight = parser.add_argument_group("self-weight")
    weight.add_argument("--gravity", action="store_true", help="let the specimen weigh, and settle before the test")
    weight.add_argument("--density-kg-m3", type=positive, metavar="N", help="default: that of the material file")
    weight.add_argument("--height-is", choices=("moulded", "placed"),
                        help="--height-mm is that before (moulded) or after settling (placed; default: moulded)")
    parser.add_argument("-o", dest="output", type=Path, metavar="CURVE.csv", help="write the curve as a recording")
    parser.add_argument("--figure", type=Path, metavar="F.png", help="draw the deformed mesh, coloured by --field")
    parser.add_argument("--field", choices=FIELDS, help="colour of --figure (default: von_mises)")
    add_later_options(parser, "--half-angle-deg", "--protocol", "--rig")
    add_overwrite(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments) -> int:
    check_scene(arguments.scene)
    new_file(arguments.output, "-o", overwrite=arguments.overwrite, suffixes=(".csv",))
    if arguments.output is not None:
        new_file(arguments.output.with_suffix(".json"), "-o", overwrite=arguments.overwrite)
    new_file(arguments.figure, "--figure", overwrite=arguments.overwrite, suffixes=FIGURE_SUFFIXES)
    if arguments.field is not None and arguments.figure is None:
        raise InputError("a field colours a figure; add --figure F.png", field="--field")

    import tissue_sim as ts
    from tissue_sim.recording import MIN_POINTS
    from tissue_sim.recording_file import require_sidecar_place

    if arguments.output is not None:
        require_sidecar_place(arguments.output)
    if arguments.output is not None and arguments.points < MIN_POINTS:
        raise InputError(f"{arguments.points} points are too few for a recording; give at least {MIN_POINTS}, or leave "
                         "out -o", field="--points")
    material_file = ts.read_material_file(arguments.material)
    material = material_file.material

    from scenes.material_summary import doubts

    experiment = build_experiment(arguments, material)
    failure = None
    with progress_console(quiet=arguments.json).status("simulating") as status:
        try:
            recording = ts.simulate(ts.Model(experiment, material), resolution=arguments.resolution,
                                    fields=arguments.figure is not None,
                                    progress=lambda done, of: status.update(describe(done, of)))
        except ConvergenceError as error:
            if error.recording is None:
                raise
            recording, failure = error.recording, error
    if arguments.output is not None:
        ts.write_recording(recording, arguments.output)
    if arguments.figure is not None and recording.fields is not None:
        from scenes.figures import draw_simulation

        draw_simulation(recording, ts.Model(experiment, material), arguments.figure,
                        field=arguments.field or "von_mises")
    reached = 1 - float(recording.displacement.max()) / experiment.specimen.height
    warnings = [*doubts(material_file, reached), *recording.metadata.get("solver", {}).get("warnings", [])]
    if arguments.json:
        print_json(as_json(recording, arguments.resolution, failure, warnings))
    else:
        print_curve(recording, arguments)
        for warning in warnings:
            print(f"tissue-sim: warning: {warning}", file=sys.stderr)
    if failure is not None:
        kept = f"; the curve up to there is in {arguments.output}" if arguments.output is not None else ""
        raise ConvergenceError(f"{failure}{kept}")
    return 0


def describe(done: int, samples: int) -> str:
    if done == 0:
        return "loading the solver (a machine's first run compiles it, about 10 s)"
    return f"simulating: {done} of {samples} samples"


def check_scene(name: str) -> None:
    """Raises InputError: no such scene, or one of a later version."""
    if name in LATER_SCENES:
        raise InputError(later_answer(f"scene {name}"))
    if name not in SCENE_NAMES:
        raise InputError(f"unknown scene {name!r}{nearest(name, SCENE_NAMES)}")


def build_experiment(arguments, material):
    """The scene with what the flags change in it.

    Raises:
        InputError: flags that do not fit the scene or each other, or what the experiment refuses.
    """
    from dataclasses import replace

    import tissue_sim as ts
    from scenes.catalogue import SCENES
    from tissue_sim.experiment import STANDARD_GRAVITY

    scene = SCENES[arguments.scene]
    radius, edge = ({} if value is None else {name: value * 1e-3} for name, value in (
        ("radius", arguments.tool_radius_mm), ("edge_radius", arguments.edge_radius_mm)))
    shape = arguments.tool or scene.tool.shape
    if (shape == "plate") != (scene.tool.shape == "plate"):
        fitting = [name for name, other in SCENES.items() if (other.tool.shape == "plate") == (shape == "plate")]
        raise InputError(f"{scene.name} is not done with the tool {shape!r}; use scene {' or '.join(fitting)}",
                         field="--tool")
    tool = replace(scene.tool, shape=shape, **radius, **edge)
    if shape == "plate" and arguments.friction_wall is not None:
        raise InputError("a plate has no shaft; leave it out", field="--friction-wall")

    weight = {}
    if arguments.gravity:
        density = arguments.density_kg_m3 or material.density
        if density is None:
            raise InputError(f"the specimen's density is not known: {arguments.material} states none; add "
                             "--density-kg-m3", field="--gravity")
        weight = {"density": density, "gravity": STANDARD_GRAVITY, "height_is": arguments.height_is or "moulded"}
    for name in ("density_kg_m3", "height_is"):
        if getattr(arguments, name) is not None and not arguments.gravity:
            raise InputError("matters to a specimen that weighs only; add --gravity or leave it out",
                             field=f"--{name.replace('_', '-')}")
    interfaces = {name: value for name in ("friction", "friction_base", "friction_wall")
                  if (value := getattr(arguments, name)) is not None}
    return scene.experiment(
        specimen=ts.Specimen(arguments.radius_mm * 1e-3, arguments.height_mm * 1e-3, **weight),
        protocol=ts.Protocol.ramp(arguments.depth_mm * 1e-3, arguments.points, arguments.speed_mm_s * 1e-3),
        tool=tool, **interfaces)


def as_json(recording, resolution: str, failure: Exception | None, warnings: list[str]) -> dict:
    """The object of ``simulate --json``; units are in the names of the keys."""
    solver = recording.metadata.get("solver", {})
    return {
        "displacement_mm": (recording.displacement * 1e3).tolist(),
        "time_s": recording.time.tolist(),
        "force_N": recording.force.tolist(),
        "status": solver.get("status", "failed" if failure else "converged"),
        "message": str(failure) if failure else solver.get("message", ""),
        "warnings": warnings,
        "newton_iterations": solver.get("newton_iterations"),
        "wall_s": solver.get("wall_s"),
        "mesh": solver.get("mesh"),
        "resolution": solver.get("resolution", resolution),
        **{key: solver[key] for key in ("penetration_mm", "penetration_tolerance_mm", "self_weight") if key in solver},
    }


def print_curve(recording, arguments) -> None:
    from rich.table import Table
    from rich.text import Text

    console = results_console()
    table = Table(title=arguments.scene.replace("_", " "))
    columns = []
    curves = (("displacement", recording.displacement * 1e3, "mm"), ("force", recording.force, "N"))
    for quantity, values, unit in curves:
        factor, prefix = (1e3, "m") if 0 < abs(values).max() < 0.1 and unit == "N" else (1.0, "")
        # As text: rich reads brackets as markup.
        table.add_column(Text(f"{quantity} [{prefix}{unit}]"), justify="right")
        columns.append(aligned(values * factor))
    for row in zip(*columns, strict=True):
        table.add_row(*row)
    console.print(table)
    solver = recording.metadata.get("solver")
    if solver:
        mesh = solver["mesh"]
        console.print(f"{mesh['elements']} elements, {mesh['freedoms']} freedoms, {solver['newton_iterations']} Newton "
                      f"iterations, {solver['wall_s']:.2f} s", markup=False)
        for sentence in remarks(solver):
            console.print(sentence, markup=False, soft_wrap=True)
    for path in (arguments.output, arguments.figure):
        if path is not None and path.exists():
            console.print(f"wrote {path}", markup=False, soft_wrap=True)


def remarks(solver: dict) -> Iterator[str]:
    """What was assumed of contact and weight, a sentence each."""
    if "penetration_mm" in solver:
        yield (f"the surface enters the tool by {solver['penetration_mm']:.2g} mm at most "
               f"(tolerance {solver['penetration_tolerance_mm']:.2g} mm)")
    if "self_weight" in solver:
        weight = solver["self_weight"]
        yield (f"self-weight: the specimen sags {weight['sag_mm']:.3f} mm before the test, from a moulded height of "
               f"{weight['moulded_height_mm']:.3f} mm (assumed: density {weight['density_kg_m3']:g} kg/m3, g "
               f"{weight['gravity_m_s2']:g} m/s2)")


def aligned(values, digits: int = 5) -> list[str]:
    """Numbers of one column with the same decimals, so many that the largest shows `digits` digits."""
    largest = float(abs(values).max())
    decimals = max(0, digits - 1 - math.floor(math.log10(largest))) if largest > 0 else digits - 1
    return [f"{value + 0.0:.{decimals}f}" if round(float(value), decimals) else f"{0:.{decimals}f}" for value in values]
