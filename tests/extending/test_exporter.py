"""An exporter from one file, through the command line."""

import pytest

import tissue_sim as ts
from scenes.cli import main
from tissue_sim.exports import EXPORTERS


@pytest.fixture
def material_file(tmp_path):
    path = tmp_path / "m.material.json"
    material = ts.Material("mooney_rivlin", {"C10": 800.0, "C01": 760.25}, ts.Bulk("K_Pa", 4e6))
    ts.write_material_file(ts.MaterialFile.of(material), path)
    return path


def test_exporter_of_one_file(plugin, registers, material_file, tmp_path):
    registers(EXPORTERS, plugin("plain_table").export, "plain_table")
    assert main(["material", "export", str(material_file), "--to", "plain_table", "-o", str(tmp_path / "m.txt")]) == 0
    assert (tmp_path / "m.txt").read_text(encoding="utf-8") == "mooney_rivlin\nC10 800.0\nC01 760.25\n"


def test_a_name_that_is_taken_is_refused(plugin):
    with pytest.raises(ts.InputError, match="'abaqus' is taken"):
        EXPORTERS.register(plugin("plain_table").export, "abaqus")


def test_unknown_target(material_file, tmp_path, capsys):
    assert main(["material", "export", str(material_file), "--to", "abacus", "-o", str(tmp_path / "m.inp")]) == 2
    assert "did you mean 'abaqus'" in capsys.readouterr().err
    assert not (tmp_path / "m.inp").exists()
