"""Viewer scene of a diagnosis: the model with the found effects, the curve without them, and the measurements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import tissue_sim as ts
from scenes.demo.hidden_effect import HIDEABLE_EFFECTS, NEEDLE, make_model_with_effect
from scenes.demo.hidden_effect_demo import KINDS, build_plain_models
from scenes.viewer.measurement import make_first_cycle_motion_protocol
from scenes.viewer.scene import Scene, read_measurements_by_kind

if TYPE_CHECKING:
    from calibration import Diagnosis, DiagnosisResult


def make_found_effects_scene_with_plain_curve(result: DiagnosisResult, measured: Path) -> Scene:
    """Return the scene of the test that shows the found effects best, with measurements and the curve without effects.

    The test is the needle indentation for effects of the tissue, otherwise the test in which the model without effects
    deviates most.

    Args:
        result: diagnosis of the campaign of the demo.
        measured: folder of the recordings.
    """
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
    if not diagnosis.effects or any(each.category == "tissue" for each in diagnosis.effects):
        return NEEDLE
    tests_of_effects: dict[str, Sequence[str]] = {each.name: each.tests for each in HIDEABLE_EFFECTS}
    tests = {test for each in diagnosis.effects for test in each.tests or tests_of_effects.get(each.name, tuple(KINDS))}
    return max((region for region in diagnosis.regions if region.test in tests),
               key=lambda region: region.before_sigma).test
