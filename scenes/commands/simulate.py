"""`tissue-sim simulate SCENE`: simulate a mechanical test with the material of a file."""

from __future__ import annotations

import math
import sys
from argparse import Namespace
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from scenes.catalogue import SIMULATED, make_kind_specimen_tool_metadata
from scenes.commands.shared.command import Command, CommandResult
from scenes.commands.shared.console import TABLES, display_task
from scenes.commands.shared.experiment_flags import (
    add_experiment_flags,
    add_resolution_and_solver_flags,
    make_experiment_from_flags,
    make_protocol_from_flags,
    require_known_scene,
    require_known_solver,
)
from scenes.commands.shared.parsing import (
    InputErrorArgumentParser,
    add_overwrite_flag,
    check_output_file,
    make_integer_parser,
    parse_non_negative_number,
)
from scenes.field_labels import LABELS
from tissue_sim.errors import ConvergenceError, InputError

if TYPE_CHECKING:
    import numpy as np
    from rich.console import Console

    from tissue_sim import Model, Recording, Rig

#: Formats of ``--figure``.
FIGURE_SUFFIXES = (".png", ".svg", ".pdf")
#: Largest value of ``--replicates``.
MAX_REPLICATES = 1000
#: Entries of the solver report that appear in the JSON object only if they apply to the test.
OPTIONAL_KEYS = ("force_error", "penetration_mm", "penetration_tolerance_mm", "slipping_points", "self_weight", "ends",
                 "grip_factor")


def _add_scene_and_material(parser: InputErrorArgumentParser) -> None:
    """Add the scene and ``--material``."""
    parser.add_argument("scene", metavar="SCENE", help=f"test to simulate: {', '.join(SIMULATED)}")
    parser.add_argument("--material", type=Path, required=True, metavar="FILE",
                        help="material file NAME.material.json (tissue-sim material new or calibrate writes it)")


def _add_rig_flags(parser: InputErrorArgumentParser) -> None:
    """Add the flags of rig file, noise, replicates and seed."""
    rig = parser.add_argument_group("rig")
    rig.add_argument("--rig", type=Path, metavar="FILE",
                     help="rig file NAME.rig.json with the properties of load frame and sensor (default: an ideal rig)")
    rig.add_argument("--noise-N", type=parse_non_negative_number, metavar="N",
                     help="standard deviation of the force noise (default: value of the rig file, or 0)")
    rig.add_argument("--replicates", type=make_integer_parser(1, MAX_REPLICATES), metavar="N",
                     help="number of recordings with independent noise; -o CURVE.csv writes CURVE_1.csv, "
                     "CURVE_2.csv, ...")
    rig.add_argument("--seed", type=make_integer_parser(0), metavar="N",
                     help="seed of the noise; equal seeds give equal files (default: value of the rig file, or 0)")


def _add_output_and_figure_flags(parser: InputErrorArgumentParser) -> None:
    """Add the flags of the written files, and of the estimate of the force error."""
    parser.add_argument("-o", dest="output", type=Path, metavar="CURVE.csv",
                        help="write the force curve as a recording")
    parser.add_argument("--figure", type=Path, metavar="F.png",
                        help="draw the deformed mesh, coloured by --field, and the force curve")
    parser.add_argument("--field", choices=tuple(LABELS),
                        help="field that colours the mesh of --figure (default: the first that the solver has)")
    parser.add_argument("--no-force-error", action="store_true",
                        help="do not estimate the force error; saves the second simulation on another mesh")


def _run(arguments: Namespace) -> CommandResult:
    """Simulate the test; write and draw its force curve.

    Raises:
        InputError: files that cannot be written, or flags and values that the test does not accept.
        ConvergenceError: the solver stopped early; its partial curve was printed and written.
    """
    require_known_scene(arguments.scene, allows_grips=True)
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
    protocol = make_protocol_from_flags(arguments, allows_force=True)
    rig = load_rig_with_noise_and_seed_flags(arguments)
    points = rig.count_readings(protocol.time)
    if outputs and points < MIN_POINTS and protocol.remaining is None:
        raise InputError(f"a recording needs at least {MIN_POINTS} samples; got {points}. Add samples, or leave out -o",
                         field="--points" if rig.sampling_rate is None else "--rig")
    material_file = ts.read_material_file(arguments.material)

    from scenes.commands.material.summary import list_warnings_if_test_leaves_range

    experiment = make_experiment_from_flags(arguments, protocol, material_file.material)
    # The solver needs the effects on the motion only; the sensor is applied below, once for each replicate. A machine
    # that controls the force reads the sensor, so that only noise and sampling are applied below.
    simulated, read = (rig.without_sampling_effects, rig.with_sampling_effects_only) if protocol.uses_force_control \
        else (rig.with_motion_effects_only, rig)
    model = replace(ts.Model(experiment, material_file.material, rig), rig=simulated)
    failure = None
    estimates_error = not (arguments.no_force_error or experiment.slip) and arguments.solver == "axisymmetric"
    with display_task("simulating", quiet=arguments.json) as status:
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
    if experiment.grip is not None:
        recording = _add_grip_factor(recording, arguments.scene, model)
    recordings = simulate_replicate_readings(
        read, recording.with_metadata(**make_kind_specimen_tool_metadata(arguments.scene, experiment)),
        arguments.replicates)
    for path, written in zip(outputs, recordings, strict=bool(outputs)):
        ts.write_recording(written, path)
    if arguments.figure is not None:
        from scenes.figures import draw_simulation

        draw_simulation(recording, model, arguments.figure, field=arguments.field)
    warnings = [*list_warnings_if_test_leaves_range(material_file, recording, experiment),
                *recording.metadata.get("solver", {}).get("warnings", [])]
    result = CommandResult(
        lambda: make_simulation_json_object(recordings, arguments.resolution, failure, warnings,
                                            replicates=arguments.replicates is not None),
        lambda console: print_simulation_results(recordings, arguments.scene, [*outputs, arguments.figure], warnings,
                                                 console))
    if failure is not None:
        result.print_as_text_or_json(json=arguments.json)
        kept = f"; the curve up to this point is in {' and '.join(map(str, outputs))}" if outputs else ""
        raise ConvergenceError(f"{failure}{kept}")
    return result


def _add_grip_factor(recording: Recording, scene: str, model: Model) -> Recording:
    """Return a recording whose solver report has the load over that of the closed form, if the closed form holds."""
    import numpy as np

    from tissue_sim.grip_factor import compute_grip_factor

    try:
        factor = compute_grip_factor(SIMULATED[scene], model, recording)
    except InputError:
        return recording
    values = [None if np.isnan(value) else value for value in factor.tolist()]
    return recording.with_metadata(solver={**recording.metadata["solver"], "grip_factor": values})


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


def print_simulation_results(recordings: Sequence[Recording], scene: str, written: list[Path | None],
                             warnings: list[str], console: Console) -> None:
    """Print the first recording, remarks on its solution, the names of the written files, and on stderr warnings."""
    print_force_curve(recordings[0], scene.replace("_", " "), console)
    if len(recordings) > 1:
        console.print(f"replicate 1 of {len(recordings)} is shown", markup=False)
    print_mesh_cost_and_remarks(recordings[0], console)
    for path in written:
        if path is not None and path.exists():
            console.print(f"wrote {path}", markup=False, soft_wrap=True)
    for warning in warnings:
        print(f"tissue-sim: warning: {warning}", file=sys.stderr)


def load_rig_with_noise_and_seed_flags(arguments) -> Rig:
    """Return the rig of ``--rig`` with the noise and the seed of the flags.

    Raises:
        InputError: an invalid rig file, or replicates or a seed without noise.
    """
    from tissue_sim.rig.file import load_rig
    from tissue_sim.rig.rig import Rig

    rig = Rig() if arguments.rig is None else load_rig(arguments.rig)
    if arguments.noise_N is not None:
        rig = replace(rig, force_noise=arguments.noise_N)
    if not rig.force_noise:
        for flag, value in (("--replicates", arguments.replicates), ("--seed", arguments.seed)):
            if value is not None:
                raise InputError("has an effect only with noise. Add --noise-N 0.02 or a rig with force_noise_N",
                                 field=flag)
    return rig if arguments.seed is None else replace(rig, seed=arguments.seed)


def make_replicate_curve_paths(curve: Path | None, replicates: int | None) -> list[Path]:
    """Return the files of the recordings: CURVE.csv, or CURVE_1.csv, CURVE_2.csv, ... for replicates."""
    if curve is None:
        return []
    if replicates is None:
        return [curve]
    return [curve.with_name(f"{curve.stem}_{number}{curve.suffix}") for number in range(1, replicates + 1)]


def simulate_replicate_readings(rig: Rig, recording: Recording, replicates: int | None) -> Sequence[Recording]:
    """Return replicates: the recording of true forces as the sensor of a rig measures it, with noise.

    The seeds of the replicates follow from the seed of the rig. The first replicates do not change when their number
    grows.

    Args:
        rig: rig with sensor and noise.
        recording: simulated recording.
        replicates: number of readings with different seeds; None makes one reading with the seed of the rig.
    """
    if replicates is None:
        return [rig.read(recording)]
    import numpy as np

    seeds = np.random.SeedSequence(rig.seed).generate_state(replicates).tolist()
    return [replace(rig, seed=seed).read(recording).with_metadata(replicate=number, seed=seed)
            for number, seed in enumerate(seeds, 1)]


def make_simulation_json_object(recordings: Sequence[Recording], resolution: str, failure: Exception | None,
                                warnings: list[str], *, replicates: bool = False) -> dict[str, Any]:
    """Return the object of ``simulate --json``; the names of the keys contain the units.

    Args:
        recordings: one recording, or all replicates; the curve is that of the first one.
        resolution: resolution of the flag.
        failure: error that stopped the solver; None if it finished.
        warnings: warnings, one sentence each.
        replicates: whether the object contains the forces of all recordings.
    """
    recording = recordings[0]
    solver = recording.metadata.get("solver", {})
    answer = {
        **_make_curve_entries(recording),
        "time_s": recording.time.tolist(),
        **_make_wrench_entries(recording),
        **{name: labels.tolist() for name, labels in recording.labels.items()},
        "status": solver.get("status", "failed" if failure else "converged"),
        "message": str(failure) if failure else solver.get("message", ""),
        "warnings": warnings,
        "newton_iterations": solver.get("newton_iterations"),
        "wall_s": solver.get("wall_s"),
        "mesh": solver.get("mesh"),
        "resolution": solver.get("resolution", resolution),
        **{key: solver[key] for key in OPTIONAL_KEYS if solver.get(key) is not None},
    }
    if replicates:
        answer["replicates"] = [{**_make_curve_entries(one), "seed": one.metadata["seed"]} for one in recordings]
    return answer


def _make_curve_entries(recording: Recording) -> dict[str, list[float]]:
    """Return displacement and force, or angle and torque, as JSON entries."""
    if "torque" in recording:
        import numpy as np

        return {"angle_deg": np.degrees(recording.channel("angle")).tolist(),
                "torque_Nm": recording.channel("torque").tolist()}
    return {"displacement_mm": (recording.displacement * 1e3).tolist(), "force_N": recording.force.tolist()}


def _make_wrench_entries(recording: Recording) -> dict[str, Any]:
    """Return force and torque vectors on the tool as JSON entries; empty for an axisymmetric simulation."""
    if "Fx" not in recording:
        return {}
    force, torque = ([recording.channel(f"{kind}{axis}") for axis in "xyz"] for kind in "FT")
    return {"force_vector_N": [list(map(float, row)) for row in zip(*force, strict=True)],
            "torque_vector_Nm": [list(map(float, row)) for row in zip(*torque, strict=True)]}


def print_force_curve(recording: Recording, title: str, console: Console) -> None:
    """Print the load against the motion, with time and segment if the protocol has several segments."""
    import numpy as np
    from rich.table import Table
    from rich.text import Text

    rows = select_printed_sample_indices(recording)
    table = Table(title=title)
    columns = []
    segments = [str(name) for name in recording.labels.get("segment", ())]
    several = len(set(segments)) > 1
    if several:
        table.add_column("segment")
        columns.append([segments[row] for row in rows])
    curves = [("time", recording.time, "s")] if several else []
    if "torque" in recording:
        curves += [("angle", np.degrees(recording.channel("angle")), "deg"),
                   ("torque", recording.channel("torque"), "Nm")]
    else:
        curves += [("displacement", recording.displacement * 1e3, "mm"), ("force", recording.force, "N")]
    for quantity, values, unit in curves:
        factor, prefix = (1e3, "m") if 0 < abs(values).max() < 0.1 and unit in ("N", "Nm") else (1.0, "")
        # Text instead of str, because rich interprets brackets in a str as markup.
        table.add_column(Text(f"{quantity} [{prefix}{unit}]"), justify="right")
        columns.append(format_number_column(values[rows] * factor))
    for row in zip(*columns, strict=True):
        table.add_row(*row)
    console.print(table)
    if len(rows) < len(recording):
        sentence = f"{len(rows)} of {len(recording)} samples are shown; -o CURVE.csv writes all samples"
        console.print(sentence, markup=False)


def select_printed_sample_indices(recording: Recording) -> np.ndarray:
    """Return the indices of the printed samples, at most `PrintedTableLimits.max_curve_rows`.

    A short curve is printed completely. Of a long one the last sample of each segment is printed (unless the segments
    would take more than half of the rows), and evenly spaced samples.
    """
    import numpy as np

    samples = len(recording)
    if samples <= TABLES.max_curve_rows:
        return np.arange(samples)
    changes = [labels[1:] != labels[:-1] for labels in recording.labels.values()]
    ends = np.flatnonzero(np.any(changes, axis=0)) if changes else np.array([], dtype=int)
    if ends.size > TABLES.max_curve_rows // 2:
        ends = ends[:0]
    return np.union1d(ends, np.linspace(0, samples - 1, TABLES.max_curve_rows - ends.size).round().astype(int))


def print_mesh_cost_and_remarks(recording: Recording, console: Console) -> None:
    """Print size, cost and force error of the solution, and remarks on contact and self-weight."""
    solver = recording.metadata.get("solver")
    if not solver:
        return
    mesh = solver["mesh"]
    console.print(f"{mesh['elements']} elements, {mesh['freedoms']} degrees of freedom, {solver['newton_iterations']} "
                  f"Newton iterations, {solver['wall_s']:.2f} s", markup=False)
    for sentence in iterate_error_contact_and_weight_remarks(solver):
        console.print(sentence, markup=False, soft_wrap=True)


def iterate_error_contact_and_weight_remarks(solver: dict) -> Iterator[str]:
    """Yield one sentence each on force error, penetration, friction and self-weight, as far as they apply."""
    if "ends" in solver:
        yield (f"ends of the specimen: {solver['ends']}, which the closed form of this test does not model")
    if known := [value for value in solver.get("grip_factor", ()) if value is not None]:
        yield f"load over that of the closed form: {min(known):.4g} to {max(known):.4g}"
    if solver.get("force_error") is not None:
        yield (f"estimated force error: {100 * solver['force_error']:.2g} % of the largest force, from a comparison "
               "with another mesh and longer steps")
    if "penetration_mm" in solver:
        yield (f"largest penetration of tool and tissue: {solver['penetration_mm']:.2g} mm "
               f"(tolerance {solver['penetration_tolerance_mm']:.2g} mm)")
    if "slipping_points" in solver:
        yield f"friction: at most {solver['slipping_points']} contact points slip at the same time"
    if "self_weight" in solver:
        weight = solver["self_weight"]
        yield (f"self-weight: the specimen settles by {weight['sag_mm']:.3f} mm before the test, from a moulded height "
               f"of {weight['moulded_height_mm']:.3f} mm (density {weight['density_kg_m3']:g} kg/m3, g "
               f"{weight['gravity_m_s2']:g} m/s2)")


def format_number_column(values: np.ndarray, digits: int = 5) -> list[str]:
    """Format the numbers of a column with equal decimals; the largest number shows `digits` significant digits."""
    largest = float(abs(values).max())
    decimals = max(0, digits - 1 - math.floor(math.log10(largest))) if largest > 0 else digits - 1
    return [f"{value + 0.0:.{decimals}f}" if round(float(value), decimals) else f"{0:.{decimals}f}" for value in values]


COMMAND = Command(
    "simulate", "simulate a mechanical test and print force against displacement",
    "tissue-sim simulate needle_indentation --material m.material.json --friction 0.7 --edge-radius-mm 0.25 "
    "--protocol 'ramp 10mm @0.248mm/s; hold 60s; unload' -o needle.csv", _run,
    needs=(_add_scene_and_material, add_experiment_flags, _add_rig_flags,
           partial(add_resolution_and_solver_flags, resolutions=("fast", "accurate")), _add_output_and_figure_flags,
           add_overwrite_flag))
