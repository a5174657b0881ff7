"""`tissue-sim material import`: choice of program and material, printed moduli, warnings and refusals."""

import json
import re

import pytest

import tissue_sim as ts
from scenes.cli import main

GEL = "*MATERIAL, NAME=Gel\n*HYPERELASTIC, NEO HOOKE\n0.0015, 0.5\n*DENSITY\n1.04e-9\n"
STEEL = "*MATERIAL, NAME=Steel\n*ELASTIC\n210000, 0.3\n"
FEBIO = """<febio_spec version="4.0"><Material><material id="1" name="Gel" type="Mooney-Rivlin">
<k>4</k><pressure_model>2</pressure_model><c1>0.0015</c1><c2>0</c2></material></Material></febio_spec>"""


@pytest.fixture
def run(tmp_path, capsys, monkeypatch):
    """Function that imports a file, and returns exit code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)

    def run(text, *words, name="job.inp", units="mm-N-MPa"):
        (tmp_path / name).write_text(text, encoding="utf-8")
        stated = [] if units is None else ["--units", units]
        code = main(["material", "import", name, *stated, "-o", "m.material.json", *words])
        return code, *capsys.readouterr()

    return run


@pytest.mark.parametrize(("text", "name", "words"), [
    (GEL, "job.inp", ()), (GEL, "JOB.INP", ()), (GEL, "gel.txt", ("--from", "abaqus")),
    (GEL, "gel.inp", ("--from", "calculix")), (FEBIO, "gel.feb", ()), (FEBIO, "gel.xml", ("--from", "febio"))])
def test_imported_material(run, text, name, words):
    code, out, err = run(text, *words, name=name)
    assert code == 0 and "E0 8.99775 kPa, mu0 3 kPa" in out and err == ""
    material = ts.load_material("m.material.json")
    assert (material.law, material.name) == ("neo_hooke", "Gel")
    assert (material.mu0, material.bulk_modulus) == pytest.approx((3000.0, 4e6), rel=1e-12)


def test_json_and_provenance(run):
    code, out, _ = run(GEL, "--json")
    answer = json.loads(out)
    assert code == 0 and answer["from"] == "abaqus" and answer["material"] == "Gel"
    assert (answer["E0_kPa"], answer["mu0_kPa"]) == pytest.approx((8.99775, 3.0), rel=1e-5)
    assert answer["warnings"] == [] and answer["remarks"] == []
    provenance = ts.read_material_file("m.material.json").provenance
    assert provenance.method == "import"
    assert provenance.settings == {"file": "job.inp", "from": "abaqus", "units": "mm-N-MPa", "material": "Gel"}


@pytest.mark.parametrize(("units", "E0"), [("SI", "8.998e-06"), ("mm-mN-kPa", "0.008998")])
def test_a_wrong_unit_system_is_noticed(run, units, E0):
    code, out, err = run(GEL, units=units)
    assert code == 0 and "kPa" in out
    assert f"warning: E0 = {E0} kPa is outside 0.01 to 100000 kPa" in err and "Check --units" in err


def test_an_unusual_bulk_modulus_is_warned_about(run):
    _, _, err = run(GEL.replace("0.5", "1e-8"))
    assert "K / mu0 = 6.667e+10 is outside 2 to 1e+06" in err


def test_the_bulk_modulus_of_a_foam_is_usual(run):
    """K / mu0 = 2 (1/3 + beta), beta = nu / (1 - 2 nu): 4/3, within the range of a compressible law."""
    text = "*MATERIAL, NAME=Foam\n*HYPERFOAM, N=1\n0.001, 4, {}\n"
    code, _, err = run(text.format(0.2))
    assert code == 0 and "K / mu0" not in err
    _, _, err = run(text.format(0.48), "--overwrite")
    assert "K / mu0 = 24.67 is outside 0 to 10" in err


def test_the_material_of_a_model_is_chosen_by_name(run):
    assert run(STEEL + GEL, "--material", "gel")[0] == 0
    assert ts.load_material("m.material.json").name == "Gel"


@pytest.mark.parametrize(("text", "words", "units", "expected"), [
    (GEL, (), None, "--units"),
    (GEL, (), "inch", "--units: unknown unit system 'inch'"),
    (GEL, ("--from", "abacus"), "SI", "--from: .*did you mean 'abaqus'"),
    (STEEL + GEL, (), "SI", "job.inp: --material: must be given for a file with 2 materials: Steel, Gel"),
    (STEEL + GEL, ("--material", "Stel"), "SI", "--material: the file has no material 'Stel'; did you mean 'Steel'"),
    (STEEL + GEL, ("--material", "Steel"), "SI", r"job.inp:2: \*ELASTIC in material Steel"),
    (GEL + GEL.replace("Gel", "GEL"), ("--material", "gel"), "SI", "the file has no material 'gel'"),
    (GEL.replace("0.5", "x"), (), "SI", "job.inp:3: must be a finite number; got 'x'"),
    ("\x00\x01", (), "SI", "job.inp: "), ("", (), "SI", "job.inp: ")])
def test_refused_input_writes_nothing(run, tmp_path, text, words, units, expected):
    code, out, err = run(text, *words, units=units)
    assert (code, out, err.count("\n")) == (2, "", 1)
    assert re.search(expected, err), err
    assert [path.name for path in tmp_path.iterdir()] == ["job.inp"]


def test_a_file_without_a_known_suffix_needs_a_program(run):
    code, _, err = run(GEL, name="gel.txt")
    assert code == 2 and "--from: must be given for a file that does not end in .inp or .feb" in err


def test_an_existing_file_is_kept(run, tmp_path):
    (tmp_path / "m.material.json").write_text("mine", encoding="utf-8")
    assert run(GEL)[0] == 2
    assert (tmp_path / "m.material.json").read_text(encoding="utf-8") == "mine"
    assert run(GEL, "--overwrite")[0] == 0


@pytest.mark.parametrize(("program", "expected"), [
    ("abaqus", ["Units (SI)"]), ("calculix", ["Units (SI)", "K / mu0 = 10000 replaces"]),
    ("febio", ["Units (SI)", "K / mu0 = 10000 replaces", "The stress of the type Yeoh"])])
def test_the_export_prints_its_remarks(program, expected, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4})
    ts.write_material_file(ts.MaterialFile.of(material), "a.material.json")
    assert main(["material", "export", "a.material.json", "--to", program, "-o", "a.txt", "--json"]) == 0
    remarks = json.loads(capsys.readouterr().out)["remarks"]
    assert [remark[:len(begin)] for remark, begin in zip(remarks, expected, strict=True)] == expected
    assert main(["material", "export", "a.material.json", "--to", program, "-o", "b.txt"]) == 0
    assert all(remark in capsys.readouterr().out for remark in remarks[:1])


@pytest.mark.parametrize("program", ["abaqus", "calculix", "febio"])
@pytest.mark.parametrize("units", ["SI", "mm-N-MPa", "mm-mN-kPa"])
def test_export_and_import(program, units, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("K_Pa", 4e6), 1040.0, "gel")
    ts.write_material_file(ts.MaterialFile.of(material), "a.material.json")
    assert main(["material", "export", "a.material.json", "--to", program, "--units", units, "-o", "a.txt"]) == 0
    assert main(["material", "import", "a.txt", "--from", program, "--units", units, "-o", "b.material.json"]) == 0
    same = ts.load_material("b.material.json")
    assert (same.law, same.name) == (material.law, "GEL")
    assert dict(same.parameters) == pytest.approx(dict(material.parameters), rel=1e-12)
    assert (same.bulk_modulus, same.density) == pytest.approx((4e6, 1040.0), rel=1e-12)
