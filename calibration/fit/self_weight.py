"""Sag of the specimens under self-weight, and a sentence on the assumptions of a calibration about gravity."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

from calibration.campaign.campaign import Campaign
from calibration.fit.fit import Fit
from calibration.fit.typical_material import get_shared_and_population_mean_material
from tissue_sim.closed_form.column import Column
from tissue_sim.errors import InputError
from tissue_sim.laws import find_law
from tissue_sim.specimen import STANDARD_GRAVITY, Specimen

#: Density of water, kg/m3, assumed for the sag of a specimen of unknown density.
WATER_DENSITY = 1000.0


def compute_specimen_sags_mm(fit: Fit, campaign: Campaign) -> dict[str, float]:
    """Return specimen with self-weight -> its sag with the fitted law, mm.

    Specimens without equilibrium under their weight are omitted.
    """
    found = {specimen.name: _compute_sag_or_none_without_equilibrium(specimen, fit, campaign)
             for specimen in _list_specimens_in_frictionless_compression(campaign) if specimen.specific_weight}
    return {name: 1e3 * sag for name, sag in found.items() if sag is not None}


def describe_self_weight(campaign: Campaign, fit: Fit) -> str:
    """Describe the assumptions of a campaign about gravity, with the sag of compressed columns for a fit."""
    alike: dict[str, dict[str, float | None]] = {}
    columns = _list_specimens_in_frictionless_compression(campaign)
    for specimen in dict.fromkeys([*columns, *(test.specimen for test in campaign.tests if test.specimen is not None
                                               and test.specimen.specific_weight)]):
        words, sag = _make_self_weight_sentence_and_sag_mm(specimen, fit, campaign, column=specimen in columns)
        alike.setdefault(words, {})[specimen.name] = sag
    several = sum(map(len, alike.values())) > 1
    sentences = [f"Self-weight{' of ' if several else ''}{', '.join(found) if several else ''}"
                 f"{words.format(*(_format_sag_range(found.values(), digits) for digits in (2, 3)))}"
                 for words, found in alike.items()]
    return " ".join(sentences) or "Self-weight is not included."


def _make_self_weight_sentence_and_sag_mm(specimen: Specimen, fit: Fit, campaign: Campaign, *,
                                          column: bool) -> tuple[str, float | None]:
    """Return the sentence after "Self-weight of NAME", with placeholders for the sag in two or three digits.

    Args:
        specimen: specimen.
        fit: fit.
        campaign: campaign.
        column: whether plates compress the specimen between frictionless faces, so that its sag has a closed form.

    Returns:
        Sentence, and the sag, mm; None: unknown.
    """
    height = f"{specimen.height * 1e3:.4g} mm as {specimen.height_is}"
    if specimen.specific_weight:
        sag = fit.sag_mm.get(specimen.name)
        # Other boundary conditions have no closed form of the sag.
        settled = ", sag {1} mm" if sag is not None else f", which {fit.law} does not carry" if column else ""
        return (f": {specimen.density:g} kg/m3 at {specimen.gravity:g} m/s2, settled before the "
                f"test; height {height}{settled}."), sag
    density = specimen.density or WATER_DENSITY
    sag = _compute_sag_or_none_without_equilibrium(replace(specimen, density=density, gravity=STANDARD_GRAVITY), fit,
                                                   campaign)
    of_water = "" if specimen.density else " (water)"
    would = "" if sag is None else f"; standing at {density:g} kg/m3{of_water} it would sag {{0}} mm"
    return (f" is not included: the height, {height}, is taken for the undeformed one{would}.",
            None if sag is None else 1e3 * sag)


def _format_sag_range(sags: Collection[float | None], digits: int) -> str:
    """Format the sags of several specimens, such as ``2.8`` or ``2.5 to 3.1``."""
    known = sorted(sag for sag in sags if sag is not None)
    return " to ".join(dict.fromkeys(f"{sag:.{digits}g}" for sag in known[:1] + known[-1:]))


def _list_specimens_in_frictionless_compression(campaign: Campaign) -> list[Specimen]:
    """Return the specimens that a plate compresses between frictionless faces, without repetition."""
    return list(dict.fromkeys(test.specimen for test in campaign.tests
                              if test.kind.has_closed_form_with_weight and test.specimen is not None
                              and test.specimen.is_prism))


def _compute_sag_or_none_without_equilibrium(specimen: Specimen, fit: Fit, campaign: Campaign) -> float | None:
    """Return the sag of a specimen, m; None without equilibrium or with unknown parameters."""
    law, material = find_law(fit.law), get_shared_and_population_mean_material(fit)
    values = {path: _find_specimen_law_parameter_or_typical(path, specimen, fit, campaign,
                                                            material.parameters.get(path))
              for path in law.parameters}
    try:
        if None in values.values():
            return None
        return Column(specimen).settle(law, law.convert_parameters_to_array(values)).sag
    except InputError:
        return None


def _find_specimen_law_parameter_or_typical(path: str, specimen: Specimen, fit: Fit, campaign: Campaign,
                                            typical: float | None) -> float | None:
    """Return a parameter of the law for a specimen: its own, that of its first test or recording, or the shared one."""
    tests = [test.name for test in campaign.tests if test.specimen is not None and test.specimen.name == specimen.name]
    for mark in (specimen.name, *tests):
        if f"{path}@{mark}" in fit.parameters:
            return fit.parameters[f"{path}@{mark}"]
    return next((value for name, value in fit.parameters.items()
                 if any(name.startswith(f"{path}@{test}/") for test in tests)), typical)
