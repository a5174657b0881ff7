"""A command from one file: help, JSON, errors, exit codes and Ctrl-C, also from an installed package."""

import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import tissue_sim as ts
from scenes.cli import main
from scenes.commands import COMMANDS

ROOT = Path(__file__).resolve().parents[2]
#: Parameter of the law, Pa; E0 = 6 C10.
C10 = 1000.0
#: Density, kg/m3.
DENSITY = 1000.0
#: Sag of a specimen of 70 mm, mm: rho g H^2 / (2 E).
SAG = 1e3 * DENSITY * 9.81 * 0.07**2 / (2 * 6 * C10)


@pytest.fixture
def command(plugin, registers):
    return registers(COMMANDS, plugin("sag_command").COMMAND)


@pytest.fixture
def material(tmp_path):
    path = tmp_path / "m.material.json"
    material = ts.Material("neo_hooke", {"C10": C10}, ts.Bulk(), density=DENSITY)
    ts.write_material_file(ts.MaterialFile.of(material), path)
    return str(path)


def test_help_lists_and_explains_the_command(command, capsys):
    assert main(["--help"]) == 0
    assert command.summary.split()[0] in capsys.readouterr().out
    assert main(["sag", "--help"]) == 0
    text = capsys.readouterr().out
    assert command.summary in text and f"example:\n  {command.example}" in text and "--json" in text
    assert shlex.split(command.example)[:2] == ["tissue-sim", "sag"]


def test_text_json_and_exit_code(command, material, capsys):
    assert main(["sag", material]) == 0
    assert capsys.readouterr().out == f"the specimen sags by {SAG:.2f} mm\n"
    assert main(["sag", material, "--tolerated-percent", "1", "--json"]) == 1
    out, err = capsys.readouterr()
    assert json.loads(out) == {"sag_mm": pytest.approx(SAG, rel=1e-12), "tolerated": False} and err == ""


@pytest.mark.parametrize(("words", "expected"), [
    (["sga"], "unknown command 'sga'; did you mean 'sag'?"),
    (["sag"], "required: FILE"),
    (["sag", "m", "--height-mm", "-1"], "must be a positive number; got '-1'"),
    (["sag", "m", "--heigt-mm", "1"], "did you mean '--height-mm'?"),
    (["sag", "missing.json"], "missing.json"),
], ids=" ".join)
def test_errors_are_one_sentence(command, words, expected, capsys):
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and expected in err


def test_ctrl_c_ends_it_with_its_hint(command, material, capsys, monkeypatch):
    def interrupt(path):
        raise KeyboardInterrupt

    monkeypatch.setattr(ts, "load_material", interrupt)
    assert main(["sag", material]) == 130
    assert capsys.readouterr().err == "tissue-sim: stopped by Ctrl-C; nothing was written\n"


def test_a_name_that_is_taken_and_an_invalid_command_are_refused(plugin):
    with pytest.raises(ts.InputError, match="the name 'calibrate' is taken by another command"):
        COMMANDS.register(plugin("sag_command").COMMAND, "calibrate")
    with pytest.raises(ts.InputError, match=r"'sag' is not a valid command; give a scenes\.commands\.Command"):
        COMMANDS.register(lambda arguments: 0, "sag")


def test_command_of_an_installed_package(plugin, material, tmp_path):
    installed = tmp_path / "site" / "sag-1.0.dist-info"
    installed.mkdir(parents=True)
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: sag\nVersion: 1.0\n", encoding="utf-8")
    (installed / "entry_points.txt").write_text("[tissue_sim.commands]\nsag = sag_command:COMMAND\n",
                                                encoding="utf-8")
    paths = [str(installed.parent), str(ROOT), os.environ["PYTHONPATH"]]
    done = subprocess.run([sys.executable, "-m", "scenes.cli", "sag", material], cwd=tmp_path, text=True,
                          capture_output=True, encoding="utf-8",
                          env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)})
    assert (done.returncode, done.stdout) == (0, f"the specimen sags by {SAG:.2f} mm\n"), done.stderr


def test_a_command_that_cannot_be_imported_stops_no_other(tmp_path):
    installed = tmp_path / "site" / "lost-1.0.dist-info"
    installed.mkdir(parents=True)
    (installed / "METADATA").write_text("Metadata-Version: 2.1\nName: lost\nVersion: 1.0\n", encoding="utf-8")
    (installed / "entry_points.txt").write_text("[tissue_sim.commands]\nlost = no_such_module:COMMAND\n",
                                                encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(installed.parent), str(ROOT)])}

    def run(*words):
        return subprocess.run([sys.executable, "-m", "scenes.cli", *words], cwd=tmp_path, text=True,
                              capture_output=True, encoding="utf-8", env=environment)

    helped, called = run("--help"), run("lost")
    assert helped.returncode == 0 and "calibrate" in helped.stdout
    assert helped.stderr.count("\n") == 1 and "the command 'lost' cannot be imported" in helped.stderr
    assert called.returncode == 2 and "the command 'lost' cannot be imported" in called.stderr
