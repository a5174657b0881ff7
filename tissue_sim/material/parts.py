"""Parts of a material besides its law: declarations by path, and materials made from numbers by path."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from tissue_sim.errors import InputError, located_and_converted_errors, make_hint_with_similar_or_known_words
from tissue_sim.laws import LAWS
from tissue_sim.material.effect import EFFECTS
from tissue_sim.material.material import (
    Bulk,
    Layer,
    Material,
    find_bulk_declaration_or_none,
    get_law_parameter_declaration,
)
from tissue_sim.material.poroelasticity import Poroelasticity
from tissue_sim.material.puncture import Puncture
from tissue_sim.material.softening import Softening
from tissue_sim.material.viscoelasticity import Prony, PronyTerm
from tissue_sim.parameters import (
    Declaration,
    list_field_declarations,
    parameters,
    split_path_into_names_and_indices,
    with_values,
)

#: Path -> class of the parts that a material has at most once.
SINGLE: dict[str, type] = {"softening": Softening, "poroelasticity": Poroelasticity, "puncture": Puncture}
#: Path -> class of the parts that a material may have several of.
SEVERAL: dict[str, type] = {"viscoelastic.terms": PronyTerm, "layers": Layer}
#: Path of a parameter of a region's law: name of the region, name of the parameter.
_OF_REGION = re.compile(r"regions\.([^.\[\]]+)\.([^.\[\]]+)")
#: Path of one of several parts: path of the list, index.
_NUMBERED = re.compile(r"(.*)\[(?:0|[1-9]\d*)\]")
#: Paths among which messages name the nearest to an unknown path.
_EXAMPLES = (*(f"{place}[0].{name}" for place, kind in SEVERAL.items() for name in list_field_declarations(kind)),
             *(f"{place}.{name}" for place, kind in SINGLE.items() for name in list_field_declarations(kind)),
             "bulk.bulk_ratio")


def find_parameter_path_and_declaration(path: str) -> tuple[str, Declaration]:
    """Return the full path and the declaration of a parameter that a material may have besides its law's parameters.

    Args:
        path: path of the attribute, or as in files: ``viscoelastic.terms[0].tau`` or ``...tau_s``; for a region a
            parameter of its law, ``regions.tumour.C10``.

    Returns:
        The path of the attribute, and the declaration.

    Raises:
        InputError: no material has such a parameter; the message names the nearest.
    """
    if (of_region := _OF_REGION.fullmatch(path)) is not None:
        return path, _find_declaration_in_any_law(of_region[2], path)
    place, _, last = path.rpartition(".")
    if place == "bulk" and (found := find_bulk_declaration_or_none(last)) is not None:
        return path, found
    kind = _find_component_class_or_none(place)
    for name, found in (list_field_declarations(kind) if kind else {}).items():
        if last in (name, found.key):
            return f"{place}.{name}", found
    raise InputError(f"no material has a parameter {path!r}{make_hint_with_similar_or_known_words(path, _EXAMPLES)}",
                     field=path)


def find_region_name_or_none(path: str) -> str | None:
    """Return the name of the mesh region whose parameter a path names; None for other paths."""
    found = _OF_REGION.fullmatch(path)
    return None if found is None else found[1]


def make_material_from_numbers(law: str, parameters: Mapping[str, float], others: Mapping[str, float],
                               bulk: Bulk | None = None,
                               **options: Any) -> Material:
    """Make a material from a law and numbers by path.

    Args:
        law: name of the law.
        parameters: parameters of the law, SI.
        others: path -> value, SI, of all other parameters; a part needs all of its numbers. The law of a region is the
            one with exactly the given parameters; its bulk response is that of the material.
        bulk: bulk response, if no path states it; None: incompressible.
        options: other fields of `Material`: density, name.

    Raises:
        InputError: a part lacks a number, or a number is invalid; with its path.
    """
    response = bulk or Bulk()
    terms: dict[str, dict[int, dict[str, float]]] = {place: {} for place in SEVERAL}
    single: dict[str, dict[str, float]] = {}
    effects: dict[str, dict[str, float]] = {}
    regions: dict[str, dict[str, float]] = {}
    for path, value in others.items():
        *place, last = split_path_into_names_and_indices(find_parameter_path_and_declaration(path)[0])
        match place:
            case ["bulk"]:
                response = Bulk(str(last), value)
            case ["regions", name]:
                regions.setdefault(str(name), {})[str(last)] = value
            case ["effects", name]:
                effects.setdefault(str(name), {})[str(last)] = value
            case [*outer, int(index)]:
                terms[".".join(map(str, outer))].setdefault(index, {})[str(last)] = value
            case _:
                single.setdefault(str(place[0]), {})[str(last)] = value
    parts: dict[str, Any] = {place: _make_component(SINGLE[place], place, numbers) for place, numbers in single.items()}
    prony = tuple(_make_components_in_index_order(terms, "viscoelastic.terms"))
    if prony:
        with located_and_converted_errors(field="viscoelastic"):
            parts["viscoelastic"] = Prony(prony)
    added = {name: _make_component(EFFECTS[name], f"effects.{name}", numbers) for name, numbers in effects.items()}
    return Material(law, parameters, response, layers=tuple(_make_components_in_index_order(terms, "layers")),
                    effects=added, regions={name: _make_region_material_by_parameter_names(name, numbers, response)
                                            for name, numbers in regions.items()}, **parts, **options)


def with_changed_or_added_parameters(material: Material, values: Mapping[str, float]) -> Material:
    """Return a copy of a material with changed parameters; components that the material lacks are added.

    Args:
        material: material to change.
        values: path -> value, SI; a new part needs all of its numbers.

    Raises:
        InputError: no material has the path, a part lacks a number, or a number is invalid.
    """
    known = parameters(material)
    new = {path: value for path, value in values.items() if path not in known}
    material = with_values(material, {path: value for path, value in values.items() if path in known})
    if not new:
        return material
    several: dict[str, tuple] = {"viscoelastic.terms": getattr(material.viscoelastic, "terms", ()),
                                 "layers": material.layers}

    def renumber_path_after_existing_terms(path: str) -> str:
        """Return a path of a new component with its index counted from the end of the present components."""
        place, _, last = find_parameter_path_and_declaration(path)[0].rpartition(".")
        if (numbered := _NUMBERED.fullmatch(place)) is None:
            return path
        return f"{numbered[1]}[{int(place[len(numbered[1]) + 1:-1]) - len(several[numbered[1]])}].{last}"

    made = make_material_from_numbers("neo_hooke", {"C10": 1.0},
                                      {renumber_path_after_existing_terms(path): value for path, value in new.items()},
                                      material.bulk)
    changes: dict[str, Any] = {name: part for name in SINGLE if (part := getattr(made, name)) is not None}
    if made.viscoelastic is not None:
        series = material.viscoelastic or made.viscoelastic
        changes["viscoelastic"] = replace(series, terms=(*several["viscoelastic.terms"], *made.viscoelastic.terms))
    if any(path.startswith("bulk.") for path in new):
        changes["bulk"] = made.bulk
    return replace(material, layers=(*material.layers, *made.layers), effects={**material.effects, **made.effects},
                   regions={**material.regions, **made.regions}, **changes)


def _find_component_class_or_none(place: str) -> type | None:
    """Return the class of the component at a path, such as ``layers[0]``; None if no component has the path."""
    numbered = _NUMBERED.fullmatch(place)
    if numbered:
        return SEVERAL.get(numbered[1])
    if place.startswith("effects."):
        return EFFECTS.get(place.removeprefix("effects."))
    return SINGLE.get(place)


def _find_declaration_in_any_law(name: str, path: str) -> Declaration:
    """Return the declaration of a parameter that at least one registered law has."""
    for law in LAWS.values():
        if name in law.parameters:
            return get_law_parameter_declaration(law, name)
    known = dict.fromkeys(each for law in LAWS.values() for each in law.parameters)
    raise InputError(f"no law has a parameter {name!r}{make_hint_with_similar_or_known_words(name, known)}", field=path)


def _make_region_material_by_parameter_names(name: str, numbers: Mapping[str, float], bulk: Bulk) -> Material:
    """Make the material of a region from its numbers; its law is the registered one with exactly these parameters."""
    law = next((name for name, law in LAWS.items() if set(law.parameters) == set(numbers)), None)
    if law is None:
        raise InputError(f"no law has the parameters {', '.join(numbers)} and no others; give all of one law",
                         field=f"regions.{name}")
    try:
        return Material(law, numbers, bulk)
    except InputError as refused:
        raise InputError(refused.problem, field=f"regions.{name}.{refused.field}") from None


def _make_components_in_index_order(terms: Mapping[str, Mapping[int, Mapping[str, float]]],
                                    place: str) -> Iterator[Any]:
    """Yield the components of a list in the order of their indices, which must be 0, 1, ... without gaps."""
    numbered = terms[place]
    if sorted(numbered) != list(range(len(numbered))):
        raise InputError(f"must be numbered from 0 without gaps, as {place}[0], {place}[1].", field=place)
    return (_make_component(SEVERAL[place], f"{place}[{index}]", numbered[index]) for index in range(len(numbered)))


def _make_component(kind: type, place: str, numbers: Mapping[str, float]) -> Any:
    """Make a component of a class from its numbers; errors name the path of the number."""
    try:
        return kind(**numbers)
    except InputError as refused:
        raise InputError(refused.problem, field=f"{place}.{refused.field}") from None
    except TypeError:
        missing = next((name for name in list_field_declarations(kind) if name not in numbers), None)
        if missing is None:
            raise
        raise InputError("is missing; add it", field=f"{place}.{missing}") from None
