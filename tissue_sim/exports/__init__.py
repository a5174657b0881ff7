"""Materials for other programs: a file a target, by name in `EXPORTERS`."""

from __future__ import annotations

from collections.abc import Callable

from tissue_sim.material.material import Material
from tissue_sim.registry import Registry

#: The text of a file of another program from a material, SI. Raises `InputError` where that program has no form for
#: something that the material has.
Exporter = Callable[[Material], str]


#: Name of the program -> its exporter.
EXPORTERS: Registry[Exporter] = Registry("target of an export", "tissue_sim.exporters", {
    "abaqus": "tissue_sim.exports.abaqus:export"}, accepts=callable,
    expected="a function from a Material to the text of a file")

__all__ = ["EXPORTERS", "Exporter"]
