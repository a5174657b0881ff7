"""Exports of materials to other programs: one file for each target, by name in `EXPORTERS`."""

from __future__ import annotations

from collections.abc import Callable

from tissue_sim.material.material import Material
from tissue_sim.registry import Registry

#: Function from a material, SI, to the text of a file of another program. It raises `InputError` if the program has no
#: equivalent of a part of the material.
Exporter = Callable[[Material], str]


#: Name of the program -> its exporter.
EXPORTERS: Registry[Exporter] = Registry("target of an export", "tissue_sim.exporters", {
    "abaqus": "tissue_sim.exports.abaqus:export"}, accepts=callable,
    expected="a function from a Material to the text of a file")

__all__ = ["EXPORTERS", "Exporter"]
