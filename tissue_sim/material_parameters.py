"""The parameters of a material by name: what a sensitivity is taken with respect to, and a calibration changes.

Names are those of the law and, for the rest, the paths of the material file: ``C10``, ``bulk.bulk_ratio``,
``viscoelastic.terms[0].g``. Values have the unit that the path names, the law's are in SI.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace

from tissue_sim.errors import InputError, nearest
from tissue_sim.material import Bulk, Material

#: Path of the file -> field, and its unit in SI.
_FIELDS = {
    "viscoelastic.terms": {"g": ("g", 1.0), "tau_s": ("tau", 1.0)},
    "layers": {"thickness_mm": ("thickness", 1e-3), "modulus_ratio": ("ratio", 1.0)},
    "softening": {"loss": ("loss", 1.0), "modulus_Pa": ("modulus", 1.0), "share": ("share", 1.0)},
    "poroelasticity": {"phi": ("phi", 1.0), "diffusivity_mm2_per_s": ("diffusivity", 1e-6)},
    "puncture": {"depth_mm": ("depth", 1e-3), "drop": ("drop", 1.0)},
}


def parameter_values(material: Material) -> dict[str, float]:
    """Every parameter that the material has, by name."""
    values = dict(material.parameters)
    if material.bulk.value is not None:
        values[f"bulk.{material.bulk.kind}"] = material.bulk.value
    terms = material.viscoelastic.terms if material.viscoelastic else ()
    for path, part in [*((f"viscoelastic.terms[{i}]", term) for i, term in enumerate(terms)),
                       *((f"layers[{i}]", layer) for i, layer in enumerate(material.layers)),
                       ("softening", material.softening), ("poroelasticity", material.poroelasticity),
                       ("puncture", material.puncture)]:
        if part is not None:
            for name, (field, unit) in _FIELDS[re.sub(r"\[\d+\]", "", path)].items():
                values[f"{path}.{name}"] = getattr(part, field) / unit
    return values


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


def _changed(parts: tuple, index: int, change: Callable) -> tuple:
    return (*parts[:index], change(parts[index]), *parts[index + 1:])
