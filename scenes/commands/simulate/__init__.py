"""`tissue-sim simulate SCENE`: simulate a mechanical test with the material of a file."""

from __future__ import annotations

import sys
from pathlib import Path

from scenes.catalogue import SCENES
from scenes.commands.shared.console import make_progress_console, make_results_console, print_json
from scenes.commands.shared.exit_code import ExitCode
from scenes.commands.shared.experiment_flags import (
    add_experiment_flags,
    make_experiment_from_flags,
    make_protocol_from_flags,
    require_known_scene,
)
from scenes.commands.shared.log_lines import display_task
from scenes.commands.shared.parsing import (
    InputErrorArgumentParser,
    add_json_flag,
    add_overwrite_flag,
    check_output_file,
)
from scenes.commands.shared.tissue_flags import add_resolution_and_solver_flags, require_known_solver
from scenes.commands.simulate.replicates import (
    add_rig_flags,
    load_rig_with_noise_and_seed_flags,
    make_replicate_curve_paths,
    simulate_replicate_readings,
)
from scenes.commands.simulate.report import make_simulation_json_object, print_force_curve, print_mesh_cost_and_remarks
from scenes.field_labels import LABELS
from scenes.provenance import make_kind_specimen_tool_metadata
from tissue_sim.errors import ConvergenceError, InputError

SUMMARY = "simulate a mechanical test and print force against displacement"
EXAMPLE = ("tissue-sim simulate needle_indentation --material m.material.json --friction 0.7 --edge-radius-mm 0.25 "
           "--protocol 'ramp 10mm @0.248mm/s; hold 60s; unload' -o needle.csv")
#: Formats of ``--figure``.
FIGURE_SUFFIXES = (".png", ".svg", ".pdf")


def add_arguments(parser: InputErrorArgumentParser) -> None:
    """Declare the arguments of `tissue-sim simulate`."""
    parser.add_argument("scene", metavar="SCENE", help=f"test to simulate: {', '.join(SCENES)}")
    parser.add_argument("--material", type=Path, required=True, metavar="FILE",
                        help="material file NAME.material.json (tissue-sim material new or calibrate writes it)")
    add_experiment_flags(parser)
    add_rig_flags(parser)
    add_resolution_and_solver_flags(parser, ("fast", "accurate"))
    parser.add_argument("-o", dest="output", type=Path, metavar="CURVE.csv",
                        help="write the force curve as a recording")
    parser.add_argument("--figure", type=Path, metavar="F.png",
                        help="draw the deformed mesh, coloured by --field, and the force curve")
    parser.add_argument("--field", choices=tuple(LABELS),
                        help="field that colours the mesh of --figure (default: the first that the solver has)")
    parser.add_argument("--no-force-error", action="store_true",
                        help="do not estimate the force error; saves the second simulation on another mesh")
    add_overwrite_flag(parser)
    add_json_flag(parser)
    parser.set_defaults(run=run)


def run(arguments) -> int:
    """Simulate the test; print, write and draw its force curve.

    Raises:
        InputError: files that cannot be written, or flags and values that the test does not accept.
        ConvergenceError: the solver stopped early; its partial curve was printed and written.
    """
    require_known_scene(arguments.scene)
    outputs = make_replicate_curve_paths(arguments.output, arguments.replicates)
    for path in outputs:
        check_output_file(path, "-o", overwrite=arguments.overwrite, suffixes=(".csv",))
        check_output_file(path.with_suffix(".json"), "-o", overwrite=arguments.overwrite)
    check_output_file(arguments.figure, "--figure", overwrite=arguments.overwrite, suffixes=FIGURE_SUFFIXES)
    if arguments.field is not None and arguments.figure is None:
        raise InputError("requires a figure. Add --figure F.png", field="--field")
    require_known_solver(arguments.solver)

    import tissue_sim as ts
    from tissue_sim.fem.result_views import get_drawable_fields_or_none
    from tissue_sim.recording.file import require_overwritable_sidecar
    from tissue_sim.recording.recording import MIN_POINTS

    for path in outputs:
        require_overwritable_sidecar(path)
    protocol, rig = make_protocol_from_flags(arguments), load_rig_with_noise_and_seed_flags(arguments)
    points = rig.count_readings(protocol.time)
    if outputs and points < MIN_POINTS:
        raise InputError(f"a recording needs at least {MIN_POINTS} samples; got {points}. Add samples, or leave out -o",
                         field="--points" if rig.sampling_rate is None else "--rig")
    material_file = ts.read_material_file(arguments.material)

    from scenes.commands.material.summary import list_warnings_if_test_leaves_range

    experiment = make_experiment_from_flags(arguments, protocol, material_file.material)
    # The solver needs the compliance of the rig only; the sensor is applied below, once for each replicate.
    model = ts.Model(experiment, material_file.material, rig.with_motion_effects_only)
    failure = None
    estimates_error = not (arguments.no_force_error or experiment.slip) and arguments.solver == "axisymmetric"
    with display_task(make_progress_console(quiet=arguments.json), "simulating", quiet=arguments.json) as status:
        try:
            recording = ts.simulate(
                model, resolution=arguments.resolution, fields=True, solver=arguments.solver,
                estimate_error=not arguments.no_force_error,
                progress=lambda done, of: status.update(describe_simulation_progress(done, of, estimates_error)))
        except ConvergenceError as error:
            if error.recording is None:
                raise
            recording, failure = error.recording, error
    if arguments.figure is not None and get_drawable_fields_or_none(recording.fields) is None:
        raise InputError(f"requires fields with a geometry, which the solver {arguments.solver!r} does not provide. "
                         "Leave --figure out",
                         field="--figure")
    recordings = simulate_replicate_readings(
        rig, recording.with_metadata(**make_kind_specimen_tool_metadata(arguments.scene, experiment)),
        arguments.replicates)
    for path, written in zip(outputs, recordings, strict=bool(outputs)):
        ts.write_recording(written, path)
    if arguments.figure is not None:
        from scenes.figures import draw_simulation

        draw_simulation(recording, model, arguments.figure, field=arguments.field)
    warnings = [*list_warnings_if_test_leaves_range(material_file, recording, experiment.specimen.height),
                *recording.metadata.get("solver", {}).get("warnings", [])]
    if arguments.json:
        print_json(make_simulation_json_object(recordings, arguments.resolution, failure, warnings,
                                               replicates=arguments.replicates is not None))
    else:
        print_simulation_results(recordings, arguments, [*outputs, arguments.figure])
        for warning in warnings:
            print(f"tissue-sim: warning: {warning}", file=sys.stderr)
    if failure is not None:
        kept = f"; the curve up to this point is in {' and '.join(map(str, outputs))}" if outputs else ""
        raise ConvergenceError(f"{failure}{kept}")
    return ExitCode.DONE


def describe_simulation_progress(done: int, samples: int, estimates_error: bool) -> str:
    """Return the progress of a simulation in words.

    Args:
        done: finished samples.
        samples: all samples.
        estimates_error: whether a second simulation follows, which estimates the force error.
    """
    if done == samples and estimates_error:
        return "simulating on another mesh to estimate the force error"
    if done == 0:
        return "loading the solver (the first run on a computer compiles it, about 10 s)"
    return f"simulating: {done} of {samples} samples"


def print_simulation_results(recordings, arguments, written: list[Path | None]) -> None:
    """Print the first recording, remarks on its solution and the names of the written files."""
    console = make_results_console()
    print_force_curve(recordings[0], arguments.scene.replace("_", " "), console)
    if len(recordings) > 1:
        console.print(f"replicate 1 of {len(recordings)} is shown", markup=False)
    print_mesh_cost_and_remarks(recordings[0], console)
    for path in written:
        if path is not None and path.exists():
            console.print(f"wrote {path}", markup=False, soft_wrap=True)
