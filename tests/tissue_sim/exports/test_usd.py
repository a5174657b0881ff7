"""Materials and meshes as USD stages, read back by OpenUSD."""

import json
import sys

import numpy as np
import pytest
from pxr import Gf, Usd, UsdGeom, UsdPhysics, UsdShade
from solid_meshes import block

import tissue_sim as ts
from scenes.cli import main
from tissue_sim.exports import ExportContent
from tissue_sim.exports.elastic_constants import ElasticConstants, linearise_material
from tissue_sim.exports.unit_systems import SI, UNIT_SYSTEMS
from tissue_sim.exports.usd import USD
from tissue_sim.mesh.solid import SOLID_ELEMENTS

#: Every part that the target accepts, with numbers of 17 digits.
MATERIAL = ts.Material("ogden_2", {"mu1": 1500.1234567890123, "alpha1": 3.0, "mu2": 1.0 / 3.0, "alpha2": -2.5},
                       ts.Bulk("bulk_ratio", 10.0), 1040.1, 'liver "2"',
                       viscoelastic=ts.Prony((ts.PronyTerm(0.1 + 0.2, 2.0 / 7.0),), "long_term"),
                       softening=ts.Softening(0.3, 50.0))
#: Sizes of a block along x, y and z, m.
SIZES = (0.02, 0.03, 0.01)


def make_content(*materials, units=SI, **others):
    return ExportContent(materials, units, tuple(linearise_material(each, USD.max_poisson) for each in materials),
                         **others)


def open_stage(text):
    stage = Usd.Stage.CreateInMemory()
    assert stage.GetRootLayer().ImportFromString(text)
    return stage


def open_material(content):
    """The stage, which must be kept, and the prim of the material."""
    stage = open_stage(USD.write(content))
    return stage, stage.GetPrimAtPath(f"/Tissue/{content.labels[0]}")


@pytest.mark.parametrize("units", UNIT_SYSTEMS.values(), ids=UNIT_SYSTEMS)
def test_round_trip_of_the_material_is_exact(units):
    [imported] = USD.read(USD.write(make_content(MATERIAL, units=units)), units)
    assert imported.material == MATERIAL


@pytest.mark.parametrize("units", UNIT_SYSTEMS.values(), ids=UNIT_SYSTEMS)
def test_values_belong_to_the_units_of_the_stage(units):
    """One unit of length, mass and time of the stage makes the units of stress and density."""
    stage, prim = open_material(make_content(MATERIAL, units=units))
    length, mass = UsdGeom.GetStageMetersPerUnit(stage), UsdPhysics.GetStageKilogramsPerUnit(stage)
    for namespace in ("physics", "omniphysics"):
        assert prim.GetAttribute(f"{namespace}:density").Get() * mass / length**3 == pytest.approx(1040.1, rel=1e-6)
        nu = prim.GetAttribute(f"{namespace}:poissonsRatio").Get()
        young = prim.GetAttribute(f"{namespace}:youngsModulus").Get() * mass / length
        assert young / (2.0 * (1.0 + nu)) == pytest.approx(MATERIAL.mu0, rel=1e-6)
        assert nu == pytest.approx((3 * 10.0 - 2) / (6 * 10.0 + 2), rel=1e-6)
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and stage.GetDefaultPrim().GetPath() == "/Tissue"


def test_schemas_and_documentation():
    _stage, prim = open_material(make_content(MATERIAL, remarks=("force error +3 % at 2 mm",)))
    assert prim.GetMetadata("apiSchemas").GetAppliedItems() == [
        "PhysicsMaterialAPI", "PhysicsVolumeDeformableMaterialAPI", "OmniPhysicsDeformableMaterialAPI"]
    assert UsdPhysics.MaterialAPI(prim).GetDensityAttr().Get() == pytest.approx(1040.1)
    documentation = prim.GetDocumentation()
    assert "\nforce error +3 % at 2 mm\n" in documentation and "Units (SI): m, N, s" in documentation
    assert "do not represent relaxation and softening on first load" in documentation
    assert "damping" not in documentation


def test_incompressible_material_has_a_poisson_ratio_below_one_half():
    _stage, prim = open_material(make_content(ts.Material("neo_hooke", {"C10": 1500.0})))
    assert prim.GetAttribute("physics:poissonsRatio").Get() == pytest.approx(USD.max_poisson) and USD.max_poisson < 0.5
    assert not prim.GetAttribute("physics:density").HasAuthoredValue()


def test_given_constants_and_material_file_are_written():
    """Constants of a fit, with damping, and the whole file with its uncertainty."""
    data = {"schema": "tissue_sim/material/2", "name": "x", "law": "neo_hooke", "bulk": {"bulk_ratio": 50.0},
            "parameters": {"C10": {"value": 1500.0, "unit": "Pa", "standard_error": 0.1 + 0.2}}}
    material = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 50.0), name="x")
    _stage, prim = open_material(ExportContent((material,), constants=(ElasticConstants(5000.0, 0.45, 0.02),),
                                               material_file=data))
    assert prim.GetAttribute("omniphysics:youngsModulus").Get() == 5000.0
    assert json.loads(prim.GetCustomDataByKey("tissue_sim")["material_file"]) == data
    assert prim.GetCustomDataByKey("tissue_sim")["damping_time_s"] == 0.02
    assert "damping_time_s in customData" in prim.GetDocumentation()


def test_draws_are_variants():
    draws = [ts.Material("neo_hooke", {"C10": 1000.0 * number}, ts.Bulk("bulk_ratio", 50.0)) for number in range(1, 13)]
    stage, prim = open_material(make_content(*draws))
    variants = prim.GetVariantSet("posterior")
    young = prim.GetAttribute("physics:youngsModulus")
    assert variants.GetVariantSelection() == "calibrated"
    first = young.Get()
    variants.SetVariantSelection("draw_11")
    assert young.Get() == pytest.approx(12 * first)
    assert [each.material for each in USD.read(stage.GetRootLayer().ExportToString(), SI)] == list(draws)


@pytest.mark.parametrize("element", SOLID_ELEMENTS)
@pytest.mark.parametrize("units", [SI, UNIT_SYSTEMS["mm-N-MPa"]], ids=["SI", "mm"])
def test_mesh_fills_the_block_and_has_the_material(element, units):
    x, y, z = SIZES
    mesh = block(np.linspace(0.0, x, 3), np.linspace(0.0, y, 4), np.linspace(-z, 0.0, 3), SOLID_ELEMENTS[element])
    stage = open_stage(USD.write(make_content(MATERIAL, units=units, mesh=mesh)))
    usd_mesh = UsdGeom.TetMesh(stage.GetPrimAtPath("/Tissue/Mesh"))
    points = np.array(usd_mesh.GetPointsAttr().Get()) * units.length
    cells, faces = (np.array(attribute.Get()) for attribute in (usd_mesh.GetTetVertexIndicesAttr(),
                                                                usd_mesh.GetSurfaceFaceVertexIndicesAttr()))
    volumes = np.linalg.det(points[cells[:, 1:]] - points[cells[:, :1]]) / 6.0
    assert volumes.min() > 0.0 and volumes.sum() == pytest.approx(np.prod(SIZES), rel=1e-5)
    assert np.unique(cells).size == len(points)
    assert len(UsdGeom.TetMesh.FindInvertedElements(usd_mesh)) == 0
    a, b, c = np.moveaxis(points[faces], 1, 0)
    outward = np.linalg.det(np.stack([a, b, c], axis=1)).sum() / 6.0
    assert outward == pytest.approx(np.prod(SIZES), rel=1e-5)
    material, relation = UsdShade.MaterialBindingAPI(usd_mesh).ComputeBoundMaterial("physics")
    assert material.GetPath() == "/Tissue/LIVER_2" and relation
    assert {"PhysicsDeformableBodyAPI", "PhysicsVolumeDeformableSimAPI"} <= set(
        usd_mesh.GetPrim().GetMetadata("apiSchemas").GetAppliedItems())
    box = UsdGeom.BBoxCache(Usd.TimeCode.Default(), ["default"]).ComputeWorldBound(usd_mesh.GetPrim())
    assert Gf.IsClose(box.GetRange().GetSize(), Gf.Vec3d(*(np.array(SIZES) / units.length)), 1e-5 / units.length)


@pytest.mark.parametrize(("part", "words"), [({"layers": (ts.Layer(2e-3, 2.0),)}, "layers"),
                                             ({"puncture": ts.Puncture(5e-3, 0.2)}, "puncture")])
def test_parts_that_constants_cannot_replace_are_refused(part, words):
    with pytest.raises(ts.InputError, match=words):
        USD.write(make_content(ts.Material("neo_hooke", {"C10": 1500.0}, **part)))


@pytest.mark.parametrize(("text", "words"), [("no stage", "must be USD text"),
                                             ("#usda 1.0\n\ndef Xform \"A\"\n{\n}\n", "exported by tissue_sim")])
def test_other_files_are_refused(text, words):
    with pytest.raises(ts.InputError, match=words):
        USD.read(text, SI)


def test_damaged_material_is_refused():
    text = USD.write(make_content(MATERIAL))
    with pytest.raises(ts.InputError, match="ogden_9"):
        USD.read(text.replace('"ogden_2"', '"ogden_9"'), SI)


def test_missing_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(ts.InputError, match=r"pip install 'tissue-sim\[usd\]'"):
        USD.write(make_content(MATERIAL))


def test_command_line_writes_the_whole_material_file(tmp_path):
    source, output = tmp_path / "m.material.json", tmp_path / "m.usda"
    ts.write_material_file(ts.MaterialFile.of(MATERIAL, standard_errors={"mu1": 12.5}), source)
    assert main(["material", "export", str(source), "--to", "usd", "-o", str(output), "--units", "mm-mN-kPa"]) == 0
    stage = Usd.Stage.Open(str(output))
    prim = stage.GetPrimAtPath("/Tissue/LIVER_2")
    written = json.loads(prim.GetCustomDataByKey("tissue_sim")["material_file"])
    assert written == json.loads(source.read_text(encoding="utf-8"))
    assert "force error in USD is not stated" in prim.GetDocumentation()
    assert prim.GetAttribute("physics:youngsModulus").Get() * 1e3 == pytest.approx(
        linearise_material(MATERIAL, 0.49).young, rel=1e-6)
