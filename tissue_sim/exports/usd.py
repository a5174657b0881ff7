"""Export of materials and meshes as text of a USD stage.

Attributes of two namespaces are written, so that readers of both find them: ``physics:`` of OpenUSD proposal 111
(``PhysicsVolumeDeformableMaterialAPI``) and ``omniphysics:`` of Isaac (``OmniPhysicsDeformableMaterialAPI``). usd-core
has no schema of either; API names and attributes are written without one. The calibrated material, which these
attributes cannot represent, is JSON text in ``customData``, so that each number keeps 17 digits.
"""

from __future__ import annotations

import importlib
import json
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from typing import Any

from tissue_sim.decode import parse_json_rejecting_duplicate_keys
from tissue_sim.errors import InputError
from tissue_sim.exports.elastic_constants import ElasticConstants
from tissue_sim.exports.target import ExportContent, ExportTarget, ImportedMaterial
from tissue_sim.exports.unit_systems import UnitSystem
from tissue_sim.material.file import (
    MaterialFile,
    convert_material_file_to_json_data,
    make_material_file_from_json_data,
)
from tissue_sim.material.material import Material
from tissue_sim.material.softening import SOFTENING_FORMS
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.mesh.tetrahedral import make_tetrahedral_mesh

#: Path of the prim that contains all others.
ROOT = "/Tissue"
#: Name of the variant set of a calibrated material and its variants, such as posterior draws.
VARIANT_SET = "posterior"
#: Variant of the calibrated material.
CALIBRATED = "calibrated"
#: Key of the dictionary in ``customData``.
KEY = "tissue_sim"
#: API schemas of a material that usd-core does not have.
_MATERIAL_APIS = ("PhysicsVolumeDeformableMaterialAPI", "OmniPhysicsDeformableMaterialAPI")
#: API schemas of a mesh that usd-core does not have.
_MESH_APIS = ("PhysicsDeformableBodyAPI", "PhysicsVolumeDeformableSimAPI")
#: Namespaces of the attributes of a material.
_NAMESPACES = ("physics", "omniphysics")
#: Part of a material that elastic constants do not represent -> its name.
_PARTS = {"viscoelastic": "relaxation", "softening": "softening on first load"}


class UsdTarget(ExportTarget):
    """USD stage with a physics material, and the mesh of the specimen if there is one, as ``.usda`` text."""

    title = "USD"
    suffix = ".usda"
    uses_elastic_constants = True
    writes_mesh = True
    has_neo_hookean_law = True  # of its readers: USD states no law
    parts = frozenset({"viscoelastic"})
    softening_forms = frozenset(SOFTENING_FORMS)

    def write(self, content: ExportContent) -> str:
        """Return the text of the stage.

        Raises:
            InputError: usd-core is not installed, or a material has layers, regions or further effects.
        """
        pxr = _import_pxr()
        for material in content.materials:
            self.require_available_parts(material)
        stage = pxr.Usd.Stage.CreateInMemory()
        units = content.units
        pxr.UsdGeom.SetStageUpAxis(stage, pxr.UsdGeom.Tokens.z)
        pxr.UsdGeom.SetStageMetersPerUnit(stage, units.length)
        pxr.UsdPhysics.SetStageKilogramsPerUnit(stage, units.mass)
        root = pxr.UsdGeom.Xform.Define(stage, ROOT)
        stage.SetDefaultPrim(root.GetPrim())
        usd_material = pxr.UsdShade.Material.Define(stage, f"{ROOT}/{content.labels[0]}")
        _write_material(pxr, usd_material.GetPrim(), content, self.list_file_remarks(content))
        if content.mesh is not None:
            _write_mesh(pxr, stage, content.mesh, units, usd_material)
        return stage.GetRootLayer().ExportToString()

    def split_materials(self, text: str) -> dict[str, str]:
        """Return the JSON texts of the calibrated material of a stage and of its variants, by name of the variant.

        Args:
            text: ``.usda`` text that this target wrote.

        Raises:
            InputError: usd-core is not installed, text that is no USD, or a stage without a calibrated material.
        """
        pxr = _import_pxr()
        layer = pxr.Sdf.Layer.CreateAnonymous(".usda")
        try:
            layer.ImportFromString(text)
        except pxr.Tf.ErrorException as error:
            raise InputError(f"must be USD text (.usda); got {error}. Export the stage again", field="file") from None
        found = _find_material_files(layer)
        if not found:
            raise InputError("must contain a material that was exported by tissue_sim; the customData of no prim has "
                             f"the key {KEY!r}. Export the material again", field="file")
        return found

    def read_material(self, section: str, units: UnitSystem) -> ImportedMaterial:
        """Return the material of a JSON text in SI, whatever the units of the stage."""
        data = parse_json_rejecting_duplicate_keys(section)
        return ImportedMaterial(make_material_file_from_json_data(data).material)

    def list_file_remarks(self, content: ExportContent) -> tuple[str, ...]:
        """Return the remarks of the file, with the parts of the material that the attributes do not represent."""
        missing = [name for part, name in _PARTS.items() if getattr(content.materials[0], part) is not None]
        remarks = [f"The law {content.materials[0].law} of the calibrated material is in customData, SI units; the "
                   "attributes are the elastic constants that replace it."]
        if missing:
            remarks.append(f"The attributes do not represent {' and '.join(missing)}.")
        if any(constants.damping_time > 0.0 for constants in content.constants):
            remarks.append("No attribute represents damping; its time is damping_time_s in customData.")
        return (*super().list_file_remarks(content), *remarks)


def _import_pxr() -> Any:
    """Return the package pxr with the modules that this file uses.

    Raises:
        InputError: usd-core is not installed.
    """
    try:
        pxr = importlib.import_module("pxr")
        for name in ("Sdf", "Tf", "Usd", "UsdGeom", "UsdPhysics", "UsdShade"):
            importlib.import_module(f"pxr.{name}")
    except ImportError as error:
        raise InputError(f"USD requires the package usd-core ({error}); install it with pip install 'tissue-sim[usd]'",
                         field="--to") from None
    return pxr


def _find_material_files(layer: Any) -> dict[str, str]:
    """Return the JSON texts of the material files in the customData of a layer: the calibrated one, then the variants.

    The layer is not composed, so that no other file to which it refers is opened.
    """
    found: dict[str, str] = {}

    def visit(path: Any) -> None:
        spec = layer.GetPrimAtPath(path)
        if spec is not None and KEY in spec.customData:
            variant = path.GetVariantSelection()[1] if path.IsPrimVariantSelectionPath() else CALIBRATED
            found[variant] = spec.customData[KEY]["material_file"]

    layer.Traverse("/", visit)
    return {name: found[name] for name in sorted(found, key=lambda name: (name != CALIBRATED, len(name), name))}


def _write_material(pxr: Any, prim: Any, content: ExportContent, remarks: Sequence[str]) -> None:
    """Write the constants and the calibrated material to a prim, in variants if there are further materials."""
    pxr.UsdPhysics.MaterialAPI.Apply(prim)
    for api in _MATERIAL_APIS:
        prim.AddAppliedSchema(api)
    prim.SetDocumentation("\n".join(remarks))
    variants = prim.GetVariantSets().AddVariantSet(VARIANT_SET) if len(content.materials) > 1 else None
    for number, (material, constants) in enumerate(zip(content.materials, content.constants, strict=True)):
        with ExitStack() as stack:
            if variants is not None:
                name = f"draw_{number}" if number else CALIBRATED
                variants.AddVariant(name)
                variants.SetVariantSelection(name)
                stack.enter_context(variants.GetVariantEditContext())
            file = content.material_file if number == 0 else None
            _write_values(pxr, prim, material, constants, file, content.units)
    if variants is not None:
        variants.SetVariantSelection(CALIBRATED)


def _write_values(pxr: Any, prim: Any, material: Material, constants: ElasticConstants,
                  material_file: Mapping[str, Any] | None, units: UnitSystem) -> None:
    """Write the constants and the calibrated material to the current edit target."""
    values = {"youngsModulus": constants.young / units.stress, "poissonsRatio": constants.poisson}
    if constants.density is not None:
        values["density"] = constants.density / units.density
    for namespace in _NAMESPACES:
        for name, value in values.items():
            prim.CreateAttribute(f"{namespace}:{name}", pxr.Sdf.ValueTypeNames.Float, False).Set(value)
    data = convert_material_file_to_json_data(MaterialFile.of(material)) if material_file is None else material_file
    prim.SetCustomDataByKey(KEY, {"material_file": json.dumps(data, ensure_ascii=False, allow_nan=False),
                                  "damping_time_s": constants.damping_time})


def _write_mesh(pxr: Any, stage: Any, mesh: SolidMesh, units: UnitSystem, usd_material: Any) -> None:
    """Write the mesh as linear tetrahedra with the material."""
    linear = make_tetrahedral_mesh(mesh)
    usd_mesh = pxr.UsdGeom.TetMesh.Define(stage, f"{ROOT}/Mesh")
    usd_mesh.CreatePointsAttr([tuple(point) for point in (linear.nodes / units.length).tolist()])
    usd_mesh.CreateTetVertexIndicesAttr([tuple(cell) for cell in linear.cells.tolist()])
    usd_mesh.CreateSurfaceFaceVertexIndicesAttr(pxr.UsdGeom.TetMesh.ComputeSurfaceFaces(
        usd_mesh, pxr.Usd.TimeCode.Default()))
    usd_mesh.CreateExtentAttr(pxr.UsdGeom.PointBased.ComputeExtent(usd_mesh.GetPointsAttr().Get()))
    prim = usd_mesh.GetPrim()
    for api in _MESH_APIS:
        prim.AddAppliedSchema(api)
    pxr.UsdPhysics.CollisionAPI.Apply(prim)
    pxr.UsdShade.MaterialBindingAPI.Apply(prim).Bind(usd_material, pxr.UsdShade.Tokens.fallbackStrength, "physics")


USD = UsdTarget()
