"""`tissue-sim reduce`: a solid in space that is stepped a thousand times a second, for a tool that stays in a box."""

from __future__ import annotations

import math
import sys
from pathlib import Path

from scenes.catalogue import SCENES
from scenes.commands.shared.console import print_json, progress_console
from scenes.commands.shared.experiment_flags import add_experiment_flags, check_scene, make_experiment
from scenes.commands.shared.log_lines import status_of
from scenes.commands.shared.parsing import Parser, add_json, at_least, between, not_negative, positive
from scenes.commands.shared.tissue_flags import read_material
from tissue_sim.errors import InputError

SUMMARY = "reduce a solid in space to what a tool in a box of poses needs, for 1000 steps a second"
EXAMPLE = ("tissue-sim reduce needle_indentation --material m.material.json --tool flat --tool-radius-mm 8 "
           "--depth-mm 4 --sideways-mm 3 --turn-deg 5 -o needle.reduced.npz")
#: Error of the force, of its rms, from which on it is said what to do.
_POOR = 0.03


def add_arguments(parser: Parser) -> None:
    parser.add_argument("scene", metavar="SCENE", nargs="?", default="needle_indentation",
                        help=f"{' or '.join(SCENES)} (default: %(default)s)")
    parser.add_argument("--material", type=Path, metavar="FILE",
                        help="NAME.material.json (default: the study's silicone, reduced_polynomial_2)")
    parser.add_argument("--also", type=Path, metavar="FILE", action="append", default=[],
                        help="another material that it shall be good for, too: strokes are followed with each in turn "
                             "(may be given several times)")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="NAME.reduced.npz")
    parser.add_argument("--overwrite", action="store_true", help="replace an output that is there")
    box = parser.add_argument_group("box of poses")
    box.add_argument("--depth-mm", type=positive, metavar="N", default=4.0,
                     help="how far the tool may go in (default: %(default)g)")
    box.add_argument("--sideways-mm", type=not_negative, metavar="N", default=0.0,
                     help="how far the tool may go aside, along x and y either way (default: 0)")
    box.add_argument("--turn-deg", type=between(0.0, 45.0), metavar="N", default=0.0,
                     help="how far it may turn, about any axis (default: 0)")
    effort = parser.add_argument_group("effort")
    effort.add_argument("--resolution", choices=("realtime", "fast", "accurate"), default="realtime",
                        help="of the whole solid (default: %(default)s)")
    effort.add_argument("--strokes", type=at_least(2, 4000), metavar="N",
                        help="motions on which the whole solid is followed (default: 24, of a tool that only touches "
                             "60; 6 and 30 of a cylinder under an upright tool on its axis, whose mirror images count; "
                             "as many again for each --also)")
    effort.add_argument("--modes", type=at_least(2, 400), metavar="N",
                        help="motions of the tissue that are kept (default: 24, of a tool that only touches 64)")
    effort.add_argument("--bulk-ratio", type=between(1.0, 1000.0), metavar="N",
                        help="bulk modulus at most, over the shear modulus: the more modes and strokes, the stiffer it "
                             "may be (default: 300, of a tool that slides 50)")
    effort.add_argument("--sampling", type=positive, metavar="N", default=6e-3,
                        help="error of the forces of the sampled elements (default: %(default)g)")
    effort.add_argument("--tried", type=at_least(1, 1000), metavar="N", default=3,
                        help="unseen strokes on which the result is tried, at least one with each material (default: "
                             "%(default)s)")
    add_experiment_flags(parser, motion=False)
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments) -> int:
    check_scene(arguments.scene)
    output: Path = arguments.output
    if output.exists() and not arguments.overwrite:
        raise InputError("exists; add --overwrite, or choose another name", file=output)
    if not output.name.endswith(".npz"):
        raise InputError("a reduced solid is a file NAME.reduced.npz; give it that ending", file=output)

    import tissue_sim as ts
    from tissue_sim.fem.reduced.file import POINTS
    from tissue_sim.fem.reduced.reduction import forget_strokes

    material, also = read_material(arguments.material), [read_material(path) for path in arguments.also]
    depth = arguments.depth_mm * 1e-3
    experiment = make_experiment(arguments, ts.Protocol.ramp(depth, points=POINTS), material)
    box = ts.PoseBox(arguments.sideways_mm * 1e-3, depth, math.radians(arguments.turn_deg))
    folder = output.with_name(f"{output.name}.strokes")
    arguments.resume_hint = "the same command goes on with the strokes that are done"
    console = progress_console(quiet=arguments.json)
    with status_of(console, "making the mesh", quiet=arguments.json) as status:
        def tell(stage: str, done: int, of: int, *, note: str = "") -> None:
            status.update(f"{stage}: {done} of {of}{f', {note}' if note else ''}")

        reduced = ts.reduce_solid(
            ts.Model(experiment, material), box, resolution=arguments.resolution, strokes=arguments.strokes,
            modes=arguments.modes, sampling=arguments.sampling, bulk_ratio=arguments.bulk_ratio,
            also=also, tried=arguments.tried, folder=folder, progress=tell)
    ts.write_reduced(reduced, output)
    forget_strokes(folder)
    report = reduced.report
    if arguments.json:
        print_json({**report, "file": str(output)})
        return 0
    print(f"{report['freedoms']} freedoms in {report['modes']} modes, {report['elements_of_all']} elements in "
          f"{report['elements']}, from {report['snapshots']} states of {report['strokes']} strokes")
    several = f", of {report['materials']} materials," if also else ""
    print(f"on {report['tried']} other strokes{several} the force is {100 * report['force_rms_error']:.2g} % off "
          f"(rms; at most {100 * report['force_largest_error']:.2g} %, of {report['force_rms_N']:.3g} N)")
    if report["force_rms_error"] > _POOR:
        print(f"that is much: more strokes (--strokes {2 * report['strokes']}), more modes (--modes "
              f"{2 * report['modes']}) or a smaller box make it better")
    for warning in report.get("warnings", ()):
        print(f"tissue-sim: warning: {warning}", file=sys.stderr)
    print(f"written to {output}")
    return 0
