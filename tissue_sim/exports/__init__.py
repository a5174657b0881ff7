"""Materials for other programs: a file a target, by name in `EXPORTERS`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from tissue_sim.errors import InputError
from tissue_sim.material.material import Material
from tissue_sim.registry import Registry

#: The text of a file of another program from a material, SI. Raises `InputError` where that program has no form for
#: something that the material has.
Exporter = Callable[[Material], str]


def _check(name: str, exporter: Any) -> None:
    if not callable(exporter):
        raise InputError(f"{name!r} is no exporter; register a function from a Material to the text of a file",
                         field="tissue_sim.exporters")


#: Name of the program -> its exporter.
EXPORTERS: Registry[Exporter] = Registry("target of an export", "tissue_sim.exporters", {
    "abaqus": "tissue_sim.exports.abaqus:export"}, check=_check)

__all__ = ["EXPORTERS", "Exporter"]
