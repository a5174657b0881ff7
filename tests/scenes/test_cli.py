"""Command line in general: fast help, one sentence for each error, exit codes."""

import json
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from scenes.cli import main, make_command_line_parser
from scenes.commands import COMMANDS
from scenes.commands.shared.parsing import InputErrorArgumentParser
from tissue_sim.errors import MissingBackendError

ROOT = Path(__file__).resolve().parents[2]
HEAVY = ("taichi", "viser", "scipy", "numpy", "matplotlib", "sympy", "rich", "msgspec")
HELPS = [["--help"], [], ["--version"], *([name, "--help"] for name in COMMANDS),
         *(["material", action.name, "--help"] for action in COMMANDS["material"].actions)]


ANSWERS = f"""
import contextlib, io, json, sys
from scenes.cli import main

for words in json.loads(sys.argv[1]):
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        code = main(words)
    print(json.dumps([code, said.getvalue(), [name for name in {HEAVY} if name in sys.modules]]))
"""


@pytest.fixture(scope="module")
def answers():
    """Exit code, output and imported heavy packages of each help, from one process."""
    done = subprocess.run([sys.executable, "-c", ANSWERS, json.dumps(HELPS)], cwd=ROOT, capture_output=True, text=True,
                          encoding="utf-8")
    assert (done.returncode, done.stderr) == (0, "")
    return dict(zip(map(tuple, HELPS), map(json.loads, done.stdout.splitlines()), strict=True))


@pytest.mark.parametrize("words", HELPS, ids=" ".join)
def test_help_imports_nothing_heavy(words, answers):
    code, said, heavy = answers[tuple(words)]
    assert code == 0 and "tissue-sim" in said
    assert heavy == [], "help must answer at once"


@pytest.mark.parametrize("words", HELPS[3:], ids=" ".join)
def test_every_help_has_a_description_and_an_example(words, capsys):
    assert main(words) == 0
    text = capsys.readouterr().out
    name = " ".join(words[:-1])
    assert f"example:\n  tissue-sim {name.split()[0]}" in text
    if name in COMMANDS:
        assert COMMANDS[name].summary in text
        assert COMMANDS[name].example in text


@pytest.mark.parametrize("name", COMMANDS)
def test_example_of_a_help_is_valid(name):
    words = shlex.split(COMMANDS[name].example)
    assert words[0] == "tissue-sim"
    _, rest = make_command_line_parser().parse_known_args(words[1:])
    assert rest == []


def fails(capsys, words, code=2) -> str:
    """Run a command; check its exit code, its empty stdout and its single line on stderr; return this line."""
    assert main(words) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("tissue-sim: ") and err.count("\n") == 1 and "Traceback" not in err
    return err


@pytest.mark.parametrize(("words", "expected"), [
    (["simulat"], "did you mean 'simulate'?"),
    (["xyz"], "known: demo"),
    (["material", "shw"], "did you mean 'show'?"),
    (["material"], "required: ACTION"),
    (["simulate"], "required: SCENE, --material"),
    (["simulate", "bonded_compression"], "required: --material"),
    (["simulate", "bonded_compression", "--material", "m", "--dept-mm", "3"], "did you mean '--depth-mm'?"),
    (["simulate", "bonded_compresion", "--material", "m"], "did you mean 'bonded_compression'?"),
    (["simulate", "bonded_compression", "--material", "m", "--depth-mm", "-3"], "must be a positive number; got '-3'"),
    (["simulate", "bonded_compression", "--material", "m", "--depth-mm", "nan"],
     "must be a positive number; got 'nan'"),
    (["simulate", "bonded_compression", "--material", "m", "--points", "1"], "whole number of at least 2"),
    (["simulate", "bonded_compression", "--material", "m", "--points", "2.5"], "whole number of at least 2"),
    (["simulate", "bonded_compression", "--material", "m", "--resolution", "fat"], "'fat'"),
    (["simulate", "needle_indentation", "--material", "m", "--tool-radius-mm", "0"],
     "must be a positive number; got '0'"),
    (["simulate", "needle_indentation", "--material", "m", "--edge-radius-mm", "-1"],
     "must be zero or a positive number; got '-1'"),
    (["simulate", "needle_indentation", "--material", "m", "--density-kg-m3", "inf"],
     "must be a positive number; got 'inf'"),
    (["simulate", "needle_indentation", "--material", "m", "--height-is", "guessed"], "'guessed'"),
    (["simulate", "bonded_compression", "--material", "m", "again"], "unexpected argument 'again'"),
    (["simulate", "bonded_compression", "--material", "m", "--friction", "sticky"],
     "must be bonded, stick, frictionless or a friction coefficient such as 0.7; got 'sticky'"),
    (["simulate", "bonded_compression", "--material", "m", "--friction-base", "-0.1"], "such as 0.7; got '-0.1'"),
    (["simulate", "bonded_compression", "--material", "m", "--friction-wall", "nan"], "such as 0.7; got 'nan'"),
    (["simulate", "needle_indentation", "--material", "m", "--half-angle-deg", "90"], "must be between 0.573 and"),
    (["simulate", "needle_indentation", "--material", "m", "--replicates", "1001"], "must be at most 1000; got '1001'"),
    (["simulate", "bonded_compression", "--material", "m", "--protocol", "ramp 10mm @0.248"],
     "protocol: column 17, at the end: '0.248' has no unit; expected a speed such as 0.248mm/s; for example 'ramp"),
    (["simulate", "bonded_compression", "--material", "m", "--rig", "missing.rig.json"], "missing.rig.json"),
    (["simulate", "bonded_compression", "--material", "missing.json"], "missing.json"),
    (["doctor", "--clock-seconds", "x"], "must be a positive number; got 'x'"),
    (["calibrate", "-o", "out"], "required: CAMPAIGN.toml"),
    (["calibrate", "missing.toml", "-o", "out"], "missing.toml"),
    (["design"], "required: CAMPAIGN.toml"),
    (["design", "missing.toml"], "missing.toml"),
    (["design", "c.toml", "--replicates", "0"], "whole number of at least 1"),
    (["diagnose", "-o", "out"], "required: CAMPAIGN.toml"),
    (["diagnose", "missing.toml", "-o", "out"], "missing.toml"),
    (["demo", "--seed", "-1"], "whole number of at least 0"),
], ids=lambda value: " ".join(value) if isinstance(value, list) else None)
def test_invalid_arguments_get_one_sentence(words, expected, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert expected in fails(capsys, words)
    assert list(tmp_path.iterdir()) == []


def test_version(capsys):
    import tissue_sim

    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"tissue-sim {tissue_sim.__version__}\n"


@pytest.mark.parametrize(("error", "code", "expected"), [
    (KeyboardInterrupt(), 130, "stopped by Ctrl-C; no campaign was finished"),
    (MissingBackendError("the finite elements need taichi"), 1, "need taichi"),
    (PermissionError(13, "Permission denied", "out/fit.json"), 2, "out/fit.json: Permission denied"),
])
def test_expected_errors_are_one_sentence(error, code, expected, capsys, monkeypatch):
    def calibrate(*arguments, **options):
        raise error

    monkeypatch.setattr("calibration.calibrate", calibrate)
    assert expected in fails(capsys, ["calibrate", "c.toml", "-o", "out"], code)


def test_a_programming_error_is_not_hidden(monkeypatch):
    def calibrate(*arguments, **options):
        raise ZeroDivisionError

    monkeypatch.setattr("calibration.calibrate", calibrate)
    with pytest.raises(ZeroDivisionError):
        main(["calibrate", "c.toml", "-o", "out"])


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_prints_json(name):
    command = COMMANDS[name]
    for action in command.actions or [command]:
        parser = InputErrorArgumentParser(prog=name)
        action.add_arguments(parser)
        assert "--json" in parser.list_option_names()


def test_a_command_imports_no_other_command():
    script = ("import sys; from scenes.cli import main; main(['devices', '--help']); "
              "print([name for name in sys.modules if name.startswith('scenes.commands.')])")
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, encoding="utf-8")
    imported = done.stdout.splitlines()[-1]
    assert "scenes.commands.devices" in imported and "scenes.commands.loop" not in imported, done.stderr


def test_closed_pipe_is_no_error(tmp_path):
    path = tmp_path / "m.material.json"
    assert main(["material", "new", "--law", "neo_hooke", "--set", "C10=1", "-o", str(path)]) == 0
    script = f"import sys; from scenes.cli import main; sys.exit(main(['material', 'show', {str(path)!r}, '--json']))"
    process = subprocess.Popen([sys.executable, "-c", script], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    stderr = process.stderr.read().decode("utf-8")
    process.stderr.close()
    assert process.wait() in (0, 1)
    assert stderr == ""


def test_output_survives_a_windows_code_page(tmp_path):
    script = ("import sys; from scenes.cli import main; "
              "sys.exit(main(['material', 'new', '--law', 'neo_hooke', '--set', 'C10=1', '--name', 'Möbius λ', "
              "'-o', 'm.material.json']) or main(['material', 'show', 'm.material.json', '--json']))")
    done = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True,
                          env={**__import__("os").environ, "PYTHONPATH": str(ROOT), "PYTHONIOENCODING": "cp1252",
                               "PYTHONUTF8": "0"})
    assert done.returncode == 0, done.stderr.decode("utf-8", "replace")
    text = done.stdout.decode("utf-8")
    assert json.loads(text[text.index("{"):])["name"] == "Möbius λ"


_WORDS = st.one_of(
    st.sampled_from(["--depth-mm", "--points", "--json", "--overwrite", "--resolution", "fast", "--field", "-o", "-x",
                     "--", "-", "", "1", "-1", "1e400", "bonded_compression", "--radius-mm=3", "--tool", "--gravity=",
                     "--protocol", "ramp 1mm", "--friction", "--rig", "--replicates", "--noise-N", "--seed"]),
    st.text(st.characters(blacklist_characters="\0", blacklist_categories=("Cs",)), max_size=8))


@pytest.mark.slow
@settings(deadline=None, max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.lists(_WORDS, max_size=6))
def test_no_arguments_lead_to_a_traceback(capsys, words):
    """Any arguments give the help, or one sentence and exit code 2 (the material file does not exist)."""
    code = main(["simulate", "--material", "no such folder/m.material.json", *words])
    out, err = capsys.readouterr()
    assert (code, err.count("\n"), out) == (2, 1, "") or (code == 0 and ("-h" in words or "--help" in words))
