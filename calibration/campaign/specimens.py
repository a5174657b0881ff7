"""The specimens of a campaign, and which of them a test is done on."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from calibration.campaign.checks import require_positive
from calibration.campaign.schema import PRISM, CampaignTable, SpecimenTable, TestTable
from tissue_sim.errors import InputError, nearest
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.parameters import declared
from tissue_sim.specimen import SPECIMENS, STANDARD_GRAVITY, Specimen
from tissue_sim.specimen.specimen import keys_of, specimen_of_keys, with_article

#: What a prism of an unknown cross-section states.
_OF_PRISM = {"area_mm2": True, "height_mm": True}


def read_specimens(table: CampaignTable, folder: Path) -> dict[str, Specimen]:
    """The specimens of a campaign by their names.

    Args:
        table: the campaign. folder: that files of specimens are relative to.

    Raises:
        InputError: a name that is missing or there twice, sizes that are no sizes of the shape, a mesh that is none.
    """
    specimens: dict[str, Specimen] = {}
    for i, entry in enumerate(table.specimen):
        field = f"specimen[{i}]"
        if entry.name is None and len(table.specimen) > 1:
            raise InputError("several specimens need a name each, by which the tests call them", field=f"{field}.name")
        name = entry.name if entry.name is not None else "specimen"
        if name in specimens:
            raise InputError(f"the name {name!r} is taken by another specimen; names must be unique",
                             field=f"{field}.name")
        specimens[name] = _specimen(entry, name, folder, field)
    return specimens


def _specimen(entry: SpecimenTable, name: str, folder: Path, field: str) -> Specimen:
    for key, value in entry.sizes.items():
        require_positive(value, f"{field}.{key}", " mm")
    require_positive(entry.density_kg_m3, f"{field}.density_kg_m3", " kg/m3")
    if entry.gravity and entry.density_kg_m3 is None:
        raise InputError("gravity = true needs the density of the specimen; give density_kg_m3",
                         field=f"{field}.density_kg_m3")
    shape = entry.shape
    has = _OF_PRISM if shape == PRISM else keys_of(shape)
    given: dict[str, float | str] = {**entry.sizes, **entry.texts}
    if entry.area_mm2 is not None:
        given["area_mm2"] = entry.area_mm2
    if lacks := [key for key, needed in has.items() if needed and key not in given]:
        raise InputError(f"{with_article(shape)} needs {lacks[0]}, which is missing", field=f"{field}.{lacks[0]}")
    if others := [key for key in given if key not in has]:
        raise InputError(f"{with_article(shape)} has {next(iter(has))}, not {others[0]}; leave it out",
                         field=f"{field}.{others[0]}")
    if shape == PRISM:
        # Homogeneous tests know a specimen by its cross-section and height only.
        require_positive(area := float(given.pop("area_mm2")), f"{field}.area_mm2", " mm2")
        shape, given = "cylinder", given | {"radius_mm": 1e3 * math.sqrt(area * 1e-6 / math.pi)}
    elif entry.texts:
        given |= {key: str(folder / entry.texts[key]) for key in SPECIMENS[shape].paths if key in entry.texts}
    if not SPECIMENS[shape].is_round:
        # The longest side says how large elements are: a wrong unit makes millions of them.
        for what in declared(SPECIMENS[shape]).values():
            size = given.get(what.key)
            low, high = (end / what.factor for end in what.bounds)
            if isinstance(size, int | float) and not low <= size <= high:
                raise InputError(f"{size:g} is none of a specimen ({low:g} to {high:g}); mind the unit of its name",
                                 field=f"{field}.{what.key}")
    try:
        return specimen_of_keys(shape, given, name=name, density=entry.density_kg_m3, height_is=entry.height_is,
                                gravity=STANDARD_GRAVITY if entry.gravity else 0.0)
    except InputError as error:
        raise error.located(field=field) from None


def find_specimen(entry: TestTable, specimens: Mapping[str, Specimen], table: CampaignTable,
                  field: str) -> Specimen | None:
    """The specimen of a test; None where it has none and needs none.

    Raises:
        InputError: no such specimen, or one with which the test is not computed.
    """
    if entry.specimen is not None and entry.specimen not in specimens:
        hint = nearest(entry.specimen, specimens) if specimens else "; the file has no [[specimen]]"
        raise InputError(f"no specimen is named {entry.specimen!r}{hint}", field=f"{field}.specimen")
    if entry.specimen is None and len(specimens) > 1:
        raise InputError(f"name one of the specimens: {', '.join(specimens)}", field=f"{field}.specimen")
    found = next(iter(specimens.values()), None) if entry.specimen is None else specimens[entry.specimen]
    kind = KINDS[entry.kind]
    stands = kind.settles if table.fit.method == "analytical" else not kind.gripped
    if found is not None and found.specific_weight and not stands:
        raise InputError(f"gravity = true is for a specimen that stands under a plate, and {entry.kind} does not say "
                         "how it hangs or lies; give this test a specimen with gravity = false",
                         field=f"{field}.specimen")
    if found is None and kind.closed_form is None:
        raise InputError(f"{entry.kind} is simulated on its specimen; add a [[specimen]] and name it here",
                         field=f"{field}.specimen")
    if found is None:
        return None
    shape = table.specimen[list(specimens).index(found.name)].shape
    what = f"{found.name!r} is {with_article(shape)}"
    if shape == PRISM and kind.closed_form is None:
        raise InputError(f"{entry.kind} is simulated on the shape of its specimen, and {what}, of which nothing but "
                         "the cross-section is known; state its shape, such as 'cylinder' with radius_mm",
                         field=f"{field}.specimen")
    if found.is_prism or (table.fit.method != "analytical" and not kind.gripped):
        return found
    remedy = f"for {entry.kind} give one that has, such as shape = 'prism' with area_mm2 and height_mm" \
        if kind.gripped else "set fit.method = 'inverse_fem', which simulates it"
    raise InputError(f"{what}, which has not one cross-section, and so no closed form; {remedy}",
                     field=f"{field}.specimen")
