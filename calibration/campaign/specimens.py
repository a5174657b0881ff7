"""Read the specimens of a campaign and find the specimen of a test."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path

from calibration.campaign.checks import require_positive_if_stated
from calibration.campaign.schema import PRISM, CampaignTable, SpecimenTable, TestTable
from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.experiment.kinds.kind import KINDS
from tissue_sim.parameters import list_field_declarations
from tissue_sim.specimen import SPECIMENS, STANDARD_GRAVITY, Specimen
from tissue_sim.specimen.specimen import add_indefinite_article, make_specimen_from_keys, map_shape_keys_to_required

#: Keys of a prism -> whether the key is required.
_PRISM_KEYS = {"area_mm2": True, "height_mm": True}


def read_specimens_by_name(table: CampaignTable, folder: Path) -> dict[str, Specimen]:
    """Return the specimens of a campaign by name.

    Args:
        table: tables of the campaign file.
        folder: folder to which files of specimens are relative.

    Raises:
        InputError: a missing or duplicate name, sizes that do not match the shape, or an invalid mesh.
    """
    specimens: dict[str, Specimen] = {}
    for i, entry in enumerate(table.specimen):
        field = f"specimen[{i}]"
        if entry.name is None and len(table.specimen) > 1:
            raise InputError("each specimen requires a name if there are several; add a name", field=f"{field}.name")
        name = entry.name if entry.name is not None else "specimen"
        if name in specimens:
            raise InputError(f"names of specimens must be unique; got {name!r} twice", field=f"{field}.name")
        specimens[name] = _read_specimen(entry, name, folder, field)
    return specimens


def _read_specimen(entry: SpecimenTable, name: str, folder: Path, field: str) -> Specimen:
    """Return the specimen of a table ``[[specimen]]``."""
    for key, value in entry.stated_sizes_in_file_units.items():
        require_positive_if_stated(value, f"{field}.{key}", " mm")
    require_positive_if_stated(entry.density_kg_m3, f"{field}.density_kg_m3", " kg/m3")
    if entry.gravity and entry.density_kg_m3 is None:
        raise InputError("gravity = true requires the density of the specimen; add density_kg_m3",
                         field=f"{field}.density_kg_m3")
    shape = entry.shape
    has = _PRISM_KEYS if shape == PRISM else map_shape_keys_to_required(shape)
    given: dict[str, float | str] = {**entry.stated_sizes_in_file_units, **entry.stated_text_values}
    if entry.area_mm2 is not None:
        given["area_mm2"] = entry.area_mm2
    if lacks := [key for key, needed in has.items() if needed and key not in given]:
        raise InputError(f"{add_indefinite_article(shape)} requires {lacks[0]}, which is missing",
                         field=f"{field}.{lacks[0]}")
    if others := [key for key in given if key not in has]:
        raise InputError(f"{add_indefinite_article(shape)} has {next(iter(has))}, not {others[0]}; leave {others[0]} "
                         f"out",
                         field=f"{field}.{others[0]}")
    if shape == PRISM:
        # Homogeneous tests depend on cross-section and height only: a cylinder of the same area is equivalent.
        require_positive_if_stated(area := float(given.pop("area_mm2")), f"{field}.area_mm2", " mm2")
        shape, given = "cylinder", given | {"radius_mm": 1e3 * math.sqrt(area * 1e-6 / math.pi)}
    elif entry.stated_text_values:
        given |= {key: str(folder / entry.stated_text_values[key]) for key in SPECIMENS[shape].paths
                  if key in entry.stated_text_values}
    if not SPECIMENS[shape].is_round:
        # The longest side sets the element size: a wrong unit would create millions of elements.
        for declaration in list_field_declarations(SPECIMENS[shape]).values():
            size = given.get(declaration.key)
            low, high = (end / declaration.factor for end in declaration.bounds)
            if isinstance(size, int | float) and not low <= size <= high:
                raise InputError(f"{declaration.key} must be {low:g} to {high:g}; got {size:g}. Check the unit",
                                 field=f"{field}.{declaration.key}")
    try:
        return make_specimen_from_keys(shape, given, name=name, density=entry.density_kg_m3, height_is=entry.height_is,
                                       gravity=STANDARD_GRAVITY if entry.gravity else 0.0)
    except InputError as error:
        raise error.with_location(field=field) from None


def find_and_check_specimen_or_none(entry: TestTable, specimens: Mapping[str, Specimen], table: CampaignTable,
                                    field: str) -> Specimen | None:
    """Return the specimen of a test; None if the test has no specimen and requires none.

    Args:
        entry: table of the test.
        specimens: specimens of the campaign by name.
        table: tables of the campaign file.
        field: field of the test for messages.

    Raises:
        InputError: the specimen does not exist or does not suit the kind of test and the method.
    """
    if entry.specimen is not None and entry.specimen not in specimens:
        hint = make_hint_with_similar_or_known_words(entry.specimen, specimens) if specimens \
            else "; the file has no [[specimen]]"
        raise InputError(f"no specimen is named {entry.specimen!r}{hint}", field=f"{field}.specimen")
    if entry.specimen is None and len(specimens) > 1:
        raise InputError(f"specimen must name one of {', '.join(specimens)}", field=f"{field}.specimen")
    found = next(iter(specimens.values()), None) if entry.specimen is None else specimens[entry.specimen]
    kind = KINDS[entry.kind]
    stands = kind.has_closed_form_with_weight if table.fit.method == "analytical" else not kind.has_gripped_ends
    if found is not None and found.specific_weight and not stands:
        raise InputError(f"gravity = true requires a specimen that stands under a plate; {entry.kind} does not define "
                         "the direction of gravity. Use a specimen with gravity = false for this test",
                         field=f"{field}.specimen")
    if found is None and kind.closed_form is None:
        raise InputError(f"{entry.kind} requires a specimen; add a [[specimen]] and state its name here",
                         field=f"{field}.specimen")
    if found is None:
        return None
    shape = table.specimen[list(specimens).index(found.name)].shape
    description = f"{found.name!r} is {add_indefinite_article(shape)}"
    if shape == PRISM and kind.closed_form is None:
        raise InputError(f"{entry.kind} requires the shape of the specimen; {description}, of which only the "
                         "cross-section is known. State the shape, such as 'cylinder' with radius_mm",
                         field=f"{field}.specimen")
    if found.is_prism or (table.fit.method != "analytical" and not kind.has_gripped_ends):
        return found
    remedy = f"for {entry.kind} use a specimen such as shape = 'prism' with area_mm2 and height_mm" \
        if kind.has_gripped_ends else "set fit.method = 'inverse_fem'"
    raise InputError(f"{description} without constant cross-section, for which there is no closed form; {remedy}",
                     field=f"{field}.specimen")
