"""`tissue-sim diagnose` of a relaxing specimen: output, report, JSON and an interrupted run."""

import contextlib
import io
import json
import signal
import subprocess
import sys
from html.parser import HTMLParser

import numpy as np
import pytest
from child_environment import child_environment

import tissue_sim as ts
from calibration.effects.rig import MachineCompliance
from calibration.effects.tissue import Viscoelasticity
from scenes.cli import main

CAMPAIGN = """
[[specimen]]
radius_mm = 20.0
height_mm = 30.0
[[test]]
name = "plates"
kind = "lubricated_compression"
recordings = ["plates_*.csv"]
[fit]
method = "{method}"
laws = ["neo_hooke"]
{more}
[noise]
force_N = 0.01
correlation_time_s = 0
contact_jitter_mm = 0.02
zero_jitter_N = 0.005
"""
INVERSE = "bulk_ratio = 10000.0\nstarts = 1\nstart = { C10 = 1500.0 }"
EFFECTS = {"viscoelasticity": Viscoelasticity, "machine_compliance": MachineCompliance}
#: Parameter of the law, Pa.
C10 = 1404.9
#: Relaxing fraction, 1.
G = 0.15
#: Relaxation time, s.
TAU = 12.0
KEYS = {"verdict", "effects", "indistinguishable", "candidates", "regions", "gap_before_N", "gap_after_N", "noise_N",
        "held_out", "next_experiment", "fit_before", "fit_after", "output", "work"}
#: Keys that differ from run to run.
CLOCKS = ("stages", "output")


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    """Campaign of three recordings (ramp, hold, unloading) of a relaxing tissue."""
    folder, random = tmp_path_factory.mktemp("relaxing"), np.random.default_rng(3)
    time = np.linspace(0.0, 60.0, 61)
    depth = np.interp(time, [0, 15, 45, 60], [0, 3e-3, 3e-3, 0])
    material = ts.Material("neo_hooke", {"C10": C10}, ts.Bulk("bulk_ratio", 1e4),
                           viscoelastic=ts.Prony((ts.PronyTerm(G, TAU),)))
    experiment = ts.Experiment(ts.Specimen(0.020, 0.030), ts.Protocol(time, depth), ts.Tool("plate"),
                               friction="frictionless", friction_base="frictionless")
    exact = ts.simulate(ts.Model(experiment, material, ts.Rig())).force
    for number in (1, 2, 3):
        force = exact + random.normal(0, 0.005) + random.normal(0, 0.01, time.size)
        ts.write_recording(ts.Recording({"time": time, "displacement": depth, "force": force}),
                           folder / f"plates_{number}.csv")
    return write(folder / "study.toml")


def write(path, method="inverse_fem", more=INVERSE):
    path.write_text(CAMPAIGN.format(method=method, more=more), encoding="utf-8")
    return path


@pytest.fixture(scope="module", autouse=True)
def two_effects():
    """Use two effects; the whole catalogue takes longer than all tests of this file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("calibration.diagnosis.proposals.CATALOGUE", EFFECTS)
        yield


def run(*words):
    return main(["diagnose", *map(str, words)])


@pytest.fixture(scope="module")
def answer(study, two_effects):
    """Output of ``--json``, and the result folder."""
    out, text = study.parent / "out", io.StringIO()
    with contextlib.redirect_stdout(text):
        assert run(study, "-o", out, "--json", "--figures-format", "svg") == 0
    return json.loads(text.getvalue()), out


def test_json_names_the_effect(answer):
    found, out = answer
    assert set(found) >= KEYS
    assert found == json.loads((out / "diagnosis.json").read_text(encoding="utf-8"))
    assert found["verdict"] == "NAMED" and [each["name"] for each in found["effects"]] == ["viscoelasticity"]
    numbers = {each["symbol"]: each for each in found["effects"][0]["parameters"]}
    for symbol, true in (("g1", G), ("tau1", TAU)):
        each = numbers[symbol]
        assert abs(each["value"] - true) < 4 * each["standard_error"] < true
    assert found["gap_after_N"] < 0.2 * found["gap_before_N"]
    hold = next(each for each in found["regions"] if each["segment"] == "hold")
    assert hold["before_sigma"] > 5 > 3 > hold["after_sigma"] and "the force falls by" in hold["sentence"]
    assert found["fit_after"]["parameters"]["C10"] == pytest.approx(C10, rel=0.01)
    assert found["fit_before"]["parameters"]["C10"] < 0.97 * C10, "the fit without the effect absorbs a part of it"
    (unseen,) = found["held_out"]
    assert unseen["after_N"] < unseen["before_N"] and unseen["adequate_after"] and not unseen["adequate_before"]
    assert {each["name"]: each["units"] for each in found["candidates"]}["machine_compliance"] == {
        "rig.compliance": "m/N"}


class Page(HTMLParser):
    """Open tags, pictures and texts of a page."""

    def __init__(self):
        super().__init__()
        self.open, self.pictures, self.first, self.texts = [], [], {}, []

    def handle_starttag(self, tag, attributes):
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)
        if tag == "img":
            self.pictures.append(dict(attributes)["src"][:22])

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        for tag in ("dt", "dd", "h2", "td"):
            if tag in self.open and data.strip():
                self.texts.append((tag, data.strip()))


def test_report_begins_with_the_verdict(answer):
    found, out = answer
    text = (out / "report.html").read_text(encoding="utf-8")
    page = Page()
    page.feed(text)
    assert page.open == [] and "http://" not in text and "https://" not in text
    assert page.texts[:2] == [("dt", "One effect"), ("dd", found["message"])]
    cells = [cell for tag, cell in page.texts if tag == "td"]
    assert "viscoelasticity" in cells and "machine compliance" in cells and any("mm/N" in cell for cell in cells)
    # Figures of one test, the regions and the candidates.
    assert page.pictures == ["data:image/png;base64,"] * 3
    assert {path.name for path in out.glob("*.svg")} == {
        "report_test_1_plates.svg", "report_regions.svg", "report_candidates.svg"}


def test_residuals_of_every_sample_are_written(answer):
    _, out = answer
    table = np.genfromtxt(out / "residuals.csv", delimiter=",", names=True, encoding="utf-8", dtype=None)
    assert table.size == 3 * 61 and set(table["segment"]) == {"ramp", "hold", "unload"}
    before, after = (table["measured_N"] - table[name] for name in ("model_before_N", "model_after_N"))
    assert np.std(after) == pytest.approx(0.01, rel=0.25) and np.std(before) > 2 * np.std(after)


def test_a_finished_diagnosis_is_read_from_its_folder(answer, study, capsys, monkeypatch):
    _, out = answer
    monkeypatch.setattr("calibration.campaign_diagnosis.diagnose_campaign", None)
    assert run(study, "-o", out) == 0
    text = capsys.readouterr().out
    assert text.startswith("study: NAMED\nViscoelasticity (g1 = ")
    assert "this diagnosis was already finished" in text and "mm/N" in text
    for word in ("hold: the force falls by", "dBIC", "C10", "plates/plates_3", "fits with the likeliest"):
        assert word in text


KILLED = """
import os, signal, sys
import calibration.diagnosis.proposals as proposals
from calibration.effects.rig import MachineCompliance
from calibration.effects.tissue import Viscoelasticity
from calibration.forward.simulation_cache import SimulationCache
from scenes.cli import main

proposals.CATALOGUE = {"viscoelasticity": Viscoelasticity, "machine_compliance": MachineCompliance}
keep, kept = SimulationCache.store_curve, []

def keep_some(solves, key, curve):
    keep(solves, key, curve)
    kept.append(key)
    if len(kept) == 14:
        os.kill(os.getpid(), signal.SIGKILL)

SimulationCache.store_curve = keep_some
main(sys.argv[1:])
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="Windows has no such signal")
@pytest.mark.usefixtures("undrawn")
def test_a_killed_run_resumes(answer, study, tmp_path, capsys):
    fresh, _ = answer
    out = tmp_path / "out"
    environment = child_environment()
    done = subprocess.run([sys.executable, "-c", KILLED, "diagnose", study, "-o", out], env=environment,
                          capture_output=True, check=False)
    assert done.returncode == -signal.SIGKILL
    kept = len(list((out / "solves").glob("*.msgpack")))
    assert kept >= 10 and not (out / "diagnosis.json").exists()
    assert run(study, "-o", out, "--json") == 0
    resumed = json.loads(capsys.readouterr().out)
    solved, all_of_them = (sum(stage["simulations"] for stage in each["stages"]) for each in (resumed, fresh))
    assert solved == all_of_them - kept
    ours, theirs = ({key: value for key, value in each.items() if key not in CLOCKS} for each in (resumed, fresh))
    for fit in ("fit_before", "fit_after"):
        for each in (ours, theirs):
            each[fit] = {key: value for key, value in each[fit].items() if key not in ("cpu_s", "fem_solves",
                                                                                       "estimate_cpu_s")}
    assert ours == theirs, "equal to the last digit"


@pytest.mark.parametrize(("method", "more", "words", "expected"), [
    ("analytical", "", [], 'method must be "inverse_fem" for a diagnosis, which simulates the tests; got "analytical"'),
    ("inverse_fem", INVERSE, ["--law", "ogden_1"],
     "law must be one of the laws of the campaign (neo_hooke); got 'ogden_1'"),
    ("inverse_fem", INVERSE.replace("C10 = 1500", "C10 = -1500"), [],
     "the values must give a valid material of neo_hooke"),
])
def test_bad_input_is_one_sentence(method, more, words, expected, study, tmp_path, capsys):
    for path in study.parent.glob("*.csv"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    before = set(tmp_path.iterdir())
    campaign = write(tmp_path / "bad.toml", method, more)
    assert run(campaign, "-o", tmp_path / "out", *words) == 2
    stdout, stderr = capsys.readouterr()
    assert stdout == "" and stderr.count("\n") == 1 and expected in stderr and "bad.toml" in stderr
    assert set(tmp_path.iterdir()) - before == {campaign}


def test_other_files_in_the_folder_are_kept(study, tmp_path, capsys):
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    assert run(study, "-o", tmp_path) == 2
    assert "Choose an empty folder or add --overwrite" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
