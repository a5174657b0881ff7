"""A kind of job from one file, run by the function that runs fits, diagnoses and designs."""

import json

import numpy as np
import pytest

import tissue_sim as ts
from calibration import Workers
from calibration.job import JOBS
from calibration.pipeline import run_campaign_jobs
from calibration.tasks.executors import EXECUTORS

TEXT = """
[[specimen]]
radius_mm = 40.0
height_mm = 70.0
[[test]]
name = "plates"
kind = "lubricated_compression"
recordings = ["{name}_*.csv"]
[fit]
laws = ["neo_hooke"]
[noise]
force_N = 0.02
"""


@pytest.fixture
def screening(plugin, registers):
    """Class of the job of the plug-in."""
    module = plugin("recording_screening")
    registers(JOBS, module.RecordingScreening, "screening")
    return module.RecordingScreening


@pytest.fixture
def campaign(tmp_path):
    """Campaign with a strong and a weak recording."""
    return write(tmp_path, "study", (5.0, 0.2))


def write(folder, name, largest_forces):
    displacement = np.linspace(0, 0.0098, 60)
    for number, largest in enumerate(largest_forces, 1):
        ts.write_recording(ts.Recording({"displacement": displacement, "force": largest * displacement / 0.0098}),
                           folder / f"{name}_{number}.csv")
    (folder / f"{name}.toml").write_text(TEXT.format(name=name), encoding="utf-8")
    return folder / f"{name}.toml"


def test_job_of_one_file_with_progress_and_resume(screening, campaign, tmp_path, monkeypatch):
    told, out = [], tmp_path / "out"
    found, = run_campaign_jobs("screening", [campaign], out, progress=lambda *words: told.append(words))
    assert found["weak"] == ["plates/study_2"]
    assert found["ratios"]["plates/study_1"] == pytest.approx(250.0)
    assert told == [("study: screening: plates/study_1", 0, 2), ("study: screening: plates/study_2", 1, 2),
                    ("study: screening", 2, 2)]
    assert sorted(path.name for path in out.iterdir()) == ["screening.json", "work.json"]
    monkeypatch.setattr(screening, "run", None)  # the finished job is read
    assert run_campaign_jobs("screening", [campaign], out) == [found]
    with pytest.raises(ts.InputError, match="results of other campaigns"):
        run_campaign_jobs("screening", [campaign], out, options={"min_ratio": 2.0})


def test_an_interrupted_job_starts_again(screening, campaign, tmp_path):
    out = tmp_path / "out"

    def stop(sentence, done, of):
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_campaign_jobs("screening", [campaign], out, progress=stop)
    assert [path.name for path in out.iterdir()] == ["work.json"]
    assert run_campaign_jobs("screening", [campaign], out)[0]["weak"] == ["plates/study_2"]


def test_a_refused_job_writes_nothing(screening, campaign, tmp_path):
    with pytest.raises(ts.InputError, match="min_ratio must be positive"):
        run_campaign_jobs("screening", [campaign], tmp_path / "out", options={"min_ratio": 0.0})
    assert not (tmp_path / "out").exists()


def test_a_failed_job_does_not_stop_the_others(screening, campaign, tmp_path, monkeypatch):
    run = screening.run

    def fail_in_study(job):
        if job.campaign.name == "study":
            raise ts.ConvergenceError("study: no result")
        return run(job)

    monkeypatch.setattr(screening, "run", fail_in_study)
    other = write(tmp_path, "other", (1.0,))
    with pytest.raises(ts.ConvergenceError, match="study: no result"):
        run_campaign_jobs("screening", [campaign, other], tmp_path / "out")
    assert json.loads((tmp_path / "out" / "other" / "screening.json").read_text(encoding="utf-8"))["weak"] == []
    assert not (tmp_path / "out" / "study").exists()


def test_job_with_the_executor_of_another_plugin(screening, plugin, registers, campaign, tmp_path):
    registers(EXECUTORS, plugin("thread_pool").open_thread_pool, "threads")
    found, = run_campaign_jobs("screening", [campaign], tmp_path / "out", workers=Workers(2, executor="threads"))
    assert found["weak"] == ["plates/study_2"]


@pytest.mark.slow
def test_job_in_worker_processes(screening, campaign, tmp_path):
    found, = run_campaign_jobs("screening", [campaign], tmp_path / "out", workers=Workers(2))
    assert found["weak"] == ["plates/study_2"]


def test_an_unknown_kind_is_refused(campaign, tmp_path):
    with pytest.raises(ts.InputError, match="unknown job 'screning'"):
        run_campaign_jobs("screning", [campaign], tmp_path / "out")
    with pytest.raises(ts.InputError, match=r"derives from calibration\.job\.Job"):
        JOBS.register(dict, "dictionary")
