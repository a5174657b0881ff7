"""`tissue-sim design`: predicted accuracy of planned experiments as tables, as a page, as JSON and from Python."""

import json
from html.parser import HTMLParser

import pytest

from calibration import Design, evaluate_planned_experiments
from calibration.campaign.parameters import OFFSET_DEFAULTS
from calibration.diagnosis.settings import LIMITS
from calibration.effects.population import Population
from calibration.effects.rig import Backlash, MachineCompliance
from calibration.effects.tissue import Viscoelasticity
from calibration.forward.simulation_cache import SimulationCache
from scenes.cli import main
from tissue_sim.errors import InputError

PLAN = """
[[specimen]]
radius_mm = 20.0
height_mm = 30.0
[[test]]
name = "plates"
kind = "lubricated_compression"
protocol = "ramp 3mm @0.2mm/s; hold 30s; unload"
[fit]
method = "inverse_fem"
laws = ["neo_hooke"]
bulk_ratio = 10000.0
start = { C10 = 1500.0 }
[noise]
force_N = 0.01
contact_jitter_mm = 0.02
zero_jitter_N = 0.005
"""
RAMP = PLAN.replace("; hold 30s; unload", "")
EFFECTS = {"viscoelasticity": Viscoelasticity, "machine_compliance": MachineCompliance, "backlash": Backlash,
           "population": Population}


@pytest.fixture(autouse=True)
def few_effects(monkeypatch):
    """Use few effects; the whole catalogue takes longer than all tests of this file."""
    monkeypatch.setattr("calibration.diagnosis.proposals.CATALOGUE", EFFECTS)


def write(folder, text=PLAN, name="plan.toml"):
    (folder / name).write_text(text, encoding="utf-8")
    return folder / name


def test_json_contains_detectable_sizes(tmp_path, capsys):
    assert main(["design", str(write(tmp_path)), "--samples", "60", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["law"] == "neo_hooke" and found["parameters"] == {"C10": 1500.0} and found["units"] == {"C10": "Pa"}
    (test,) = found["tests"]
    assert (test["name"], test["recordings"], test["samples"], test["depth_mm"], test["duration_s"]) == (
        "plates", 3, 60, 3.0, 60.0)
    rows = {each["name"]: each for each in found["candidates"]}
    assert rows["population"]["reason"] == "all tests use one specimen, so variation between specimens is not tested"
    assert not rows["population"]["testable"]
    assert rows["population"]["separated_by"] == Population.separated_by
    # Lower bound of the detectable size: the effect changes every sample and the fit absorbs none of it.
    share, play = (rows[name]["seen_from"][path] for name, path in (
        ("viscoelasticity", "viscoelastic.terms[0].g"), ("backlash", "rig.backlash")))
    least = LIMITS.detectable_score * 0.01 / (test["force_N"] * (3 * 60) ** 0.5)
    assert least < share < 20 * least
    steepest = 2 * test["force_N"] / 3e-3
    least = LIMITS.detectable_score * 0.01 / (steepest * (3 * 15) ** 0.5)
    assert least < play < 20 * least
    assert [path.name for path in tmp_path.iterdir()] == ["plan.toml"], "nothing is written"


def test_more_recordings_and_a_hold_improve_the_design(tmp_path):
    path = write(tmp_path)
    one, four = (evaluate_planned_experiments(path, replicates=n, samples=60) for n in (1, 4))
    assert isinstance(four, Design) and [test.recordings for test in four.tests] == [4]
    # Noise, contact and zero of the recordings are independent.
    assert one.standard_errors["C10"] == pytest.approx(2.0 * four.standard_errors["C10"], rel=0.05)
    ramp = evaluate_planned_experiments(write(tmp_path, RAMP, "ramp.toml"), replicates=4, samples=60)
    held, ramped = ({each.name: each for each in design.candidates} for design in (four, ramp))
    assert held["backlash"].testable and not ramped["backlash"].testable
    assert "has an unloading" in ramped["backlash"].reason
    relaxing = [rows["viscoelasticity"].seen_from["viscoelastic.terms[0].g"] for rows in (held, ramped)]
    assert relaxing[1] > 5 * relaxing[0]


def test_tables_use_display_units(tmp_path, capsys):
    assert main(["design", str(write(tmp_path)), "--samples", "60", "--replicates", "2"]) == 0
    text = capsys.readouterr().out
    assert text.startswith("plan: Neo-Hooke, sensor noise 10 mN")
    for word in ("plates", "3 mm", "60 s", "C10", "1.500 ±", "kPa", "mm/N", "backlash", "scatter between specimens",
                 "all tests use one specimen", Population.separated_by):
        assert word in text, word


def test_default_scatter_is_proportional_to_the_force(tmp_path):
    unstated = evaluate_planned_experiments(write(tmp_path, PLAN.replace("zero_jitter_N = 0.005\n", "")), samples=60)
    share = OFFSET_DEFAULTS.first_zero * unstated.tests[0].force_N
    stated = evaluate_planned_experiments(write(tmp_path,
                                                PLAN.replace("zero_jitter_N = 0.005", f"zero_jitter_N = {share}")),
                                          samples=60)
    assert unstated.standard_errors["C10"] == pytest.approx(stated.standard_errors["C10"], rel=1e-3)


@pytest.mark.parametrize(("old", "new", "expected"), [
    ("force_N = 0.01\n", "", "state the standard deviation of the force sensor"),
    ("; hold 30s; unload", "; hold 30", "'30'"),
    ("ramp 3mm", "ramp 30mm", "plan.toml: test[0].protocol"),
    ("ramp 3mm @0.2mm/s", "ramp 3N @0.2N/s", "test[0].protocol: must prescribe displacements for a planned test"),
    ("start = { C10 = 1500.0 }\n", "", "fit.start must give the material of a design; state C10"),
    ('"inverse_fem"', '"analytical"', "inverse_fem"),
    ("protocol =", "protokol =", "protokol"),
], ids=["noise", "protocol", "depth", "force", "start", "method", "key"])
def test_bad_input_is_one_sentence(old, new, expected, tmp_path, capsys):
    assert main(["design", str(write(tmp_path, PLAN.replace(old, new)))]) == 2
    stdout, stderr = capsys.readouterr()
    assert stdout == "" and stderr.count("\n") == 1 and expected in stderr and "plan.toml" in stderr


def test_too_few_samples_or_replicates_are_refused(tmp_path):
    for wrong, words in (({"samples": 3}, "samples must be at least 20; got 3"),
                         ({"replicates": 0}, "replicates must be at least 1; got 0")):
        with pytest.raises(InputError, match=words):
            evaluate_planned_experiments(write(tmp_path), **wrong)


def run(folder, *words):
    return main(["design", str(folder / "plan.toml"), "--samples", "60", *map(str, words)])


class Cells(HTMLParser):
    """Texts of the cells of all tables of a page, without blanks, and the number of pictures."""

    def __init__(self):
        super().__init__()
        self.cells, self.pictures, self.inside = [], 0, False

    def handle_starttag(self, tag, attributes):
        self.pictures += tag == "img"
        if tag in ("td", "th"):
            self.cells.append("")
            self.inside = True

    def handle_endtag(self, tag):
        self.inside &= tag not in ("td", "th")

    def handle_data(self, data):
        if self.inside:
            self.cells[-1] += "".join(data.split())


#: The plan with a held-out needle test, which has no figure.
WITH_NEEDLE = PLAN.replace("[fit]", """[[test]]
name = "needle"
kind = "needle_indentation"
tool = "flat"
tool_radius_mm = 8.0
protocol = "ramp 2mm @0.2mm/s"
hold_out = true
[fit]""")


def test_page_terminal_and_json_show_the_same_tables(tmp_path, capsys, monkeypatch):
    write(tmp_path, WITH_NEEDLE)
    out = tmp_path / "out"
    assert run(tmp_path, "-o", out, "--figures-format", "svg") == 0
    text = capsys.readouterr().out
    assert text.endswith(f"report: {out / 'report.html'}\n")
    assert sorted(path.name for path in out.iterdir()) == ["design.json", "report.html", "report_test_1_plates.svg",
                                                           "solves", "work.json"]
    content = (out / "report.html").read_text(encoding="utf-8")
    page = Cells()
    page.feed(content)
    assert page.pictures == 1 and "http://" not in content and "https://" not in content
    found = json.loads((out / "design.json").read_text(encoding="utf-8"))
    printed = "".join(text.split())
    assert {each["name"] for each in found["candidates"]} == set(EFFECTS)
    for each in found["candidates"]:
        assert "".join(each["title"].split()) in page.cells and "".join(each["title"].split()) in printed
    numbers = [each for each in page.cells if "±" in each or "mm/N" in each or each.startswith("g1")]
    assert len(numbers) == 3 and {"plates", "C10"} < {*page.cells}
    assert all(each in printed for each in (*numbers, "plates", "C10"))

    # The same command reads the folder: a computation would call this function.
    monkeypatch.setattr("calibration.campaign_design.simulate_noise_free_evidence", None)
    assert run(tmp_path, "-o", out, "--figures-format", "svg", "--json") == 0
    again = json.loads(capsys.readouterr().out)
    assert again == {key: value for key, value in found.items() if key not in ("work", "figures")}


def test_results_of_another_design_need_overwrite(tmp_path, capsys):
    write(tmp_path, RAMP)
    out = tmp_path / "out"
    assert run(tmp_path, "-o", out) == 0
    (out / "notes.txt").write_text("mine", encoding="utf-8")
    first = (out / "design.json").read_bytes()
    write(tmp_path)
    capsys.readouterr()
    assert run(tmp_path, "-o", out) == 2
    assert "Choose an empty folder or add --overwrite" in capsys.readouterr().err
    assert (out / "design.json").read_bytes() == first
    assert run(tmp_path, "-o", out, "--overwrite") == 0
    assert (out / "design.json").read_bytes() != first
    assert (out / "notes.txt").read_text(encoding="utf-8") == "mine"


def test_the_folder_is_checked_before_the_simulations(tmp_path, capsys, monkeypatch):
    write(tmp_path)
    out = tmp_path / "out"
    out.mkdir()
    (out / "notes.txt").write_text("mine", encoding="utf-8")
    # A simulation would call this function.
    monkeypatch.setattr("calibration.campaign_design.simulate_expected_recordings", None)
    assert run(tmp_path, "-o", out) == 2
    assert "Choose an empty folder or add --overwrite" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == ["notes.txt"]


def test_figures_are_added_to_a_report_without_figures(tmp_path):
    path, out = write(tmp_path), tmp_path / "out"

    def count_pictures(**options):
        evaluate_planned_experiments(path, samples=60, output=out, **options)
        page = Cells()
        page.feed((out / "report.html").read_text(encoding="utf-8"))
        return page.pictures

    assert count_pictures(figures=False) == 0
    assert count_pictures() == 1
    # A report with figures contains that without figures.
    assert count_pictures(figures=False) == 1


@pytest.mark.parametrize("words", [["--overwrite"], ["--figures-format", "png"]])
def test_flags_of_the_folder_need_a_folder(words, tmp_path, capsys):
    write(tmp_path)
    assert run(tmp_path, *words) == 2
    assert "need an output folder; add -o OUT" in capsys.readouterr().err


def test_an_interrupted_design_says_how_to_resume(tmp_path, capsys, monkeypatch):
    write(tmp_path)
    out, fresh = tmp_path / "out", tmp_path / "fresh"
    store = SimulationCache.store_curve

    def store_two(cache, key, curve):
        if cache.folder is not None and len(list(cache.folder.glob("*.msgpack"))) == 2:
            raise KeyboardInterrupt
        store(cache, key, curve)

    with monkeypatch.context() as patch:
        patch.setattr(SimulationCache, "store_curve", store_two)
        assert run(tmp_path, "-o", out) == 130
    stdout, stderr = capsys.readouterr()
    assert stdout == "" and stderr.endswith(f"2 simulations are kept in {out / 'solves'}. Run the same command to "
                                            "resume\n")
    kept = {path: path.read_bytes() for path in (out / "solves").iterdir()}
    assert len(kept) == 2 and {path.name for path in out.iterdir()} == {"solves", "work.json"}
    assert run(tmp_path, "-o", out) == 0 and run(tmp_path, "-o", fresh) == 0
    assert {path: path.read_bytes() for path in kept} == kept, "no simulation is repeated"
    assert (out / "design.json").read_bytes() == (fresh / "design.json").read_bytes()
    assert (out / "report.html").read_bytes() == (fresh / "report.html").read_bytes()


def test_a_plan_without_start_writes_nothing(tmp_path, capsys):
    write(tmp_path, PLAN.replace("start = { C10 = 1500.0 }\n", ""))
    assert run(tmp_path, "-o", tmp_path / "out") == 2
    assert "fit.start must give the material of a design" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["plan.toml"]
