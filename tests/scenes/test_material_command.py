"""`tissue-sim material`: new, show and check."""

import json

import pytest

import tissue_sim as ts
from scenes.cli import main
from scenes.commands.material import parse_parameter_settings
from tissue_sim.errors import InputError
from tissue_sim.material.force_scaling import Puncture
from tissue_sim.material.material import Layer
from tissue_sim.material.softening import Softening
from tissue_sim.material.viscoelasticity import Poroelasticity, Prony, PronyTerm

#: The study's reduced polynomial: E0 8429.6 Pa, mu0 2809.8 Pa.
NEW = ["material", "new", "--law", "reduced_polynomial_2", "--set", "C10=1404.9", "--set", "C20=699.4"]


@pytest.fixture
def material(tmp_path):
    path = tmp_path / "m.material.json"
    assert main([*NEW, "--bulk-ratio", "1000", "--name", "phantom", "--density-kg-m3", "1040", "-o", str(path)]) == 0
    return path


def test_new_writes_the_stated_material(material):
    loaded = ts.load_material(material)
    assert dict(loaded.parameters) == {"C10": 1404.9, "C20": 699.4}
    assert (loaded.law, loaded.name, loaded.density) == ("reduced_polynomial_2", "phantom", 1040.0)
    assert loaded.bulk == ts.Bulk("bulk_ratio", 1000.0)


@pytest.mark.parametrize(("flags", "bulk"), [
    (["--bulk-modulus-pa", "2.8e6"], ts.Bulk("K_Pa", 2.8e6)), (["--incompressible"], ts.Bulk()), ([], ts.Bulk())])
def test_bulk_flags(flags, bulk, tmp_path):
    path = tmp_path / "m.material.json"
    assert main([*NEW, *flags, "-o", str(path)]) == 0
    assert ts.load_material(path).bulk == bulk


def test_show_json(material, capsys):
    capsys.readouterr()
    assert main(["material", "show", str(material), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["mu0_Pa"] == pytest.approx(2809.8)
    # E0 = 3 mu0 / (1 + mu0 / (3 K)) for a slightly compressible solid, 3 mu0 = 8429.4 Pa.
    assert summary["E0_Pa"] == pytest.approx(8429.4 / (1 + 1 / 3000), rel=1e-9)
    assert summary["K_Pa"] == pytest.approx(2809.8e3)
    assert summary["parameters"]["C20"]["value"] == 699.4 and summary["parameters"]["C20"]["unit"] == "Pa"
    assert summary["stability"]["stable"]
    assert set(summary["stability"]["modes"]) == {"uniaxial", "planar", "equibiaxial"}


def test_show_as_text(material, capsys):
    capsys.readouterr()
    assert main(["material", "show", str(material)]) == 0
    text = capsys.readouterr().out
    for expected in ("phantom", "W = C10*(I1 - 3) + C20*(I1 - 3)^2", "1404.9",
                     "E0 8.4266 kPa, mu0 2.8098 kPa, K 2.8098 MPa",
                     "stable in equibiaxial loading: stretch 0.3 to 3 (no instability found)",
                     "valid range: not stated",
                     "software: tissue-sim"):
        assert expected in text


def test_show_incompressible_has_no_infinity(tmp_path, capsys):
    path = tmp_path / "m.material.json"
    assert main([*NEW, "--incompressible", "--json", "-o", str(path)]) == 0
    assert json.loads(capsys.readouterr().out) == {"material_file": str(path)}
    assert main(["material", "show", str(path), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["K_Pa"] is None and summary["incompressible"]


def test_show_standard_errors(tmp_path, capsys):
    path = tmp_path / "m.material.json"
    material = ts.Material("neo_hooke", {"C10": 1461.6})
    ts.write_material_file(ts.MaterialFile.of(material, standard_errors={"C10": 12.5},
                                              valid_range={"stretch": [0.86, 1]}), path)
    assert main(["material", "show", str(path)]) == 0
    text = capsys.readouterr().out
    assert "12.5" in text and "0.86 to 1" in text


@pytest.fixture
def relaxing(tmp_path):
    """Material with all effects; its instantaneous mu0 is 2809.8 Pa / (1 - 0.3 - 0.1)."""
    path = tmp_path / "v.material.json"
    material = ts.Material(
        "reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, name="relaxing",
        viscoelastic=Prony((PronyTerm(0.3, 2.0), PronyTerm(0.1, 40.0)), "long_term"), softening=Softening(0.4, 50.0),
        layers=(Layer(2e-3, 3.0),), poroelasticity=Poroelasticity(0.2, 1e-8), puncture=Puncture(6e-3, 0.25))
    errors = {"viscoelastic.terms[0].g": 0.01, "viscoelastic.terms[1].tau": 4.0, "layers[0].thickness": 0.1e-3}
    ts.write_material_file(ts.MaterialFile.of(material, standard_errors=errors), path)
    return path


def test_show_prints_both_moduli_and_every_effect(relaxing, capsys):
    assert main(["material", "show", str(relaxing)]) == 0
    text = capsys.readouterr().out
    for expected in ("instantaneous E0 14.049 kPa, mu0 4.683 kPa, incompressible",
                     "long-term E 5.6196 kPa, mu 1.8732 kPa; the parameters above are long-term values",
                     "viscoelastic (Prony series of the isochoric second piola stress): "
                     "g 0.3 +- 0.01, tau 2 s; g 0.1, tau 40 +- 4 s",
                     "softening on first load: loss 0.4, modulus 50 Pa, fraction 1, form tanh",
                     "layer of 2 +- 0.1 mm: moduli multiplied by 3",
                     "drainage (poroelasticity): phi 0.2, diffusivity 0.01 mm2/s",
                     "puncture at 6 mm: the force drops by a fraction of 0.25"):
        assert expected in text
    assert main(["material", "show", str(relaxing), "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["mu0_Pa"] == pytest.approx(4683.0) and summary["mu_long_term_Pa"] == pytest.approx(1873.2)
    assert summary["viscoelastic"]["moduli"] == "long_term"
    assert summary["viscoelastic"]["terms"][0]["standard_errors"] == {"g": 0.01}


def test_check_prints_moduli_and_effects_before_the_verdict(relaxing, capsys):
    assert main(["material", "check", str(relaxing)]) == 0
    text = capsys.readouterr().out
    assert "long-term E 5.6196 kPa" in text and "tau 40 +- 4 s" in text and text.endswith("v.material.json: good\n")


def test_new_with_a_prony_series(tmp_path, capsys):
    path = tmp_path / "m.material.json"
    assert main([*NEW, "--prony", "0.3,2", "--prony", "0.1,40", "--moduli", "long_term", "-o", str(path)]) == 0
    assert "mu0 4.683 kPa, long-term mu 2.8098 kPa" in capsys.readouterr().out
    assert ts.load_material(path).viscoelastic == Prony((PronyTerm(0.3, 2.0), PronyTerm(0.1, 40.0)), "long_term")


def unstable(path, lowest):
    """Write a material that loses Drucker stability in compression: its second coefficient is negative."""
    material = ts.Material("reduced_polynomial_2", {"C10": 1000.0, "C20": -400.0})
    ts.write_material_file(ts.MaterialFile.of(material, valid_range={"stretch": [lowest, 1.0]}), path)


def test_check_good(material, capsys):
    capsys.readouterr()
    assert main(["material", "check", str(material)]) == 0
    assert capsys.readouterr().out.endswith("m.material.json: good\n")


def test_check_covers_only_the_valid_range(tmp_path, capsys):
    path = tmp_path / "m.material.json"
    unstable(path, lowest=0.95)
    assert main(["material", "check", str(path)]) == 0
    unstable(path, lowest=0.5)
    capsys.readouterr()
    assert main(["material", "check", str(path), "--json"]) == 1
    answer = json.loads(capsys.readouterr().out)
    assert not answer["stable"] and "unstable inside its valid range of stretches 0.5 to 1" in answer["message"]


@pytest.mark.parametrize("content", ["", "{", "[]", '{"schema": "tissue_sim/material/99"}', "\0\0\0"])
@pytest.mark.parametrize("action", ["show", "check"])
def test_damaged_file(action, content, tmp_path, capsys):
    path = tmp_path / "broken.material.json"
    path.write_text(content, encoding="utf-8")
    assert main(["material", action, str(path)]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and "broken.material.json" in err


@pytest.mark.parametrize(("C10", "expected"), [
    ("0.05", "E0 0.3 Pa, mu0 0.1 Pa"), ("1404.9", "E0 8.4294 kPa, mu0 2.8098 kPa"), ("5e9", "E0 30 GPa, mu0 10 GPa")])
def test_moduli_of_any_size(C10, expected, tmp_path, capsys):
    words = ["material", "new", "--law", "neo_hooke", "--set", f"C10={C10}", "-o", str(tmp_path / "m.material.json")]
    assert main(words) == 0
    assert capsys.readouterr().out.rstrip().endswith(expected)


def test_existing_file_is_kept(material, capsys):
    before = material.read_bytes()
    assert main(["material", "new", "--law", "neo_hooke", "--set", "C10=1", "-o", str(material)]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert material.read_bytes() == before
    assert main(["material", "new", "--law", "neo_hooke", "--set", "C10=1", "-o", str(material), "--overwrite"]) == 0
    assert ts.load_material(material).law == "neo_hooke"


@pytest.mark.parametrize("nu", ["-0.5", "0", "0.2", "0.49"])
def test_foam(nu, tmp_path, capsys):
    path = tmp_path / "foam.material.json"
    words = ["material", "new", "--law", "hyperfoam_1", "--set", "mu1=1000", "--set", "alpha1=4", "--set", f"nu1={nu}",
             "-o", str(path)]
    assert main([*words, "--incompressible"]) == 2 and not path.exists()
    assert "--incompressible: must not be given for hyperfoam_1" in capsys.readouterr().err
    assert main(words) == 0
    assert ts.load_material(path).bulk == ts.Bulk("of_law")


def test_help_names_every_law(capsys):
    assert main(["material", "new", "--help"]) == 0
    named = " ".join(capsys.readouterr().out.split())
    for name in ts.LAWS:
        stem, _, number = name.rpartition("_")
        assert name in named or (number.isdigit() and f"{stem}_1 to _" in named), name


@pytest.mark.parametrize(("words", "expected"), [
    (["--law", "neo_hook", "--set", "C10=1"], "did you mean 'neo_hooke'?"),
    (["--law", "neo_hooke", "--set", "C01=1"], "did you mean 'C10'?"),
    (["--law", "neo_hooke"], "C10 is missing"),
    (["--law", "neo_hooke", "--set", "C10=-1"], "must give a positive shear modulus"),
    (["--law", "neo_hooke", "--set", "C10=nan"], "must be finite"),
    (["--law", "neo_hooke", "--set", "C10=1", "--bulk-ratio", "2", "--incompressible"], "not allowed with"),
    (["--law", "neo_hooke", "--set", "C10=1", "--bulk-ratio", "1"],
     "--bulk-ratio: K / mu0 must be 2 to 1e+06, the verified range of the finite elements; got 1. "),
    (["--law", "neo_hooke", "--set", "C10=1", "--prony", "0.3"],
     "--prony: must be a fraction and a time in s, such as 0.3,2; got '0.3'"),
    (["--law", "neo_hooke", "--set", "C10=1", "--prony", "0.3,x"],
     "--prony: must be a fraction and a time in s, such as 0.3,2; got '0.3,x'"),
    (["--law", "neo_hooke", "--set", "C10=1", "--prony", "0.6,1", "--prony", "0.4,9"],
     "--prony.terms: the sum of all g"),
    (["--law", "neo_hooke", "--set", "C10=1", "--prony", "0.3,0"],
     "--prony.tau: must be a positive relaxation time; got 0 s"),
    (["--law", "neo_hooke", "--set", "C10=1", "--moduli", "long_term"], "--moduli: requires a Prony series"),
    (["--law", "neo_hooke", "--set", "C10=1", "--bulk-modulus-pa", "1e9"],
     "--bulk-modulus-pa: K / mu0 must be 2 to 1e+06 (4 to 2e+06 Pa), the verified range of the finite elements; got "
     "5e+08"),
])
def test_bad_parameters_write_nothing(words, expected, tmp_path, capsys):
    assert main(["material", "new", *words, "-o", str(tmp_path / "m.material.json")]) == 2
    assert expected in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_file_name_must_end_in_material_json(tmp_path, capsys):
    assert main([*NEW, "-o", str(tmp_path / "m.json")]) == 2
    assert "must end in .material.json" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("settings", [["C10"], ["=3"], ["C10=x"], ["C10=1", "C10=2"], ["C10="]])
def test_bad_settings(settings):
    with pytest.raises(InputError, match=r"^--set: "):
        parse_parameter_settings(settings)
