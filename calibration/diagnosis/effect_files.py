"""Write the effects that a diagnosis found into files that other commands read.

Tissue effects go into a material file, effects of the rig into rig files, contact and geometry into a campaign file.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec

from calibration.campaign.campaign import Campaign, Test
from calibration.campaign.schema import replace_mesh_profile_and_rig_paths, resolve_path_to_text
from calibration.diagnosis.diagnosis import Diagnosis, FoundEffect
from calibration.diagnosis.evidence import FitEvidence
from calibration.fit.material_file import make_material_file_of_fit
from calibration.fit.result import CalibrationResult
from calibration.output_folder import list_possible_diagnosis_result_paths
from tissue_sim.decode import format_toml, read_toml_dict
from tissue_sim.experiment.contact_law import AS_TOOL
from tissue_sim.files import write_text
from tissue_sim.laws import LAWS
from tissue_sim.material.file import MaterialFile, write_material_file
from tissue_sim.parameters import convert_to_file_values, with_values
from tissue_sim.rig.file import write_rig
from tissue_sim.rig.rig import Rig

#: Name of the campaign file that includes the effects found.
CAMPAIGN_FILE = "diagnosed.toml"


def list_all_possible_diagnosis_paths(campaign: Campaign, folder: Path) -> list[Path]:
    """Return the paths of all files that the diagnosis of a campaign may write.

    Material files of all laws are included, because an effect may require a more general law than the campaign states.
    """
    return [*list_possible_diagnosis_result_paths(campaign, folder),
            *(folder / f"{law}.material.json" for law in sorted(LAWS)), folder / CAMPAIGN_FILE,
            folder / "rig.rig.json",
            *(folder / _make_rig_file_name_of_test_number(number) for number in range(len(campaign.tests)))]


def write_effect_files_and_get_diagnosis(diagnosis: Diagnosis, after: FitEvidence | None, folder: Path) -> Diagnosis:
    """Write a material file, rig files and a campaign file that include the effects found.

    Files of an earlier calibration in the folder stay unchanged.

    Args:
        diagnosis: the result of the diagnosis.
        after: the fit with the effects found; None if no effect was found, in which case no file is written.
        folder: folder of the results.

    Returns:
        The diagnosis with the names of the written files in `files` and in each effect's `written_to`.
    """
    if after is None or diagnosis.fit_after is None:
        return diagnosis
    files = {}
    name = f"{after.law_name}.material.json"
    write_material_file(_make_material_file_with_effects(diagnosis, after, folder), folder / name)
    files["material"] = name
    rigs = {test.name: _copy_rig_with_fitted_values(after, test) for test in after.diagnosis_data.tests
            if test.experiment is not None}
    if any(effect.category == "rig" for effect in diagnosis.effects):
        if len({json.dumps(convert_to_file_values(rig), sort_keys=True) for rig in rigs.values()}) == 1:
            write_rig(next(iter(rigs.values())), folder / "rig.rig.json")
            files["rig"] = "rig.rig.json"
        else:
            for number, test in enumerate(after.campaign.tests):
                if test.name in rigs:
                    write_rig(rigs[test.name], folder / _make_rig_file_name_of_test_number(number))
                    files[f"rig of {test.name}"] = _make_rig_file_name_of_test_number(number)
    write_text(folder / CAMPAIGN_FILE, _format_campaign_with_found_effects(diagnosis, after))
    files["campaign"] = CAMPAIGN_FILE
    file_of = {"tissue": name, "rig": files.get("rig", "rig files of the tests"), "population": name}
    effects = [msgspec.structs.replace(effect, written_to=(
        CAMPAIGN_FILE if _is_effect_of_single_tests(effect) and effect.category == "tissue"
        else file_of.get(effect.category, CAMPAIGN_FILE))) for effect in diagnosis.effects]
    return msgspec.structs.replace(diagnosis, effects=effects, files=files)


def _is_effect_of_single_tests(effect: FoundEffect) -> bool:
    """Return whether an effect acts only in the tests that it names, and not in all tests."""
    return bool(effect.tests)


def _make_rig_file_name_of_test_number(number: int) -> str:
    """Return the name of the rig file of a test; `number` is the index of the test from 0."""
    return f"test_{number + 1}.rig.json"


def _make_material_file_with_effects(diagnosis: Diagnosis, after: FitEvidence, folder: Path) -> MaterialFile:
    """Return the material file of the fitted law and tissue effects, with the diagnosis in its provenance."""
    fit = diagnosis.fit_after
    assert fit is not None
    # An effect of a single test or session is not a property of the tissue: the material file has it switched off.
    switched_off = {number.path: number.absent for effect in diagnosis.effects if _is_effect_of_single_tests(effect)
                    for number in effect.parameters if number.absent is not None}
    fit = msgspec.structs.replace(fit, parameters={**fit.parameters, **switched_off})
    result = CalibrationResult(after.campaign, (fit,), (), diagnosis.message, folder, "", None, "estimated")
    file = make_material_file_of_fit(fit, result, after.measured, "inverse FEM with a diagnosed effect")
    added = [{"name": effect.name, "room": effect.category, "tests": effect.tests,
              "parameters": {number.path: number.value for number in effect.parameters}}
             for effect in diagnosis.effects]
    provenance = file.provenance
    assert provenance is not None
    settings = {**(provenance.settings or {}), "diagnosis": {
        "campaign": diagnosis.campaign, "verdict": diagnosis.verdict, "effects": added}}
    return msgspec.structs.replace(file, provenance=msgspec.structs.replace(provenance, settings=settings))


def _copy_rig_with_fitted_values(after: FitEvidence, test: Test) -> Rig:
    """Return a copy of the rig of a test with the fitted values of its parameters."""
    space = after.problem.space
    values = {each.path.removeprefix("rig."): after.parameter_values[each.name] for each in space.unknowns
              if each.path.startswith("rig.") and each.applies_to_recording(test.name, None) and each.recording is None}
    return with_values(test.rig, values) if values else test.rig


def _format_campaign_with_found_effects(diagnosis: Diagnosis, after: FitEvidence) -> str:
    """Return the text of a campaign (TOML) in which the effects found are additional unknowns with start values."""
    campaign = after.campaign
    folder = campaign.path.parent.resolve()
    content = replace_mesh_profile_and_rig_paths(read_toml_dict(campaign.path, "a campaign (TOML)"), folder,
                                                 resolve_path_to_text)
    for table in (content.get("defaults", {}), *content["test"]):
        if "recordings" in table:
            table["recordings"] = [str(folder / name) for name in table["recordings"]]
    for table, test in zip(content["test"], campaign.tests, strict=True):
        if test.experiment is not None and test.experiment.contact_laws:
            table["contact_laws"] = {name: convert_to_file_values(law) for name,
                                     law in test.experiment.contact_laws.items()}
        if test.experiment is not None and test.experiment.friction_base == AS_TOOL:
            # Friction of both plates was added: the test is no longer a lubricated compression.
            friction = next(each for each in after.problem.space.unknowns
                            if each.path == "experiment.friction" and each.applies_to_recording(test.name, None))
            table |= {"kind": "friction_compression", "friction": after.parameter_values[friction.name],
                      "friction_base": AS_TOOL}
    densities = {test.experiment.specimen.name: test.experiment.specimen.density for test in campaign.tests
                 if test.experiment is not None}
    for table in content.get("specimen", []):
        density = densities.get(table.get("name", "specimen"))
        if density is not None:
            table["density_kg_m3"] = density
    fit, settings = content["fit"], campaign.fit
    fit["laws"] = [after.law_name]
    start: dict[str, dict[str, Any]] = {"start": {}, "fixed": {}, "bounds": {}, "scope": {}}
    for path, named in settings.named.items():
        factor = named.declaration.factor
        if path in settings.bounds:
            (low, high), (least, most) = settings.bounds[path], named.declaration.bounds
            start["bounds"][path] = [max(low, least) / factor, min(high, most) / factor]
        if named.scope != "shared":
            start["scope"][path] = list(named.scope) if isinstance(named.scope, tuple) else named.scope
    for each in after.problem.space.unknowns:
        kind = "fixed" if each.name in after.problem.space.fixed else "start"
        start[kind].setdefault(each.path, after.parameter_values[each.name] / each.declaration.factor)
    fit.update({key: table for key, table in start.items() if table})
    words = "; ".join(effect.title for effect in diagnosis.effects)
    return f"# {campaign.path.name} with the effects that a diagnosis found: {words}.\n{format_toml(content)}"
