"""A fit, a diagnosis and a design are interrupted at any time: the same call resumes, and no file is half written."""

import importlib
import json
import signal
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
from child_environment import child_environment

import calibration
import tissue_sim as ts
from calibration.forward.simulation_cache import SimulatedForceOrFailure

HEAD = """
[[specimen]]
radius_mm = 20.0
height_mm = 30.0
[[test]]
name = "plates"
kind = "lubricated_compression"
{source}
[fit]
method = "inverse_fem"
laws = ["neo_hooke"]
bulk_ratio = 10000.0
starts = 1
start = {{ {start} }}
[noise]
force_N = 0.01
correlation_time_s = 0
contact_jitter_mm = 0.02
zero_jitter_N = 0.005
"""
KINDS = ("fit", "diagnosis", "design")
INTERRUPTIONS = [("SIGINT", "half of the simulations"), ("SIGKILL", "half of the simulations"),
                 ("SIGKILL", "writing of the result")]
#: Keys of the results that differ from run to run.
CLOCKS = {"stages", "output", "cpu_s", "estimate_cpu_s", "fem_solves"}

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="Windows has no SIGKILL")]


@pytest.fixture(scope="module")
def jobs():
    """The program that interrupts itself, as a module."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(Path(__file__).parent)
        yield importlib.import_module("interrupted_jobs")


@pytest.fixture(scope="module")
def campaigns(tmp_path_factory):
    """Kind of job -> campaign file: recordings of a relaxing tissue, or a plan of the same test."""
    folder, random = tmp_path_factory.mktemp("relaxing"), np.random.default_rng(3)
    time = np.linspace(0.0, 60.0, 61)
    depth = np.interp(time, [0, 15, 45, 60], [0, 3e-3, 3e-3, 0])
    material = ts.Material("neo_hooke", {"C10": 1404.9}, ts.Bulk("bulk_ratio", 1e4),
                           viscoelastic=ts.Prony((ts.PronyTerm(0.15, 12.0),)))
    experiment = ts.Experiment(ts.Specimen(0.020, 0.030), ts.Protocol(time, depth), ts.Tool("plate"),
                               friction="frictionless", friction_base="frictionless")
    exact = ts.simulate(ts.Model(experiment, material, ts.Rig())).force
    for number in (1, 2):
        force = exact + random.normal(0, 0.01, time.size)
        ts.write_recording(ts.Recording({"time": time, "displacement": depth, "force": force}),
                           folder / f"plates_{number}.csv")
    recorded, planned = 'recordings = ["plates_*.csv"]', 'protocol = "ramp 3mm @0.2mm/s; hold 30s; unload"'
    files = {}
    relaxing = ', "viscoelastic.terms[0].g" = 0.1, "viscoelastic.terms[0].tau_s" = 10.0'
    for kind, source, more in (("fit", recorded, relaxing), ("diagnosis", recorded, ""), ("design", planned, "")):
        files[kind] = folder / f"{kind}.toml"
        files[kind].write_text(HEAD.format(source=source, start="C10 = 1500.0" + more), encoding="utf-8")
    return files


@pytest.fixture(scope="module", params=KINDS)
def finished(request, jobs, campaigns, tmp_path_factory):
    """Kind of a job, its campaign file, and the folder of a run without interruption."""
    out = tmp_path_factory.mktemp("finished") / "out"
    jobs.run_job(request.param, campaigns[request.param], out)
    return request.param, campaigns[request.param], out


def read_result(folder, name):
    """Content of the result without the times and numbers of simulations."""
    def drop(value):
        if isinstance(value, dict):
            return {key: drop(each) for key, each in value.items() if key not in CLOCKS}
        return [drop(each) for each in value] if isinstance(value, list) else value
    return drop(json.loads((folder / name).read_text(encoding="utf-8")))


def list_files(folder):
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file())


def interrupt(jobs, kind, campaign, out, name, simulations):
    """Run a job in a process that interrupts itself, and check how the process ended."""
    ended = subprocess.run([sys.executable, jobs.__file__, kind, campaign, out, str(int(getattr(signal, name))),
                            str(simulations)], env=child_environment(), capture_output=True, text=True, check=False)
    assert ended.returncode == -getattr(signal, name), ended.stderr


@pytest.mark.parametrize(("name", "moment"), INTERRUPTIONS)
def test_the_same_call_resumes(name, moment, finished, jobs, tmp_path):
    kind, campaign, fresh = finished
    out, result = tmp_path / "out", jobs.RESULT_FILES[kind]
    simulations = [file for file in list_files(fresh) if file.startswith("solves/")]
    half = len(simulations) // 2
    interrupt(jobs, kind, campaign, out, name, half if moment == "half of the simulations" else 0)

    kept = list((out / "solves").glob("*.msgpack"))
    assert (out / "work.json").is_file() and not (out / result).exists()
    assert len(kept) == (half if moment == "half of the simulations" else len(simulations)) > 0
    for file in kept:
        msgspec.msgpack.decode(file.read_bytes(), type=SimulatedForceOrFailure)
    contents = {file: file.read_bytes() for file in kept}

    jobs.run_job(kind, campaign, out)
    assert read_result(out, result) == read_result(fresh, result), "equal to the last digit"
    assert list_files(out) == list_files(fresh), "all kept simulations are used, and no temporary file is left"
    # A repeated simulation would have another processor time.
    assert {file: file.read_bytes() for file in kept} == contents, "no simulation is repeated"
    before = (out / result).stat().st_mtime_ns
    jobs.run_job(kind, campaign, out)
    assert (out / result).stat().st_mtime_ns == before, "a finished job is read"


@pytest.mark.parametrize("name", ["SIGINT", "SIGKILL"])
def test_a_design_without_a_folder_writes_nothing(name, jobs, campaigns, tmp_path):
    plan = tmp_path / "plan.toml"
    plan.write_bytes(campaigns["design"].read_bytes())
    interrupt(jobs, "design without a folder", plan, tmp_path / "out", name, 2)
    assert list_files(tmp_path) == ["plan.toml"]
    design = calibration.evaluate_planned_experiments(plan, samples=60)
    assert design.parameters == {"C10": 1500.0} and list_files(tmp_path) == ["plan.toml"]
