"""Parameters of a material beside those of its law, as a campaign names them in ``[fit]``."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from calibration.campaign.schema import FitTable
from tissue_sim.decode import decode
from tissue_sim.errors import InputError, nearest
from tissue_sim.laws import LAWS
from tissue_sim.material.material import BULK_RATIOS, Bulk
from tissue_sim.material.schema import (
    LayerEntry,
    PoroelasticityEntry,
    PunctureEntry,
    SofteningEntry,
    ViscoelasticEntry,
    build_effects,
)

_ENTRIES = {"viscoelastic": ViscoelasticEntry, "softening": SofteningEntry, "layers": tuple[LayerEntry, ...],
            "poroelasticity": PoroelasticityEntry, "puncture": PunctureEntry}
#: Last part of a path -> bounds where the campaign states none.
_BOUNDS = {
    "g": (1e-6, 0.99), "tau_s": (1e-4, 1e6), "loss": (1e-6, 0.99), "modulus_Pa": (0.0, 1e9), "share": (1e-3, 1e3),
    "thickness_mm": (1e-3, 1e3), "modulus_ratio": (1e-3, 1e3), "phi": (1e-6, 0.99),
    "diffusivity_mm2_per_s": (1e-6, 1e6), "depth_mm": (0.0, 1e3), "drop": (0.0, 0.99), "bulk_ratio": BULK_RATIOS,
    "K_Pa": (1.0, 1e12),
}
_PATH = re.compile(r"(viscoelastic\.terms\[(?:0|[1-9]\d*)\]|softening|layers\[(?:0|[1-9]\d*)\]|poroelasticity|puncture"
                   r"|bulk)\.(\w+)")


def is_effect(name: str) -> bool:
    """Whether it is a path into the material and not a parameter of a law."""
    return "." in name


def effect_bounds(name: str) -> tuple[float, float]:
    """Bounds of a path where the campaign states none."""
    return _BOUNDS[name.rsplit(".", 1)[1]]


def build_effect_parts(values: Mapping[str, float], bulk: Bulk) -> dict[str, Any]:
    """Keyword arguments of `Material` that the paths in `values` describe, with the bulk response.

    Raises:
        InputError: a part that lacks a value or refuses one, with its path.
    """
    content: dict[str, Any] = {}
    for name, value in values.items():
        if not is_effect(name):
            continue
        place, key = _PATH.fullmatch(name).groups()
        if place == "bulk":
            bulk = Bulk(key, value)
        elif place.startswith("viscoelastic"):
            terms = content.setdefault("viscoelastic", {"terms": {}})["terms"]
            terms.setdefault(int(place[place.index("[") + 1:-1]), {})[key] = value
        elif place.startswith("layers"):
            content.setdefault("layers", {}).setdefault(int(place[place.index("[") + 1:-1]), {})[key] = value
        else:
            content.setdefault(place, {})[key] = value
    if "viscoelastic" in content:
        content["viscoelastic"]["terms"] = _in_order(content["viscoelastic"]["terms"], "viscoelastic.terms")
    if "layers" in content:
        content["layers"] = _in_order(content["layers"], "layers")
    entries = {name: decode(content[name], kind, name) if name in content else None
               for name, kind in _ENTRIES.items()}
    return {**build_effects(entries), "bulk": bulk}


def _in_order(parts: Mapping[int, Any], place: str) -> list[Any]:
    if sorted(parts) != list(range(len(parts))):
        raise InputError(f"its parts are numbered from 0 without gaps, as {place}[0], {place}[1]", field=place)
    return [parts[i] for i in range(len(parts))]


def check_effects(table: FitTable) -> tuple[str, ...]:
    """The paths that start and fixed name, which make the material's parts.

    Raises:
        InputError: a path that no material has, or a part that is incomplete or refuses its values; with the field.
    """
    law_names = {parameter for law in table.laws for parameter in LAWS[law].parameters}
    stated: dict[str, float] = {}
    for key in ("start", "fixed"):
        for name, value in getattr(table, key).items():
            if name in law_names:
                continue
            match = _PATH.fullmatch(name)
            if match is None and not is_effect(name):
                continue  # the check of the laws' names says more
            if match is None or match[2] not in _BOUNDS:
                known = [f"viscoelastic.terms[0].{last}" for last in ("g", "tau_s")]
                known += ["softening.loss", "softening.share", "layers[0].modulus_ratio", "layers[0].thickness_mm",
                          "poroelasticity.phi", "poroelasticity.diffusivity_mm2_per_s", "bulk.bulk_ratio"]
                raise InputError(f"no material has a parameter {name!r}{nearest(name, known)}",
                                 field=f"fit.{key}.{name}")
            stated[name] = value
    for key in ("prior", "bounds"):
        for name in getattr(table, key):
            if is_effect(name) and name not in stated:
                raise InputError(f"give {name} a start too (or fix it), so that the material has it",
                                 field=f"fit.{key}.{name}")
    for name, value in stated.items():
        widest = effect_bounds(name)
        low, high = table.bounds.get(name, widest)
        if low < widest[0] or high > widest[1]:
            raise InputError(f"[{low:g}, {high:g}] is wider than what a material may have; give bounds within "
                             f"[{widest[0]:g}, {widest[1]:g}]", field=f"fit.bounds.{name}")
        if not low <= value <= high:
            field = "start" if name in table.start else "fixed"
            raise InputError(f"{value:g} is outside its bounds [{low:g}, {high:g}]", field=f"fit.{field}.{name}")
    bulk = [name for name in stated if name.startswith("bulk.")]
    if bulk and (table.bulk_ratio is not None or len(bulk) > 1):
        other = "fit.bulk_ratio" if table.bulk_ratio is not None else bulk[0]
        raise InputError(f"{bulk[-1]} and {other} both state the bulk response; keep one of them",
                         field=f"fit.{'start' if bulk[-1] in table.start else 'fixed'}.{bulk[-1]}")
    try:
        build_effect_parts(stated, Bulk())
    except InputError as error:
        # Incomplete parts are missed where the others stand.
        field = f"fit.start.{error.field}".replace(".[", "[")
        raise InputError(error.problem.replace("add it", "add it to fit.start or fit.fixed"), field=field) from None
    return tuple(stated)
