"""What a calibration assumed about gravity: the sag of each specimen, and one sentence for reports and files."""

from __future__ import annotations

from dataclasses import replace

from calibration.campaign.campaign import Campaign
from calibration.fit.fit import Fit
from tissue_sim.closed_form.column import Column
from tissue_sim.errors import InputError
from tissue_sim.laws import Law, find_law
from tissue_sim.specimen import STANDARD_GRAVITY, Specimen

#: Of water, kg/m3: what a specimen of unknown density is taken for when its sag is estimated.
WATER_DENSITY = 1000.0


def sags(law: Law, values, campaign: Campaign) -> dict[str, float]:
    """Specimen that weighs -> its sag with this law, mm; without those that it does not carry."""
    found = {specimen.name: _sag(specimen, law, values) for specimen in _standing(campaign)
             if specimen.specific_weight}
    return {name: 1e3 * sag for name, sag in found.items() if sag is not None}


def statement(campaign: Campaign, fit: Fit) -> str:
    """What was assumed about gravity in the compression tests of a campaign, sags with this fit; for people."""
    alike: dict[str, list[str]] = {}
    for specimen in _standing(campaign):
        alike.setdefault(_sentence(specimen, fit), []).append(specimen.name)
    several = sum(map(len, alike.values())) > 1
    sentences = [f"Self-weight{' of ' if several else ''}{', '.join(names) if several else ''}{words}"
                 for words, names in alike.items()]
    return " ".join(sentences) or "Self-weight is not included."


def _sentence(specimen: Specimen, fit: Fit) -> str:
    """What follows on "Self-weight of" the specimen."""
    height = f"{specimen.height * 1e3:.4g} mm as {specimen.height_is}"
    if specimen.specific_weight:
        sag = fit.sag_mm.get(specimen.name)
        settled = f"sag {sag:.3g} mm" if sag is not None else f"which {fit.law} does not carry"
        return (f": {specimen.density:g} kg/m3 at {specimen.gravity:g} m/s2, settled before the "
                f"test; height {height}, {settled}.")
    density = specimen.density or WATER_DENSITY
    sag = _sag(replace(specimen, density=density, gravity=STANDARD_GRAVITY), find_law(fit.law), fit.parameters)
    of_water = "" if specimen.density else " (water)"
    would = "" if sag is None else f"; standing at {density:g} kg/m3{of_water} it would sag {sag * 1e3:.2g} mm"
    return f" is not included: the height, {height}, is taken for the undeformed one{would}."


def _standing(campaign: Campaign) -> list[Specimen]:
    """Specimens that a plate compresses, each once."""
    return list(dict.fromkeys(test.specimen for test in campaign.tests
                              if test.kind.settles and test.specimen is not None))


def _sag(specimen: Specimen, law: Law, values) -> float | None:
    """m; None where the law does not carry the specimen."""
    try:
        return Column(specimen).settle(law, values).sag
    except InputError:
        return None
