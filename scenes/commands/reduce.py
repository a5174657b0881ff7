"""`tissue-sim reduce`: reduced-order model of a three-dimensional test for simulation at 1 kHz."""

from __future__ import annotations

import math
import sys
from argparse import Namespace
from functools import partial
from pathlib import Path
from typing import Any

from scenes.commands.shared.command import Command, CommandResult
from scenes.commands.shared.console import display_task
from scenes.commands.shared.experiment_flags import (
    add_experiment_flags,
    add_scene_and_optional_material_flag,
    load_material_or_study_silicone,
    make_experiment_from_flags,
    require_known_scene,
)
from scenes.commands.shared.parsing import (
    InputErrorArgumentParser,
    add_overwrite_flag,
    make_integer_parser,
    make_open_interval_number_parser,
    parse_non_negative_number,
    parse_positive_number,
)
from tissue_sim.errors import InputError

#: Relative rms error of the force above which the command recommends a better reduction.
_ACCEPTABLE_ERROR = 0.03


def _add_material_and_output_flags(parser: InputErrorArgumentParser) -> None:
    """Add the further materials and the file of the reduced model."""
    parser.add_argument("--also", type=Path, metavar="FILE", action="append", default=[],
                        help="further material for which the reduced model must be accurate; each material is used in "
                        "turn for the training paths (may be given several times)")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE",
                        help="file of the reduced model, NAME.reduced.npz")
    add_overwrite_flag(parser)


def _add_box_and_effort_flags(parser: InputErrorArgumentParser) -> None:
    """Add the box of tool poses, and the flags of accuracy and effort."""
    box = parser.add_argument_group("box of tool poses")
    box.add_argument("--depth-mm", type=parse_positive_number, metavar="N", default=4.0,
                     help="largest depth of the tool (default: %(default)g)")
    box.add_argument("--sideways-mm", type=parse_non_negative_number, metavar="N", default=0.0,
                     help="largest lateral displacement, along x and y in both directions (default: 0)")
    box.add_argument("--turn-deg", type=make_open_interval_number_parser(0.0, 45.0), metavar="N", default=0.0,
                     help="largest rotation of the tool, about any axis (default: 0)")
    effort = parser.add_argument_group("accuracy and effort")
    effort.add_argument("--resolution", choices=("realtime", "fast", "accurate"), default="realtime",
                        help="mesh of the full model (default: %(default)s)")
    effort.add_argument("--strokes", type=make_integer_parser(2, 4000), metavar="N",
                        help="number of training paths, motions of the tool that the full model simulates (default: 24 "
                        "for a bonded tool, 60 for other contact; for a cylinder under an upright tool on its "
                        "axis 6 and 30, because mirror images are used too; the same number again for each "
                        "--also)")
    effort.add_argument("--modes", type=make_integer_parser(2, 400), metavar="N",
                        help="number of displacement modes (default: 24 for a bonded tool, 64 for other contact)")
    effort.add_argument("--bulk-ratio", type=make_open_interval_number_parser(1.0, 1000.0), metavar="N",
                        help="upper limit of bulk modulus over shear modulus; a larger value needs more modes and "
                        "training paths (default: 300; 50 for a tool that slides on the tissue)")
    effort.add_argument("--sampling", type=parse_positive_number, metavar="N", default=6e-3,
                        help="relative error of the internal forces of the sampled elements (hyper-reduction; default: "
                        "%(default)g)")
    effort.add_argument("--tried", type=make_integer_parser(1, 1000), metavar="N", default=3,
                        help="number of test paths, not used in training, for the error of the reduced model; at least "
                        "one path for each material (default: %(default)s)")


def _run(arguments: Namespace) -> CommandResult:
    """Reduce the model and write its file; an interrupted reduction resumes.

    Raises:
        InputError: an output file that cannot be written, or values that the reduction does not accept.
    """
    require_known_scene(arguments.scene)
    output: Path = arguments.output
    if output.exists() and not arguments.overwrite:
        raise InputError("exists already. Choose another name, or replace it with --overwrite", file=output)
    if not output.name.endswith(".npz"):
        raise InputError("the file name must end in .npz. Use NAME.reduced.npz", file=output)

    import tissue_sim as ts
    from tissue_sim.fem.reduced.file import POINTS
    from tissue_sim.fem.reduced.reduction import remove_training_path_files

    material, also = load_material_or_study_silicone(arguments.material), [load_material_or_study_silicone(path)
                                                                           for path in arguments.also]
    depth = arguments.depth_mm * 1e-3
    experiment = make_experiment_from_flags(arguments, ts.Protocol.ramp(depth, points=POINTS), material)
    box = ts.PoseBox(arguments.sideways_mm * 1e-3, depth, math.radians(arguments.turn_deg))
    folder = output.with_name(f"{output.name}.strokes")
    arguments.resume_hint = "finished training paths are kept. Run the same command to resume"
    with display_task("generating the mesh", quiet=arguments.json) as status:
        def show_reduction_progress(stage: str, done: int, of: int, *, note: str = "") -> None:
            """Show the stage of the reduction, the number of its finished tasks and a note."""
            status.update(f"{stage}: {done} of {of}{f', {note}' if note else ''}")

        reduced = ts.reduce_solid(
            ts.Model(experiment, material), box, resolution=arguments.resolution, strokes=arguments.strokes,
            modes=arguments.modes, sampling=arguments.sampling, bulk_ratio=arguments.bulk_ratio,
            also=also, tried=arguments.tried, folder=folder, progress=show_reduction_progress)
    ts.write_reduced(reduced, output)
    remove_training_path_files(folder)
    return CommandResult(lambda: {**reduced.report, "file": str(output)},
                         lambda _: _print_reduction_report(reduced.report, output, several=bool(also)))


def _print_reduction_report(report: dict[str, Any], output: Path, *, several: bool) -> None:
    """Print size and error of a reduced model, warnings, and its file.

    Args:
        report: report of the reduced model.
        output: file of the reduced model.
        several: whether the model was reduced for several materials.
    """
    print(f"{report['freedoms']} degrees of freedom reduced to {report['modes']} modes, {report['elements_of_all']} "
          f"elements to {report['elements']}, from {report['snapshots']} states on {report['strokes']} training paths")
    materials = f" with {report['materials']} materials" if several else ""
    print(f"force error on {report['tried']} test paths{materials}: {100 * report['force_rms_error']:.2g} % rms, "
          f"{100 * report['force_largest_error']:.2g} % at most, of the rms force {report['force_rms_N']:.3g} N")
    if report["force_rms_error"] > _ACCEPTABLE_ERROR:
        print(f"the error is larger than {100 * _ACCEPTABLE_ERROR:g} %. Use more training paths (--strokes "
              f"{2 * report['strokes']}), more modes (--modes {2 * report['modes']}) or a smaller box")
    for warning in report.get("warnings", ()):
        print(f"tissue-sim: warning: {warning}", file=sys.stderr)
    print(f"wrote {output}")


COMMAND = Command(
    "reduce", "make a reduced model of a three-dimensional test for 1000 steps per second, for tool poses inside a box",
    "tissue-sim reduce needle_indentation --material m.material.json --tool flat --tool-radius-mm 8 --depth-mm 4 "
    "--sideways-mm 3 --turn-deg 5 -o needle.reduced.npz", _run,
    needs=(partial(add_scene_and_optional_material_flag, purpose="reduce"), _add_material_and_output_flags,
           _add_box_and_effort_flags, partial(add_experiment_flags, motion=False)))
