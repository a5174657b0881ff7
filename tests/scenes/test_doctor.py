"""`tissue-sim doctor`: its measurements, and the detection of each problem."""

import importlib.metadata
import json
import socket
import sys

import numpy as np
import pytest

from scenes import doctor
from scenes.cli import main

SECONDS = "0.05"


def test_json(capsys):
    code = main(["doctor", "--clock-seconds", SECONDS, "--json"])
    answer = json.loads(capsys.readouterr().out)
    assert code == (0 if answer["ok"] else 1)
    checks = {check["name"]: check for check in answer["checks"]}
    assert {"Python", "numpy", "the four packages", "Taichi", "compiled kernels", "1 kHz clock", "real-time priority",
            "matplotlib cache", "loopback port"} <= set(checks)
    assert checks["1 kHz clock"]["values"]["ticks"] == 50
    assert all(check["remedy"] for check in checks.values() if check["status"] != "ok")


@pytest.mark.slow
def test_the_text_output_has_one_line_per_check(capsys):
    main(["doctor", "--clock-seconds", SECONDS])
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith(("ok ", "warn ", "fail ")) for line in lines) >= 16
    assert any(line.startswith("ok    numpy: ") for line in lines)


def test_a_failed_check_fails_the_command(monkeypatch, capsys):
    broken = doctor.CheckResult("numpy", "fail", "not installed", "python -m pip install numpy")
    monkeypatch.setattr("scenes.doctor.run_checks", lambda clock_seconds: iter([broken]))
    assert main(["doctor"]) == 1
    text = capsys.readouterr().out
    assert "fail  numpy: not installed" in text and "python -m pip install numpy" in text
    assert "failed checks: numpy" in text


def test_lateness_is_measured_against_fixed_deadlines(monkeypatch):
    """A clock that stalls once by 5 ms: the tick is 5 ms late, the next ones 4, 3, 2, 1 ms, as in a real loop."""
    now, asleep = [0.0], []

    def perf_counter():
        now[0] += 1e-7
        return now[0]

    def sleep(seconds):
        asleep.append(seconds)
        now[0] += 5e-3 + seconds if len(asleep) == 3 else seconds

    monkeypatch.setattr(doctor.time, "perf_counter", perf_counter)
    monkeypatch.setattr(doctor.time, "sleep", sleep)
    lateness = doctor.measure_lateness_of_each_tick(0.010)
    assert lateness.shape == (10,)
    np.testing.assert_allclose(lateness * 1e3, [0, 0, 4.8, 3.8, 2.8, 1.8, 0.8, 0, 0, 0], atol=2e-3)


@pytest.mark.parametrize(("lateness", "status"), [(1e-6, "ok"), (2e-3, "fail")])
def test_clock_verdict(monkeypatch, lateness, status):
    monkeypatch.setattr(doctor, "measure_lateness_of_each_tick", lambda seconds: np.full(1000, lateness))
    check = doctor.check_clock_lateness(1.0)
    assert check.status == status and bool(check.remedy) == (status != "ok")


def test_clock_warns_of_rare_late_ticks(monkeypatch):
    lateness = np.full(1000, 1e-6)
    lateness[::100] = 3e-3
    monkeypatch.setattr(doctor, "measure_lateness_of_each_tick", lambda seconds: lateness)
    check = doctor.check_clock_lateness(1.0)
    assert check.status == "warn" and check.values["later_than_1_ms"] == pytest.approx(0.01)


@pytest.mark.skipif(not hasattr(doctor.os, "sched_getscheduler"), reason="this platform has one scheduler only")
def test_the_scheduler_is_restored():
    before = doctor.os.sched_getscheduler(0)
    doctor.check_clock_lateness(0.01)
    assert doctor.os.sched_getscheduler(0) == before


def test_missing_scheduler_is_a_warning_with_a_remedy(monkeypatch):
    def refuse(*arguments):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(doctor.os, "sched_setscheduler", refuse, raising=False)
    check = doctor.check_real_time_priority()
    assert check.status == "warn" and "rtprio" in check.remedy


def test_packages_come_from_one_folder():
    assert doctor.check_common_package_folder().status == "ok"


def test_a_shadowed_package_is_detected(tmp_path, monkeypatch):
    """A file calibration.py in the current folder is imported instead of the package."""
    stray = tmp_path / "calibration.py"
    stray.write_text("", encoding="utf-8")
    monkeypatch.delitem(sys.modules, "calibration", raising=False)
    monkeypatch.syspath_prepend(str(tmp_path))
    check = doctor.check_common_package_folder()
    assert check.status == "fail" and str(stray) in check.finding and check.remedy


def test_a_missing_package_is_detected(monkeypatch):
    installed = importlib.metadata.version

    def version(name):
        if name == "sympy":
            raise importlib.metadata.PackageNotFoundError(name)
        return installed(name)

    monkeypatch.setattr(importlib.metadata, "version", version)
    checks = {check.name: check for check in doctor.iterate_required_package_checks()}
    assert checks["sympy"].status == "fail" and checks["sympy"].remedy == "python -m pip install sympy"
    assert checks["numpy"].status == "ok" and checks["numpy"].finding == installed("numpy")


def test_an_old_python_is_detected(monkeypatch):
    monkeypatch.setattr(doctor.sys, "version_info", (3, 10, 4))
    check = doctor.check_python_version_and_platform()
    assert check.status == "fail" and "3.11" in check.remedy


def test_the_kernel_runs():
    check = doctor.check_taichi_kernel()
    if not doctor.has_taichi_wheel_for_platform():
        assert check.status == "warn"
    else:
        assert check.status == "ok", check
        assert check.values["offered"].split(", ")[0] == check.values["backend"]
        assert "available back-ends: " in check.finding and "uses the CPU" in check.finding


def test_a_crashing_probe_keeps_its_results(monkeypatch):
    probe = "import os, sys; print(sys.argv[1], flush=True); print('noise', flush=True); os.abort()"
    monkeypatch.setattr(doctor, "_PROBE", probe)
    assert doctor.find_usable_gpu_backends() == ["cuda"]
    monkeypatch.setattr(doctor.sys, "executable", "/no/such/python")
    assert doctor.find_usable_gpu_backends() == []


def test_a_used_port_is_detected(monkeypatch):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        monkeypatch.setattr(doctor, "VIEWER_PORT", taken.getsockname()[1])
        assert doctor.check_viewer_port().status == "warn"
    assert doctor.check_viewer_port().status == "ok"
