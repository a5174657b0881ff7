"""The parameters of a material by name: what a sensitivity is taken with respect to, and a calibration changes.

Names are those of the law and, for the rest, the paths of the material file: ``C10``, ``bulk.bulk_ratio``,
``viscoelastic.terms[0].g``. Values have the unit that the path names, the law's are in SI.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace

from tissue_sim.errors import InputError, nearest
from tissue_sim.material.material import Bulk, Material
from tissue_sim.material.schema import (
    LayerEntry,
    PoroelasticityEntry,
    PronyTermEntry,
    PunctureEntry,
    SofteningEntry,
    effect_parameters,
    entries_of,
)

#: Path of the file -> key -> field, and its unit in SI.
_FIELDS = {
    "viscoelastic.terms": PronyTermEntry.attributes, "layers": LayerEntry.attributes,
    "softening": SofteningEntry.attributes, "poroelasticity": PoroelasticityEntry.attributes,
    "puncture": PunctureEntry.attributes,
}


def parameter_values(material: Material) -> dict[str, float]:
    """Every parameter that the material has, by name."""
    values = dict(material.parameters)
    if material.bulk.value is not None:
        values[f"bulk.{material.bulk.kind}"] = material.bulk.value
    effects = effect_parameters(entries_of(material, {}))
    return values | {name: value for name, (value, _) in effects.items()}


def with_parameter(material: Material, name: str, value: float) -> Material:
    """The material with one parameter changed.

    Raises:
        InputError: the material has no such parameter, or refuses the value.
    """
    known = parameter_values(material)
    if name not in known:
        raise InputError(f"this material has no parameter {name!r}{nearest(name, known)}", field="parameters")
    if name in material.parameters:
        return replace(material, parameters={**material.parameters, name: value})
    path, last = name.rsplit(".", 1)
    if path == "bulk":
        return replace(material, bulk=Bulk(last, value))
    whole = re.sub(r"\[\d+\]", "", path)
    field, unit = _FIELDS[whole][last]

    def change(part):
        return replace(part, **{field: value * unit})

    index = re.search(r"\[(\d+)\]", path)
    match whole:
        case "viscoelastic.terms":
            return replace(material, viscoelastic=replace(
                material.viscoelastic, terms=_changed(material.viscoelastic.terms, int(index[1]), change)))
        case "layers":
            return replace(material, layers=_changed(material.layers, int(index[1]), change))
        case _:
            return replace(material, **{path: change(getattr(material, path))})


def with_parameters(material: Material, values: Mapping[str, float]) -> Material:
    """The material with several parameters changed, by name.

    Raises:
        InputError: an unknown name, or what the material refuses.
    """
    left = dict(values)
    while left:
        refused = None
        for name, value in list(left.items()):
            try:
                material = with_parameter(material, name, value)
                del left[name]
            except InputError as error:
                # It may fit once the others are changed, as one g does when another was lowered.
                refused = refused or (error, len(left))
        if refused and refused[1] == len(left):
            raise refused[0]
    return material


def _changed(parts: tuple, index: int, change: Callable) -> tuple:
    return (*parts[:index], change(parts[index]), *parts[index + 1:])
