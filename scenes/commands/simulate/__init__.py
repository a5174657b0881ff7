"""`tissue-sim simulate SCENE`: force against displacement, from a material file."""

from __future__ import annotations

import sys
from pathlib import Path

from scenes.catalogue import SCENES
from scenes.commands.shared.console import print_json, progress_console, results_console
from scenes.commands.shared.experiment_flags import add_experiment_flags, check_scene, make_experiment, make_protocol
from scenes.commands.shared.log_lines import status_of
from scenes.commands.shared.parsing import Parser, add_json, add_overwrite, new_file
from scenes.commands.shared.tissue_flags import add_solver_flags, check_solver
from scenes.commands.simulate.replicates import add_rig_flags, make_rig, output_files, read_replicates
from scenes.commands.simulate.report import as_json, print_curve, print_solver
from scenes.field_labels import LABELS
from scenes.what_was_done import what_was_done
from tissue_sim.errors import ConvergenceError, InputError

SUMMARY = "simulate a test and print force against displacement"
EXAMPLE = ("tissue-sim simulate needle_indentation --material m.material.json --friction 0.7 --edge-radius-mm 0.25 "
           "--protocol 'ramp 10mm @0.248mm/s; hold 60s; unload' -o needle.csv")
FIGURE_SUFFIXES = (".png", ".svg", ".pdf")


def add_arguments(parser: Parser) -> None:
    parser.add_argument("scene", metavar="SCENE", help=" or ".join(SCENES))
    parser.add_argument("--material", type=Path, required=True, metavar="FILE", help="NAME.material.json")
    add_experiment_flags(parser)
    add_rig_flags(parser)
    add_solver_flags(parser, ("fast", "accurate"))
    parser.add_argument("-o", dest="output", type=Path, metavar="CURVE.csv", help="write the curve as a recording")
    parser.add_argument("--figure", type=Path, metavar="F.png", help="draw the deformed mesh, coloured by --field")
    parser.add_argument("--field", choices=tuple(LABELS), help="colour of --figure (default: von_mises)")
    parser.add_argument("--no-force-error", action="store_true",
                        help="leave out the second test, on another mesh, that tells how far the force errs")
    add_overwrite(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments) -> int:
    check_scene(arguments.scene)
    outputs = output_files(arguments.output, arguments.replicates)
    for path in outputs:
        new_file(path, "-o", overwrite=arguments.overwrite, suffixes=(".csv",))
        new_file(path.with_suffix(".json"), "-o", overwrite=arguments.overwrite)
    new_file(arguments.figure, "--figure", overwrite=arguments.overwrite, suffixes=FIGURE_SUFFIXES)
    if arguments.field is not None and arguments.figure is None:
        raise InputError("a field colours a figure; add --figure F.png", field="--field")
    check_solver(arguments.solver)

    import tissue_sim as ts
    from tissue_sim.recording.file import require_sidecar_place
    from tissue_sim.recording.recording import MIN_POINTS

    for path in outputs:
        require_sidecar_place(path)
    protocol, rig = make_protocol(arguments), make_rig(arguments)
    points = rig.readings(protocol.time)
    if outputs and points < MIN_POINTS:
        raise InputError(f"{points} points are too few for a recording; give at least {MIN_POINTS}, or leave out -o",
                         field="--points" if rig.sampling_rate is None else "--rig")
    material_file = ts.read_material_file(arguments.material)

    from scenes.commands.material.summary import doubts

    experiment = make_experiment(arguments, protocol, material_file.material)
    # Readings are made below, once for each replicate; what the rig does to the motion is solved here.
    model = ts.Model(experiment, material_file.material, rig.motion_only)
    failure = None
    again = not (arguments.no_force_error or experiment.slip) and arguments.solver == "axisymmetric"
    with status_of(progress_console(quiet=arguments.json), "simulating", quiet=arguments.json) as status:
        try:
            recording = ts.simulate(
                model, resolution=arguments.resolution, fields=True, solver=arguments.solver,
                estimate_error=not arguments.no_force_error,
                progress=lambda done, of: status.update(describe(done, of, again)))
        except ConvergenceError as error:
            if error.recording is None:
                raise
            recording, failure = error.recording, error
    if arguments.figure is not None and recording.fields is None:
        raise InputError(f"the solver {arguments.solver!r} has no fields to draw; leave the figure out",
                         field="--figure")
    recordings = read_replicates(rig, recording.with_metadata(**what_was_done(arguments.scene, experiment)),
                                 arguments.replicates)
    for path, written in zip(outputs, recordings, strict=bool(outputs)):
        ts.write_recording(written, path)
    if arguments.figure is not None:
        from scenes.figures import draw_simulation

        draw_simulation(recording, model, arguments.figure, field=arguments.field or "von_mises")
    warnings = [*doubts(material_file, recording, experiment.specimen.height),
                *recording.metadata.get("solver", {}).get("warnings", [])]
    if arguments.json:
        print_json(as_json(recordings, arguments.resolution, failure, warnings,
                           replicates=arguments.replicates is not None))
    else:
        show(recordings, arguments, [*outputs, arguments.figure])
        for warning in warnings:
            print(f"tissue-sim: warning: {warning}", file=sys.stderr)
    if failure is not None:
        kept = f"; the curve up to there is in {' and '.join(map(str, outputs))}" if outputs else ""
        raise ConvergenceError(f"{failure}{kept}")
    return 0


def describe(done: int, samples: int, again: bool) -> str:
    """Where a test is; `again`: whether a second one follows, to see how far the force errs."""
    if done == samples and again:
        return "simulating once more, on another mesh, to see how far the force errs"
    if done == 0:
        return "loading the solver (a machine's first run compiles it, some 10 s)"
    return f"simulating: {done} of {samples} samples"


def show(recordings, arguments, written: list[Path | None]) -> None:
    """Print the first recording, the solver's remarks and what was written."""
    console = results_console()
    print_curve(recordings[0], arguments.scene.replace("_", " "), console)
    if len(recordings) > 1:
        console.print(f"this is replicate 1 of {len(recordings)}", markup=False)
    print_solver(recordings[0], console)
    for path in written:
        if path is not None and path.exists():
            console.print(f"wrote {path}", markup=False, soft_wrap=True)
