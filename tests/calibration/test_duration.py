"""Progress and expected duration of a diagnosis, before and while it runs."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

import calibration
import tissue_sim as ts
from calibration import campaign_diagnosis
from calibration.campaign_diagnosis import describe_expected_duration_or_empty, measure_solid_simulation_cpu_s_by_test
from calibration.diagnosis.evidence import make_one_law_whole_recording_campaign
from calibration.effects.rig import MachineCompliance
from calibration.effects.tissue import Viscoelasticity
from calibration.fit.problem import build_generalised_problem
from calibration.fit.run_context import RunContext
from calibration.forward.meshes import MESHES, SolverFitResolutions
from calibration.forward.simulation_cache import SimulationCache
from calibration.tasks.executors import TaskExecutor
from tissue_sim.fem.solid.discretisation import RESOLUTIONS, Resolution
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1

CAMPAIGN = """
[[specimen]]
shape = "block"
length_mm = 20.0
width_mm = 20.0
height_mm = 20.0
[[test]]
name = "glued"
kind = "bonded_compression"
recordings = ["run_*.csv"]
[fit]
method = "inverse_fem"
laws = ["neo_hooke"]
bulk_ratio = 1000.0
starts = 1
start = { C10 = 450.0 }
[noise]
force_N = 0.001
correlation_time_s = 0
contact_jitter_mm = 0.01
zero_jitter_N = 0.001
"""


@pytest.fixture
def glued(tmp_path, monkeypatch):
    """A glued cube on two orders of one mesh of 64 elements, with a load train that takes up a sixth of the way."""
    monkeypatch.setitem(RESOLUTIONS, "coarse", Resolution(HEX8P0, 0.6, 2.5, 3.8, 2))
    monkeypatch.setitem(RESOLUTIONS, "coarse, second order", Resolution(HEX27P1, 0.6, 2.5, 3.8, 2))
    monkeypatch.setitem(MESHES, "solid",
                        SolverFitResolutions("coarse", "coarse, second order", error_factor=3.0, slow=True))
    monkeypatch.setattr("calibration.diagnosis.proposals.CATALOGUE", {
        "viscoelasticity": Viscoelasticity, "machine_compliance": MachineCompliance})
    experiment = ts.KINDS["bonded_compression"].experiment(
        specimen=ts.Block(0.020, 0.020, 0.020), protocol=ts.Protocol.ramp(3e-3, 9))
    curve = ts.simulate(ts.Model(experiment, ts.Material("neo_hooke", {"C10": 450.0}, ts.Bulk("bulk_ratio", 1e3))),
                        solver="solid", resolution="coarse, second order")
    way = np.linspace(0.0, 3e-3, 41)
    for number in (1, 2, 3):
        noise = 0.001 * np.random.default_rng(number).normal(size=way.size)
        force = CubicSpline(curve.displacement, curve.force)(way)
        given_way = way + 0.6e-3 * force / force[-1]
        ts.write_recording(ts.Recording({"time": way / 2e-4, "displacement": given_way, "force": force + noise}),
                           tmp_path / f"run_{number}.csv")
    path = tmp_path / "cube.toml"
    path.write_text(CAMPAIGN, encoding="utf-8")
    return path


@pytest.mark.slow
def test_it_says_what_it_tries_and_how_long_to_expect(glued, tmp_path, monkeypatch):
    monkeypatch.setattr(campaign_diagnosis, "SETTINGS", replace(campaign_diagnosis.SETTINGS, min_announced=0.0))
    said, announced = [], []
    result, = calibration.diagnose([glued], tmp_path / "out", figures=False, announce=announced.append,
                                   progress=lambda sentence, *counts: said.append((sentence, counts)))
    sentence, = announced
    assert sentence.startswith("cube: expect ") and "a simulation of its test in space takes" in sentence
    tried = {text.removeprefix("cube: effects, one at a time: ") for text, _ in said if "at a time: " in text}
    assert tried == {"viscoelasticity", "machine compliance"}
    assert [text for text, _ in said].index("cube: choosing the next experiment") > 0
    fitted = {text for text, _ in said if "fits with an effect: " in text}
    assert fitted and {f"cube: fits with an effect: {each.title}" for each in result.diagnosis.candidates
                       if each.refitted} == fitted


@pytest.mark.slow
def test_on_the_axis_there_is_nothing_to_wait_for(glued):
    campaign = make_one_law_whole_recording_campaign(calibration.load_campaign(glued))
    problem = build_generalised_problem("neo_hooke", campaign, calibration.read_measured_curves(campaign),
                                        SimulationCache())
    seconds = measure_solid_simulation_cpu_s_by_test(problem)
    assert list(seconds) == ["glued"] and seconds["glued"] > 0.0
    problem = replace(problem, tests=tuple(replace(test, solver="axisymmetric") for test in problem.tests))
    assert measure_solid_simulation_cpu_s_by_test(problem) == {}


@pytest.mark.parametrize(("seconds", "words"), [
    ({}, ""), ({"plates": 0.1}, ""), ({"plates": 0.2, "glued": 1.0}, "expect up to 6 minutes on one processor"),
    ({"plates": 3.0}, "expect 2 to 15 minutes on one processor")])
def test_what_to_expect_in_words(seconds, words):
    said = describe_expected_duration_or_empty(seconds)
    assert said.startswith(words) and bool(said) == bool(words)


def test_parallel_tasks_have_no_single_name():
    """Several run at a time; one after the other the one that runs is named."""
    for parallel, expected in ((False, ["c: fits: a", "c: fits: b", "c: fits"]), (True, ["c: fits"] * 3)):
        tasks = TaskExecutor()
        tasks.parallel = parallel
        said: list[str] = []
        context = RunContext("c", tasks, lambda sentence, *counts, said=said: said.append(sentence))
        assert context.run_task_for_all(abs, [(-1,), (2,)], "fits", names=["a", "b"]) == [1, 2]
        assert said == expected
