"""`tissue-sim simulate SCENE`: force against displacement, from a material file."""

from __future__ import annotations

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
    positive,
)
from tissue_sim.errors import ConvergenceError, InputError, nearest

SUMMARY = "simulate a test and print force against displacement"
EXAMPLE = "tissue-sim simulate bonded_compression --material m.material.json --depth-mm 10 --points 21 -o curve.csv"
#: Names only: scenes and fields themselves need numpy, and help must answer at once. A test holds these against them.
SCENE_NAMES = ("lubricated_compression", "bonded_compression")
LATER_SCENES = ("friction_compression", "needle_indentation")
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
    parser.add_argument("-o", dest="output", type=Path, metavar="CURVE.csv", help="write the curve as a recording")
    parser.add_argument("--figure", type=Path, metavar="F.png", help="draw the deformed mesh, coloured by --field")
    parser.add_argument("--field", choices=FIELDS, default="von_mises", help="colour of --figure (default: von_mises)")
    add_later_options(parser, "--tool", "--tool-radius-mm", "--edge-radius-mm", "--half-angle-deg", "--friction",
                      "--friction-base", "--friction-wall", "--protocol", "--rig", "--gravity")
    add_overwrite(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments) -> int:
    check_scene(arguments.scene)
    new_file(arguments.output, "-o", overwrite=arguments.overwrite, suffixes=(".csv",))
    if arguments.output is not None:
        new_file(arguments.output.with_suffix(".json"), "-o", overwrite=arguments.overwrite)
    new_file(arguments.figure, "--figure", overwrite=arguments.overwrite, suffixes=FIGURE_SUFFIXES)

    import tissue_sim as ts
    from tissue_sim.recording import MIN_POINTS
    from tissue_sim.recording_file import require_sidecar_place

    if arguments.output is not None:
        require_sidecar_place(arguments.output)
    if arguments.output is not None and arguments.points < MIN_POINTS:
        raise InputError(f"{arguments.points} points are too few for a recording; give at least {MIN_POINTS}, or leave "
                         "out -o", field="--points")
    material = ts.load_material(arguments.material)

    from scenes.compression import SCENES

    protocol = ts.Protocol.ramp(arguments.depth_mm * 1e-3, arguments.points, arguments.speed_mm_s * 1e-3)
    experiment = SCENES[arguments.scene].experiment(radius=arguments.radius_mm * 1e-3,
                                                    height=arguments.height_mm * 1e-3, protocol=protocol)
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

        draw_simulation(recording, ts.Model(experiment, material), arguments.figure, field=arguments.field)
    if arguments.json:
        print_json(as_json(recording, arguments.resolution, failure))
    else:
        print_curve(recording, arguments)
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


def as_json(recording, resolution: str, failure: Exception | None) -> dict:
    """The object of ``simulate --json``; units are in the names of the keys."""
    solver = recording.metadata.get("solver", {})
    return {
        "displacement_mm": (recording.displacement * 1e3).tolist(),
        "time_s": recording.time.tolist(),
        "force_N": recording.force.tolist(),
        "status": solver.get("status", "failed" if failure else "converged"),
        "message": str(failure) if failure else solver.get("message", ""),
        "newton_iterations": solver.get("newton_iterations"),
        "wall_s": solver.get("wall_s"),
        "mesh": solver.get("mesh"),
        "resolution": solver.get("resolution", resolution),
    }


def print_curve(recording, arguments) -> None:
    from rich.table import Table
    from rich.text import Text

    console = results_console()
    table = Table(title=arguments.scene.replace("_", " "))
    for heading in ("displacement [mm]", "force [N]"):
        table.add_column(Text(heading), justify="right")  # as text: rich reads brackets as markup
    for displacement, force in zip(recording.displacement, recording.force, strict=True):
        table.add_row(f"{displacement * 1e3:.3f}", f"{force:.4f}")
    console.print(table)
    solver = recording.metadata.get("solver")
    if solver:
        mesh = solver["mesh"]
        console.print(f"{mesh['elements']} elements, {mesh['freedoms']} freedoms, {solver['newton_iterations']} Newton "
                      f"iterations, {solver['wall_s']:.2f} s", markup=False)
    for path in (arguments.output, arguments.figure):
        if path is not None and path.exists():
            console.print(f"wrote {path}", markup=False, soft_wrap=True)
