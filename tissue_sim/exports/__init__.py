"""Exports of materials to other programs, and imports from them: one file for each target, by name in `EXPORTERS`."""

from __future__ import annotations

from collections.abc import Callable

from tissue_sim.exports.target import ExportContent, ExportTarget, FunctionTarget, ImportedMaterial
from tissue_sim.material.material import Material
from tissue_sim.registry import Registry

#: Target, or the simplest plug-in: a function from a material, SI, to the text of a file of another program. It raises
#: `InputError` if the program has no equivalent of a part of the material.
Exporter = ExportTarget | Callable[[Material], str]


#: Name of the program -> its target.
EXPORTERS: Registry[Exporter] = Registry("target of an export", "tissue_sim.exporters", {
    "abaqus": "tissue_sim.exports.abaqus:ABAQUS",
    "calculix": "tissue_sim.exports.calculix:CALCULIX",
    "febio": "tissue_sim.exports.febio:FEBIO",
    "felupe": "tissue_sim.exports.felupe:FELUPE",
    "mujoco": "tissue_sim.exports.mujoco:MUJOCO",
    "newton": "tissue_sim.exports.newton:NEWTON",
    "sofa": "tissue_sim.exports.sofa:SOFA",
    "usd": "tissue_sim.exports.usd:USD",
}, accepts=lambda target: isinstance(target, ExportTarget) or callable(target),
    expected="an ExportTarget, or a function from a Material to the text of a file")


def find_export_target(name: str, field: str = "--to") -> ExportTarget:
    """Return the target of a name; a function of a plug-in becomes a `FunctionTarget`.

    Raises:
        InputError: unknown name.
    """
    found = EXPORTERS.find(name, field)
    return found if isinstance(found, ExportTarget) else FunctionTarget(name, found)


__all__ = ["EXPORTERS", "ExportContent", "ExportTarget", "Exporter", "ImportedMaterial",
           "find_export_target"]
