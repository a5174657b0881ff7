"""What was found in the viewer: the model with it, the curve of the plain one, and what was measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import tissue_sim as ts
from scenes.demo.hidden_effect import HIDEABLE_EFFECTS, NEEDLE, add_effect
from scenes.demo.hidden_test import KINDS, build_plain_models
from scenes.viewer.measurement import motion
from scenes.viewer.scene import Scene, read_measurements

if TYPE_CHECKING:
    from calibration import Diagnosis, DiagnosisResult


def before_and_after_scene(result: DiagnosisResult, measured: Path) -> Scene:
    """The needle, where it feels what the tissue does, or the test in which the plain model misses most.

    Args:
        result: of the demo's campaign. measured: folder of its recordings.
    """
    diagnosis = result.diagnosis
    test = _shown(diagnosis)
    kind = ts.KINDS[KINDS[test]]
    measurements = read_measurements(sorted(measured.glob("*.csv")), kind.name)
    plain = build_plain_models()[test]
    fitted = {name: diagnosis.fit_before.parameters[name] for name in plain.material.parameters}
    found = plain = replace(plain, material=replace(plain.material, parameters=fitted, name="plain model"))
    if diagnosis.fit_after is not None:
        found = replace(plain, material=ts.load_material(result.output / diagnosis.files["material"]))
    for each in diagnosis.effects:
        # What belongs to the tissue is in the material already.
        around = {number.path.partition("@")[0]: number.value for number in each.parameters
                  if number.path.startswith(("experiment.", "rig."))}
        if around and (not each.tests or test in each.tests):
            found = add_effect(each.name, around, found)
    compared = None
    if diagnosis.effects:
        name = f"without {' and '.join(each.title for each in diagnosis.effects)}"
        tested = replace(plain.experiment, protocol=motion(measurements[kind.name]))
        compared = (name, ts.simulate(replace(plain, experiment=tested), estimate_error=False))
    source = "plain model" if diagnosis.fit_after is None else diagnosis.files["material"]
    return Scene(kind, found.experiment, found.material, source, measurements, rig=found.rig, compared=compared)


def _shown(diagnosis: Diagnosis) -> str:
    """The test to look at."""
    if not diagnosis.effects or any(each.room == "tissue" for each in diagnosis.effects):
        return NEEDLE
    having: dict[str, Sequence[str]] = {each.name: each.tests for each in HIDEABLE_EFFECTS}
    tests = {test for each in diagnosis.effects for test in each.tests or having.get(each.name, tuple(KINDS))}
    return max((region for region in diagnosis.regions if region.test in tests),
               key=lambda region: region.before_sigma).test
