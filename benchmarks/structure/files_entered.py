"""Count the source files of this repository that run between the call of a user and its result.

    python -m benchmarks files_entered [calibrate] [solid] [multirate] [--names] [--json]

- `calibrate`: from `calibration.calibrate` with the campaign of the demonstration to its written material files.
- `solid`: one step of a `Simulator` on a solid.
- `multirate`: one step of a `MultiRateTissue` on the same solid; its bulk runs in this process.

A file counts if at least one of its functions is called (`sys.setprofile`), so imports do not count, nor do Taichi
kernels, which run compiled.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from benchmarks import ROOT

#: Packages whose files are counted.
PACKAGES = ("tissue_sim", "calibration", "haptics", "scenes")
#: Depth of each step of the tool, m.
STEP = 1e-4
#: Steps before the measured one, so that the tool is in contact and all tables exist.
FIRST_STEPS = 5
#: Simulated delays of a model and of a tangent of the bulk, s.
DELAYS = (6e-3, 30e-3)


def list_files_entered(call: Callable[[], object]) -> list[str]:
    """Return the paths, relative to the repository, of the source files in which at least one function is called."""
    files: set[str] = set()

    def collect_file_of_call(frame, event, argument) -> None:
        """Store the file of a called function."""
        if event == "call":
            files.add(frame.f_code.co_filename)

    sys.setprofile(collect_file_of_call)
    try:
        call()
    finally:
        sys.setprofile(None)
    inside = {Path(file).relative_to(ROOT).as_posix() for file in files if file.startswith(f"{ROOT}{os.sep}")}
    return sorted(file for file in inside if file.startswith(PACKAGES))


def list_files_of_calibration() -> list[str]:
    """Return the files between the campaign of the demonstration and its material files."""
    from rich.console import Console

    from calibration import calibrate
    from scenes.demo.virtual_test import run_demo

    with tempfile.TemporaryDirectory() as folder:
        demo = Path(folder) / "demo"
        run_demo(demo, overwrite=True, console=Console(quiet=True), seed=0)
        return list_files_entered(lambda: calibrate([demo / "campaign.toml"], Path(folder) / "results", figures=False))


def make_model():
    """Return a ball that is pressed into a soft cylinder with friction."""
    import tissue_sim as ts

    experiment = ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.ramp(3e-3, 3), tool=ts.Tool("round", radius=8e-3),
                               friction=0.3)
    return ts.Model(experiment, ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("bulk_ratio", 1e3)))


def list_files_of_step(tissue, time_step: float = 1e-3) -> list[str]:
    """Return the files of one step of a tissue after `FIRST_STEPS` steps into it."""
    from tissue_sim.pose import Pose

    for number in range(FIRST_STEPS):
        tissue.step(Pose((0.0, 0.0, -STEP * number)), time_step)
    return list_files_entered(lambda: tissue.step(Pose((0.0, 0.0, -STEP * FIRST_STEPS)), time_step))


def list_files_of_solid_step() -> list[str]:
    """Return the files of one step of a simulator on a solid."""
    from coarse_solid import make_coarse_solid

    import tissue_sim as ts

    model = make_model()
    return list_files_of_step(ts.Simulator(model, solver="solid", mesh=make_coarse_solid(model).mesh))


def list_files_of_multirate_step() -> list[str]:
    """Return the files of one multirate step."""
    from coarse_solid import make_coarse_solid
    from delayed_bulk import DelayedBulkLink

    from tissue_sim.fem.solid.linearisation import SolidLineariser
    from tissue_sim.realtime.multirate import MultiRateTissue

    model = make_model()
    link = DelayedBulkLink(SolidLineariser(make_coarse_solid(model)), *DELAYS)
    return list_files_of_step(MultiRateTissue(model, link=link))


#: Name of each case -> function that lists its files.
CASES = {"calibrate": list_files_of_calibration, "solid": list_files_of_solid_step,
         "multirate": list_files_of_multirate_step}


def main() -> int:
    """Run the command line. Returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks files_entered", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"{', '.join(CASES)} (default: all)")
    parser.add_argument("--names", action="store_true", help="list the files")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args()
    unknown = set(arguments.cases) - set(CASES)
    if unknown:
        parser.error(f"CASE must be one of {', '.join(CASES)}; got {', '.join(sorted(unknown))}.")
    found = {name: CASES[name]() for name in arguments.cases or CASES}
    if arguments.json:
        print(json.dumps(found))
        return 0
    for name, files in found.items():
        print(f"{name}: {len(files)} files")
        for file in files if arguments.names else ():
            print(f"  {file}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
