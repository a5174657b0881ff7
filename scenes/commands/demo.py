"""`tissue-sim demo`: measurement, calibration and prediction on a virtual specimen, also with a hidden effect."""

from __future__ import annotations

import os
from argparse import Namespace
from collections.abc import Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from scenes.commands.shared.campaigns import make_campaign_progress_display
from scenes.commands.shared.command import Command, ExitCode
from scenes.commands.shared.console import make_results_console, print_json
from scenes.commands.shared.parsing import InputErrorArgumentParser, add_overwrite_flag, make_integer_parser
from scenes.commands.view import add_page_flags, make_page_options_dict

if TYPE_CHECKING:
    from calibration import Diagnosis, DiagnosisResult
    from scenes.viewer.scene import Scene

#: Default folder of the results.
FOLDER = Path("tissue-sim-demo")
#: Default folder of the results with ``--hidden``.
HIDDEN_FOLDER = Path("tissue-sim-demo-hidden")
#: Random seeds are smaller than this number, so that they are easy to type.
_MAX_SEED = 10_000


def _add_demo_flags(parser: InputErrorArgumentParser) -> None:
    """Add the flags of the hidden effect, the folder, the seed and the page."""
    parser.add_argument("--hidden", action="store_true",
                        help="hide a random effect (or none) in the specimen or the rig, diagnose the measurements, "
                        "then reveal the effect")
    parser.add_argument("-o", dest="output", type=Path, metavar="DIR",
                        help=f"folder of the results (default: {FOLDER} or {HIDDEN_FOLDER}, replaced by every run)")
    parser.add_argument("--seed", type=make_integer_parser(0), metavar="N",
                        help="seed of the measurement noise (default: 0); with --hidden also of the hidden effect "
                        "(default: random)")
    parser.add_argument("--view", action="store_true",
                        help="then show the calibrated indentation test and the measurements on a page in the browser; "
                        "with --hidden the models with and without the found effect")


def _run(arguments: Namespace) -> int:
    """Run the demo, and with ``--view`` show its result."""
    # The demo replaces its default folder without a flag; a folder named by the user needs --overwrite.
    overwrite = arguments.overwrite or arguments.output is None
    if arguments.hidden:
        return _run_hidden_effect_demo(arguments, arguments.output or HIDDEN_FOLDER, overwrite)
    from scenes.demo.virtual_test import run_demo

    output = arguments.output or FOLDER
    answer = run_demo(output, overwrite=overwrite, console=make_results_console(quiet=arguments.json),
                      seed=arguments.seed or 0)
    if arguments.json:
        print_json(answer)
    if arguments.view:
        return _serve_result_page(arguments, output, Path(answer["material_file"]))
    return ExitCode.DONE


def _run_hidden_effect_demo(arguments, output: Path, overwrite: bool) -> int:
    """Run the demo with a hidden effect."""
    import random

    from calibration import Workers
    from scenes.demo.hidden_effect_demo import run_hidden_demo

    seed = random.SystemRandom().randrange(_MAX_SEED) if arguments.seed is None else arguments.seed
    answer = run_hidden_demo(output, seed=seed, overwrite=overwrite,
                             progress=_display_demo_progress(quiet=arguments.json),
                             console=make_results_console(quiet=arguments.json),
                             workers=Workers(min(2, os.cpu_count() or 1)))
    if arguments.json:
        print_json(answer.make_json_object())
    if arguments.view:
        from scenes.viewer.run import run_viewer_page

        return run_viewer_page(make_found_effects_scene_with_plain_curve(answer.result, output / "measured"),
                               answer.result.output, make_page_options_dict(arguments), json=arguments.json)
    return ExitCode.DONE


@contextmanager
def _display_demo_progress(*, quiet: bool):
    """Show the progress inside the block; the display is removed before the results are printed.

    Yields:
        Function that shows the current task.
    """
    with make_campaign_progress_display(quiet=quiet) as progress:
        yield progress.show_task


def _serve_result_page(arguments, output: Path, material_file: Path) -> int:
    """Serve the viewer's page with an indentation of the calibrated material and the measurements."""
    import tissue_sim as ts
    from scenes.demo.specimen import DEPTH, SPECIMEN
    from scenes.viewer.run import run_viewer_page
    from scenes.viewer.scene import Scene, read_measurements_by_kind
    from tissue_sim.experiment.kinds.standard_tests import NEEDLE

    experiment = NEEDLE.experiment(specimen=SPECIMEN, protocol=ts.Protocol.ramp(DEPTH))
    measured = read_measurements_by_kind(sorted((output / "measured").glob("*.csv")), NEEDLE.name)
    scene = Scene(NEEDLE, experiment, ts.load_material(material_file), material_file.name, measured)
    return run_viewer_page(scene, material_file.parent, make_page_options_dict(arguments), json=arguments.json)


def make_found_effects_scene_with_plain_curve(result: DiagnosisResult, measured: Path) -> Scene:
    """Return the scene of the test that shows the found effects best, with measurements and the curve without effects.

    The test is the needle indentation for effects of the tissue, otherwise the test in which the model without effects
    deviates most.

    Args:
        result: diagnosis of the campaign of the demo.
        measured: folder of the recordings.
    """
    import tissue_sim as ts
    from scenes.demo.hidden_effect_demo import KINDS, build_plain_models, make_model_with_effect
    from scenes.viewer.measurement import make_first_cycle_motion_protocol
    from scenes.viewer.scene import Scene, read_measurements_by_kind

    diagnosis = result.diagnosis
    test = _find_test_name_showing_effects_best(diagnosis)
    kind = ts.KINDS[KINDS[test]]
    measurements = read_measurements_by_kind(sorted(measured.glob("*.csv")), kind.name)
    plain = build_plain_models()[test]
    fitted = {name: diagnosis.fit_before.parameters[name] for name in plain.material.parameters}
    found = plain = replace(plain, material=replace(plain.material, parameters=fitted, name="plain model"))
    if diagnosis.fit_after is not None:
        found = replace(plain, material=ts.load_material(result.output / diagnosis.files["material"]))
    for each in diagnosis.effects:
        # Effects of the tissue are part of the material; parameters of experiment and rig are added here.
        values = {number.path.partition("@")[0]: number.value for number in each.parameters
                  if number.path.startswith(("experiment.", "rig."))}
        if values and (not each.tests or test in each.tests):
            found = make_model_with_effect(each.name, values, found)
    compared = None
    if diagnosis.effects:
        name = f"without {' and '.join(each.title for each in diagnosis.effects)}"
        tested = replace(plain.experiment, protocol=make_first_cycle_motion_protocol(measurements[kind.name]))
        compared = (name, ts.simulate(replace(plain, experiment=tested), estimate_error=False))
    source = "plain model" if diagnosis.fit_after is None else diagnosis.files["material"]
    return Scene(kind, found.experiment, found.material, source, measurements, rig=found.rig, compared=compared)


def _find_test_name_showing_effects_best(diagnosis: Diagnosis) -> str:
    """Return the name of the test that shows the found effects best."""
    from scenes.demo.hidden_effect_demo import HIDEABLE_EFFECTS, KINDS, NEEDLE

    if not diagnosis.effects or any(each.category == "tissue" for each in diagnosis.effects):
        return NEEDLE
    tests_of_effects: dict[str, Sequence[str]] = {each.name: each.tests for each in HIDEABLE_EFFECTS}
    tests = {test for each in diagnosis.effects for test in each.tests or tests_of_effects.get(each.name, tuple(KINDS))}
    return max((region for region in diagnosis.regions if region.test in tests),
               key=lambda region: region.before_sigma).test


COMMAND = Command(
    "demo", "measure a virtual specimen, calibrate its material and predict tests that the calibration did not use",
    "tissue-sim demo --hidden --view -o my-demo", _run, needs=(_add_demo_flags, add_overwrite_flag, add_page_flags),
    resume_hint="run the command again with --overwrite")
