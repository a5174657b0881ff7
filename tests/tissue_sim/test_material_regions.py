"""Regions in material files: the round trip, the refusals, and the command line against the closed form."""

import dataclasses
import json

import meshio
import numpy as np
import pytest
from solid_meshes import block

import tissue_sim as ts
from scenes.cli import main
from tissue_sim.exports import ExportContent, find_export_target
from tissue_sim.material.file import make_material_file_from_json_data
from tissue_sim.mesh.solid_element import TET15P1

STIFF = ts.Material("ogden_1", {"mu1": 9000.0, "alpha1": 3.0}, ts.Bulk("bulk_ratio", 1e3), 900.0, "lump",
                    viscoelastic=ts.Prony((ts.PronyTerm(0.25, 2.0),)), softening=ts.Softening(0.5, 32.0, 0.25))
MATERIAL = ts.Material("neo_hooke", {"C10": 1500.0}, ts.Bulk("bulk_ratio", 1e3),
                       regions={"part:1": STIFF, "grey matter": ts.Material("neo_hooke", {"C10": 500.0})})


@pytest.fixture
def data(tmp_path):
    """A valid file as decoded JSON, to be damaged."""
    ts.write_material_file(ts.MaterialFile.of(MATERIAL), tmp_path / "good.material.json")
    return json.loads((tmp_path / "good.material.json").read_text(encoding="utf-8"))


def test_regions_come_back_with_their_uncertainty(tmp_path):
    errors = {"C10": 3.0, "regions.part:1.mu1": 5.0, "regions.part:1.viscoelastic.terms[0].tau": 0.125,
              "regions.grey matter.C10": 7.0}
    file = ts.MaterialFile.of(MATERIAL, standard_errors=errors)
    path = tmp_path / "m.material.json"
    ts.write_material_file(file, path)
    again = ts.read_material_file(path)
    assert again == file and again.material == ts.load_material(path) == MATERIAL
    assert again.standard_errors == errors
    written = json.loads(path.read_text(encoding="utf-8"))["regions"]
    assert written["grey matter"] == {"law": "neo_hooke", "bulk": {"incompressible": True}, "parameters": {
        "C10": {"value": 500.0, "unit": "Pa", "standard_error": 7.0}}}
    assert written["part:1"]["density_kg_m3"] == 900.0 and written["part:1"]["name"] == "lump"


def test_numbers_of_regions_are_reached_by_their_paths():
    """Also where a mesh has named them otherwise than Python names things."""
    changed = ts.with_values(MATERIAL, {"regions.part:1.mu1": 1.0, "regions.grey matter.C10": 2.0})
    assert changed.regions["part:1"].parameters["mu1"] == 1.0
    assert changed.regions["grey matter"].parameters["C10"] == 2.0
    assert ts.with_values(changed, {"regions.part:1.mu1": 9000.0, "regions.grey matter.C10": 500.0}) == MATERIAL


def test_units_and_covariance_reach_into_regions(data):
    entry = data["regions"]["part:1"]["parameters"]["mu1"]
    entry.update(value=9.0, unit="kPa", standard_error=0.5)
    data["covariance"] = {"order": ["C10", "regions.part:1.mu1"], "matrix": [[4.0, 0.5], [0.5, 0.25]]}
    file = make_material_file_from_json_data(data)
    assert file.material == MATERIAL and file.standard_errors == {"regions.part:1.mu1": 500.0}
    paths, covariance = file.paths_and_covariance_SI
    assert paths == ("C10", "regions.part:1.mu1")
    np.testing.assert_allclose(covariance, [[4.0, 500.0], [500.0, 250000.0]], rtol=1e-15)


REGION = {"law": "neo_hooke", "parameters": {"C10": {"value": 1.0, "unit": "kPa"}}, "bulk": {"bulk_ratio": 100.0}}
C10 = REGION["parameters"]["C10"]


@pytest.mark.parametrize(("regions", "field", "message"), [
    ("stiff.material.json", "regions", "expected an object"),
    ({"a": "stiff.material.json"}, "regions.a", "expected an object"),
    ({"a": {**REGION, "law": "neo_hoke"}}, "regions.a.law", "did you mean 'neo_hooke'"),
    ({"a": {**REGION, "parameters": {}}}, "regions.a.parameters.C10", "is missing"),
    ({"a": {**REGION, "parameters": {"C10": {"value": 1.0}}}}, "regions.a.parameters.C10.unit", "give a unit"),
    ({"a": {**REGION, "parameters": {"C10": {**C10, "unit": "mm"}}}}, "regions.a.parameters.C10.unit",
     "expected a stress"),
    ({"a": {**REGION, "parameters": {"C10": {**C10, "value": -1.0}}}}, "regions.a.parameters",
     "must give a positive shear modulus"),
    ({"a": {**REGION, "parameters": {"C10": C10, "C20": C10}}}, "regions.a.parameters.C20", "no parameter"),
    ({"a": {**REGION, "bulk": {}}}, "regions.a.bulk", "exactly one"),
    ({"a": {**REGION, "bulk": {"K_Pa": -1.0}}}, "regions.a.bulk.K_Pa", "must be positive and finite"),
    ({"a": {**REGION, "layers": []}}, "regions.a.layers", "unknown key"),
    ({"a": {**REGION, "softning": {}}}, "regions.a.softning", "did you mean 'softening'"),
    ({"a": {**REGION, "viscoelastic": {"terms": []}}}, "regions.a.viscoelastic.terms", "1 to 13 terms; got 0"),
    ({"a": REGION, "b": {"law": "neo_hooke"}}, "regions.b.parameters", "is missing"),
    ({"v1.2": REGION}, "regions", "must not be empty or contain dots or brackets"),
    ({"": REGION}, "regions", "must not be empty"),
])
def test_refused_with_the_path_of_the_field(data, regions, field, message):
    with pytest.raises(ts.InputError, match=message) as caught:
        make_material_file_from_json_data({**data, "regions": regions})
    assert caught.value.field == field


def test_what_has_no_regions_says_so():
    model = ts.Model(ts.KINDS["lubricated_compression"].experiment(
        specimen=ts.Specimen(0.02, 0.02), protocol=ts.Protocol.ramp(1e-3, 2)), MATERIAL)
    with pytest.raises(ts.InputError, match="--solid"):
        ts.simulate(model)
    with pytest.raises(ts.InputError, match="the mesh has no region 'part:1'; it has no named regions"):
        ts.simulate(model, solver="solid", resolution="realtime")
    with pytest.raises(ts.InputError, match="no form for regions"):
        find_export_target("abaqus").write(ExportContent((MATERIAL,)))


@pytest.fixture(scope="module")
def halves(tmp_path_factory):
    """A block of 20 x 10 x 10 mm: `part:1` is its left half, `part:2` its right one."""
    mesh = block(np.linspace(0.0, 20.0, 5), np.linspace(0.0, 10.0, 3), np.linspace(0.0, 10.0, 3), TET15P1)
    used, cells = np.unique(mesh.connectivity[:, :4], return_inverse=True)
    points, cells = mesh.nodes[used], cells.reshape(-1, 4)
    path = tmp_path_factory.mktemp("mesh") / "halves.vtu"
    meshio.Mesh(points, [("tetra", cells)], cell_data={"part": [
        (points[cells].mean(axis=1)[:, 0] > 10.0).astype(int) + 1]}).write(path)
    return path


@pytest.mark.slow
def test_the_command_line_takes_regions(halves, tmp_path, capsys):
    """Halves side by side between slippery plates carry what their laws say of the same stretch."""
    soft, stiff, path = (tmp_path / f"{name}.material.json" for name in ("soft", "stiff", "both"))
    bare = dataclasses.replace(MATERIAL, regions={})
    ts.write_material_file(ts.MaterialFile.of(bare), soft)
    ts.write_material_file(ts.MaterialFile.of(dataclasses.replace(bare, parameters={"C10": 6000.0})), stiff)
    new = ["material", "new", "--law", "neo_hooke", "--set", "C10=1500", "--bulk-ratio", "1000", "-o", str(path)]
    assert main([*new, "--region", f"part:1={stiff}"]) == 0
    assert main(["material", "show", str(path)]) == 0
    assert "region part:1: neo_hooke, C10 6000 Pa" in capsys.readouterr().out
    words = ["simulate", "lubricated_compression", "--solid", "--mesh", str(halves), "--depth-mm", "1", "--points", "2",
             "--json", "--material"]
    assert main([*words, str(path)]) == 0
    force = json.loads(capsys.readouterr().out)["force_N"][-1]
    # Neo-Hooke with J close to 1: 2 C10 (stretch^-2 - stretch) times the area; the mean of both.
    expected = 0.5 * (1500.0 + 6000.0) * 2.0 * (0.9**-2 - 0.9) * 2e-4
    assert force == pytest.approx(expected, rel=2e-3)

    assert main([*new, "--overwrite", "--region", f"part:3={stiff}"]) == 0
    assert main([*words, str(path)]) == 2
    assert "the mesh has no region 'part:3'; did you mean 'part:" in capsys.readouterr().err
    assert main([*new, "--overwrite", "--region", "part:3"]) == 2
    error = capsys.readouterr().err
    assert "--region: must have the form NAME=FILE, such as tumour=stiff.material.json; got 'part:3'" in error
