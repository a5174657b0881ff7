"""`tissue-sim calibrate` with finite elements: output, progress, interrupted runs and several campaigns."""

import contextlib
import csv
import io
import json
import re
import signal
import subprocess
import sys

import numpy as np
import pytest
from child_environment import child_environment
from rich.console import Console
from scipy.interpolate import PchipInterpolator

import calibration.fit.generalised as generalised
import tissue_sim as ts
from calibration.tasks.executors import open_task_executor
from scenes.cli import main
from scenes.commands.shared.console import PrintedTableLimits
from scenes.commands.shared.progress import CampaignProgressDisplay
from tissue_sim.errors import ConvergenceError, WorkerError

HEAD = """
[[specimen]]
radius_mm = 40.0
height_mm = 70.0
"""
TEST = """
[[test]]
name = "{name}"
kind = "{name}_compression"
recordings = ["{name}_*.csv"]
max_strain = {strain}
hold_out = {hold_out}
"""
FIT = """
[fit]
method = "inverse_fem"
laws = [{laws}]
bulk_ratio = 10000.0
{more}
[noise]
force_N = 0.02
correlation_time_s = 0
contact_jitter_mm = 0.03
zero_jitter_N = 0.01
"""
START = "starts = 1\nstart = { C10 = 1400.0, C20 = 600.0 }"


@pytest.fixture(scope="module")
def measured(reference, tmp_path_factory):
    """Folder with two replicates of bonded and lubricated compression, from curves of an independent solver."""
    folder = tmp_path_factory.mktemp("measured")
    random = np.random.default_rng(11)
    displacement = np.linspace(0, 0.010, 41)
    for name in ("lubricated", "bonded"):
        curve = np.loadtxt(reference / f"{name}_RP.csv", delimiter=",", comments="#")
        exact = PchipInterpolator(*curve.T)
        for replicate in (1, 2):
            depth = displacement * 1e3 - random.normal(0, 0.03)
            force = exact(np.maximum(depth, 0)) + random.normal(0, 0.01) + random.normal(0, 0.02, depth.size)
            recording = ts.Recording({"time": displacement / 0.248e-3, "displacement": displacement, "force": force})
            ts.write_recording(recording, folder / f"{name}_{replicate}.csv")
    return folder


@pytest.fixture
def write(measured, tmp_path):
    """Function that writes a campaign in the folder of its recordings."""
    for path in measured.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())

    def campaign(name="study", tests=("lubricated", "bonded"), laws=("reduced_polynomial_2",), more=START, strain=0.14,
                 held_out=()):
        text = HEAD + "".join(TEST.format(name=test, strain=strain, hold_out=str(test in held_out).lower())
                              for test in tests)
        path = tmp_path / f"{name}.toml"
        path.write_text(text + FIT.format(laws=", ".join(f'"{law}"' for law in laws), more=more), encoding="utf-8")
        return path
    return campaign


@pytest.fixture
def joint(write):
    return write()


@pytest.fixture(autouse=True)
def without_pictures(monkeypatch):
    """Skip the figures of the reports, which take longer than the fits."""
    monkeypatch.setattr("calibration.report.drawing.FigureEmbedder.draw_figure_or_none", lambda self, figure: None)


def run(*words):
    return main(["calibrate", *map(str, words)])


def read(folder):
    return json.loads((folder / "fit.json").read_text(encoding="utf-8"))


def simulations(folder):
    return {path.name for path in (folder / "solves").iterdir()}


@pytest.mark.slow
def test_json_contains_the_whole_iteration_table(joint, tmp_path, capsys):
    assert run(joint, "-o", tmp_path / "out", "--json") == 0
    stdout, stderr = capsys.readouterr()
    answer = json.loads(stdout)
    assert stderr == "" and answer == read(tmp_path / "out")
    (fit,) = answer["fits"]
    assert fit["parameters"]["C10"] == pytest.approx(1404.9, rel=0.005)
    assert [row["run"] for row in fit["history"]] == list(range(1, fit["iterations"] + 1))
    assert fit["history"][0]["parameters"] == {"C10": 1400.0, "C20": 600.0}
    assert not fit["history"][0]["corrected"] and fit["history"][-1]["corrected"]


@pytest.mark.slow
def test_results_fit_on_80_columns(write, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("scenes.commands.shared.console.TABLES", PrintedTableLimits(pipe_width=80))
    path = write(laws=("neo_hooke", "reduced_polynomial_2"), more="starts = 1")
    assert run(path, "-o", tmp_path / "out") == 0
    stdout, stderr = capsys.readouterr()
    assert stderr == "", "no progress without a terminal"
    answer = read(tmp_path / "out")
    lines = stdout.splitlines()
    end = lines.index(answer["message"])
    assert all(len(line) <= 80 and "…" not in line for line in lines[:end] if not line.startswith(("*", "%")))
    text = "\n".join(lines)
    best = answer["fits"][0]
    ranking = next(line.split() for line in lines if line.startswith(f"{answer['best']} *"))
    assert ranking[2:5] == [f"{best['left_out']:.3g}", f"{best['R2']:.5f}", f"{best['RMSE_N']:.4g}"]
    C10, error = best["parameters"]["C10"], best["standard_errors"]["C10"]
    low, high = best["intervals95"]["C10"]
    row = next(line for line in lines if re.match(r" *C10 ", line) and f"{C10 / 1e3:.4f} ±" in line)
    # Within these limits the error is printed with these digits.
    assert 1.0 < error < 3.545 and row.split() == ["C10", f"{C10 / 1e3:.4f}", "±", f"{error / 1e3:.4f}", "kPa",
                                                   f"{low / 1e3:.4f}", "to", f"{high / 1e3:.4f}"]
    for p in answer["predictions"]:
        assert re.search(rf"{p['test']} +left out +{p['RMSE_N']:.3g} N +{p['percent']:.2g} ", text)
    assert "left out %" in text and "noise: 0.02 N stated, white; scatter between recordings 0.03 mm of contact" in text
    for fit in answer["fits"]:
        begin = f"{fit['law']}: {fit['iterations']} solves from 1 start"
        effort = next(line for line in lines if line.startswith(begin))
        assert f", {fit['fem_solves']} simulated test" in effort
        assert effort.endswith(f" {fit['cpu_s']:.3g} s of processor time")
    # The neo-Hookean law cannot fit the curvature: its misfit is printed with range and size.
    (worse,) = (fit for fit in answer["fits"] if fit["law"] == "neo_hooke")
    assert not all(region["adequate"] for region in worse["regions"])
    assert re.search(r"neo_hooke: smooth misfit in \w+ \([\w ,.]+ mm\): 0\.\d+ N, p [=<] ", text)
    assert f"{answer['best']}: no smooth misfit in any of {len(best['regions'])} regions" in text


@pytest.mark.slow
def test_the_held_out_test_ranks_the_laws(write, tmp_path, capsys):
    assert run(write(held_out=("bonded",)), "-o", tmp_path / "out") == 0
    text = capsys.readouterr().out
    (prediction,) = read(tmp_path / "out")["predictions"]
    assert prediction["test"] == "bonded" and prediction["percent"] < 1
    assert "held out %" in text
    assert re.search(rf"bonded +held out +{prediction['RMSE_N']:.3g} N", text)


@pytest.mark.slow
def test_unidentifiable_parameters_are_reported(write, tmp_path, capsys):
    """A shallow test does not determine C20: its bound truncates the interval, and a deeper test is suggested."""
    # A shallower test would give a negative C20, with which deeper tests take long to simulate.
    path = write(tests=("lubricated",), strain=0.06,
                 more=START + "\nbounds = { C20 = [-1000.0, 30000.0] }")
    run(path, "-o", tmp_path / "out")
    text = capsys.readouterr().out
    (fit,) = read(tmp_path / "out")["fits"]
    assert fit["not_identifiable"] == ["C20"] and fit["interval_notes"]["C20"] == "low: bound -1000"
    assert "cut intervals: C20 low: bound -1000" in text and "(cut)" in text
    better = fit["suggestions"][0]
    assert better["standard_errors"]["C20"] < 0.1 * fit["standard_errors"]["C20"]
    assert f"not identifiable from these tests: C20; {better['test']} would give C20 ± " in text
    assert "dBIC" in text, "a single test has no prediction"


def terminal(monkeypatch, height=24):
    """Stream that receives the stderr of a terminal of 80 columns."""
    stream = io.StringIO()
    monkeypatch.setattr("scenes.commands.shared.campaigns.make_progress_console",
                        lambda quiet: Console(file=stream, force_terminal=True, width=80, height=height, quiet=quiet,
                                              legacy_windows=False, _environ={"TERM": "xterm"}))
    return stream


def frames(stream):
    """Return the successive frames of a live display as lists of lines."""
    plain = re.split(r"(?:\r?\x1b\[2K(?:\x1b\[1A)?)+", stream.getvalue())
    return [re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", frame).splitlines() for frame in plain]


@pytest.mark.slow
def test_iteration_table_is_live_on_a_terminal(joint, tmp_path, capsys, monkeypatch):
    stream = terminal(monkeypatch)
    assert run(joint, "-o", tmp_path / "out") == 0
    stdout, stderr = capsys.readouterr()
    assert "run" not in stdout.split() and "corrected" not in stdout.split() and stderr == ""
    shown = frames(stream)
    for sentence in ("checking the start values of reduced_polynomial_2", "1 start",
                     "the difference of the accurate mesh",
                     "profiles", "tests left out, one at a time", "writing the report"):
        assert any(f"study: {sentence}" in frame for frame in shown)
    (fit,) = read(tmp_path / "out")["fits"]
    last = next(frame for frame in reversed(shown) if any("corrected" in line for line in frame))
    assert last[0].strip() == "reduced_polynomial_2"
    assert last[1].split() == ["start", "run", "C10", "Pa", "C20", "Pa", "error", "RMSE", "mesh"]
    rows = [line.split() for line in last[2:] if re.match(r" *\d+ +\d+ ", line)]
    assert rows == [["1", str(row["run"]), f"{row['parameters']['C10']:.5g}", f"{row['parameters']['C20']:.5g}",
                     f"{row['error']:.6g}", f"{row['RMSE_N']:.3g}", "corrected" if row["corrected"] else "fast"]
                    for row in fit["history"]][-12:]
    assert any(f"{len(fit['history'])} solves" in line for line in last)


def test_remaining_time_follows_from_the_finished_tasks(monkeypatch):
    stream, now = terminal(monkeypatch), [100.0]
    monkeypatch.setattr("scenes.commands.shared.progress.time.monotonic", lambda: now[0])
    console = Console(file=stream, force_terminal=True, width=120, quiet=True)
    progress = CampaignProgressDisplay(console)

    def shown():
        with console.capture() as captured:
            console.quiet = False
            console.print(progress.render_display())
        return captured.get()

    progress.show_task("study: profiles", 0, 8)
    now[0] = 120.0
    assert "left" not in shown(), "no task is finished yet"
    progress.show_task("study: profiles", 2, 8)
    assert "about 1:00 remaining in this part" in shown()
    now[0] = 130.0
    assert "about 0:50 remaining in this part" in shown(), "the estimate decreases between tasks"
    progress.show_task("study: profiles: C20", 2, 8)
    assert "about 1:30 remaining in this part" in shown(), "a new sentence does not start a new part"
    progress.show_task("study: tests left out, one at a time", 0, 3)
    assert "remaining in this part" not in shown(), "another part"


@pytest.mark.slow
def test_the_table_fits_on_a_low_terminal(joint, tmp_path, monkeypatch):
    stream = terminal(monkeypatch, height=12)
    assert run(joint, "-o", tmp_path / "out") == 0
    counts = [sum(bool(re.match(r" *\d+ +\d+ ", line)) for line in frame) for frame in frames(stream)]
    assert max(counts) == 4 and max(map(len, frames(stream))) <= 12


@pytest.mark.slow
def test_json_is_quiet_on_a_terminal(joint, tmp_path, monkeypatch):
    stream = terminal(monkeypatch)
    assert run(joint, "-o", tmp_path / "out", "--json") == 0
    assert stream.getvalue() == ""


@pytest.mark.slow
@pytest.mark.parametrize("overwrite", [False, True])
def test_ctrl_c_keeps_the_simulations(overwrite, joint, tmp_path, capsys, monkeypatch):
    out = tmp_path / "out"
    words = [joint, "-o", out, *(["--overwrite"] if overwrite else [])]

    def interrupted(*arguments, **keywords):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(generalised, "compute_estimate_from_minimum", interrupted)
        assert run(*words) == 130
    count = len(simulations(out))
    assert count > 2, "more than the simulations of the start"
    how = " without --overwrite" if overwrite else ""
    assert capsys.readouterr().err == (f"tissue-sim: stopped by Ctrl-C; {count} simulations are kept in "
                                       f"{out / 'solves'}. Run the same command{how} to resume\n")
    assert run(joint, "-o", out, "--json") == 0
    resumed = json.loads(capsys.readouterr().out)["fits"][0]
    assert run(joint, "-o", tmp_path / "fresh", "--json") == 0
    fresh = json.loads(capsys.readouterr().out)["fits"][0]
    assert resumed["fem_solves"] < fresh["fem_solves"] and resumed["parameters"] == fresh["parameters"]


@pytest.mark.slow
def test_ctrl_c_before_the_folder_is_claimed(joint, tmp_path, capsys, monkeypatch):
    """Old results that --overwrite would have replaced are not reported as results of this command."""
    out = tmp_path / "out"
    assert run(joint, "-o", out, "--json") == 0
    capsys.readouterr()

    def interrupted(*arguments):
        raise KeyboardInterrupt

    joint.write_text(joint.read_text(encoding="utf-8").replace("1400.0", "1500.0"), encoding="utf-8")
    monkeypatch.setattr(generalised, "require_fittable_start", interrupted)
    assert run(joint, "-o", out, "--overwrite") == 130
    assert "no campaign was finished" in capsys.readouterr().err
    assert (out / "fit.json").is_file()


KILLED = """
import os, signal, sys
from calibration.forward.simulation_cache import SimulationCache
from scenes.cli import main
from scenes.commands.shared.progress import CampaignProgressDisplay

keep, kept = SimulationCache.store_curve, []

def keep_some(solves, key, curve):
    keep(solves, key, curve)
    kept.append(key)
    if len(kept) == {count}:
        os.kill(os.getpid(), signal.SIGKILL)

SimulationCache.store_curve = keep_some
main(sys.argv[1:])
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="Windows has no such signal")
def test_a_killed_run_resumes(joint, tmp_path, capsys):
    out = tmp_path / "out"
    environment = child_environment()
    done = subprocess.run([sys.executable, "-c", KILLED.format(count=12), "calibrate", joint, "-o", out],
                          env=environment, capture_output=True, check=False)
    assert done.returncode == -signal.SIGKILL
    kept = simulations(out)
    assert len(kept) > 5 and not (out / "fit.json").exists()
    assert run(joint, "-o", out, "--json") == 0
    resumed = json.loads(capsys.readouterr().out)["fits"][0]
    assert run(joint, "-o", tmp_path / "fresh", "--json") == 0
    fresh = json.loads(capsys.readouterr().out)["fits"][0]
    assert simulations(out) == simulations(tmp_path / "fresh"), "all kept simulations are used"
    assert resumed["fem_solves"] == fresh["fem_solves"] - len(kept)
    assert resumed["parameters"] == fresh["parameters"] and resumed["intervals95"] == fresh["intervals95"]


@pytest.mark.slow
def test_summary_of_several_campaigns(write, tmp_path, capsys):
    """Inverse and analytical campaigns, and a parameter that is no parameter of the law."""
    inverse = write("inverse", more=START + '\nfixed = { "bulk.bulk_ratio" = 5000.0 }')
    inverse.write_text(inverse.read_text(encoding="utf-8").replace("bulk_ratio = 10000.0\n", ""), encoding="utf-8")
    analytical = tmp_path / "analytical.toml"
    analytical.write_text(HEAD + TEST.format(name="lubricated", strain=0.14, hold_out="false")
                          + '[fit]\nlaws = ["neo_hooke", "ogden_1"]\n[noise]\nforce_N = 0.02\n', encoding="utf-8")
    out = tmp_path / "out"
    assert run(inverse, analytical, "-o", out) == 0
    assert f"wrote {out / 'summary.csv'}" in capsys.readouterr().out
    with (out / "summary.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    (fit,) = read(out / "inverse")["fits"]
    assert [(row["campaign"], row["rank"]) for row in rows] == [("inverse", "1"), ("analytical", "1"),
                                                                ("analytical", "2")]
    first = rows[0]
    for column, value in {
            "C10 [Pa]": fit["parameters"]["C10"], "C10 standard error [Pa]": fit["standard_errors"]["C10"],
            "C20 low95 [Pa]": fit["intervals95"]["C20"][0], "C20 high95 [Pa]": fit["intervals95"]["C20"][1],
            "bulk.bulk_ratio [-]": 5000.0, "left_out [%]": fit["left_out"], "RMSE [N]": fit["RMSE_N"],
            "fem_solves": fit["fem_solves"], "noise_ratio": fit["noise_ratio"]}.items():
        assert float(first[column]) == pytest.approx(value), column
    assert first["RMSE [Pa]"] == "" and first["alpha1 [-]"] == ""
    assert {row["left_out [%]"] for row in rows[1:]} == {""} and {row["fem_solves"] for row in rows[1:]} == {"0"}


@pytest.mark.parametrize("kind", [WorkerError, ConvergenceError])
def test_a_failed_fit_is_exit_code_1(kind, joint, tmp_path, capsys, monkeypatch):
    def ends(*arguments, **keywords):
        raise kind("the fit stopped")

    monkeypatch.setattr(generalised, "descend_from_start", ends)
    assert run(joint, "-o", tmp_path / "out", "--json") == 1
    stdout, stderr = capsys.readouterr()
    assert stdout == "" and stderr == "tissue-sim: the fit stopped\n"


@pytest.mark.parametrize(("words", "expected"), [
    (["--workers", "0"], "--workers: must be a whole number of at least 1; got '0'"),
    (["--workers", "2", "--dask", "tcp://127.0.0.1:8786"], "--dask: not allowed with argument --workers"),
    (["--dask", "nowhere at all"], "dask: "),
])
def test_bad_workers(words, expected, joint, tmp_path, capsys):
    assert run(joint, "-o", tmp_path / "out", *words) == 2
    stdout, stderr = capsys.readouterr()
    assert stdout == "" and stderr.count("\n") == 1 and expected in stderr
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_number_of_workers_reaches_the_calibration(joint, tmp_path, monkeypatch):
    asked = []

    @contextlib.contextmanager
    def inline(workers):
        asked.append(workers)
        with open_task_executor(type(workers)()) as tasks:
            yield tasks

    monkeypatch.setattr("calibration.pipeline.open_task_executor", inline)
    assert run(joint, "-o", tmp_path / "out", "--workers", "3") == 0
    assert [(workers.count, workers.dask) for workers in asked] == [(3, None)]


@pytest.mark.parametrize(("old", "new", "expected"), [
    ("C20 = 600.0", "C20 = -9000.0", "fit.start"),
    ("C20 = 600.0", "C02 = 600.0", "did you mean 'C20'?"),
    ("lubricated_*.csv", "lubricate_*.csv", "recordings"),
    ("height_mm = 70.0", "height_mm = 7.0", "must be smaller than the height"),
])
def test_bad_campaign_writes_nothing(old, new, expected, joint, tmp_path, capsys):
    joint.write_text(joint.read_text(encoding="utf-8").replace(old, new, 1), encoding="utf-8")
    assert run(joint, "-o", tmp_path / "out", "--json") == 2
    stdout, stderr = capsys.readouterr()
    assert stdout == "" and stderr.count("\n") == 1
    assert expected in stderr and "study.toml" in stderr
    assert not (tmp_path / "out").exists()
