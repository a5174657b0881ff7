"""Real-time privileges: granted ones hold inside and are undone; refused ones are reported with a remedy."""

import ctypes
import errno
import gc
import os
import subprocess
import sys
from pathlib import Path

import pytest

from haptics.loop.ticker import request_real_time_features

ROOT = Path(__file__).resolve().parents[2]
NAMES = {"SCHED_FIFO", "locked memory", "timer slack", "no garbage collection"}
needs_linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="SCHED_FIFO and mlockall are Linux's")


def by_name(features):
    return {feature.name: feature for feature in features}


def test_every_feature_holds_or_says_why_not():
    before = gc.isenabled()
    with request_real_time_features() as features:
        assert set(by_name(features)) == NAMES
        for feature in features:
            assert feature.obtained == (feature.message == "")
            assert feature.obtained or feature.message.startswith(f"{feature.name}: ")
        assert by_name(features)["no garbage collection"].obtained and not gc.isenabled() and gc.get_freeze_count() > 0
    assert gc.isenabled() == before and gc.get_freeze_count() == 0


def test_nothing_is_touched_where_it_is_not_wanted():
    with request_real_time_features(wanted=False) as features:
        assert gc.isenabled() and gc.get_freeze_count() == 0
        assert features == ()


def test_a_collection_that_was_off_stays_off():
    gc.disable()
    try:
        with request_real_time_features():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()


@needs_linux
def test_what_linux_grants_is_seen_by_the_system_and_undone():
    """A child process is checked through /proc and the scheduler, independently of the report."""
    code = """
import os
from pathlib import Path
from haptics.loop.ticker import request_real_time_features
def state():
    locked = next(line.split()[1] for line in Path("/proc/self/status").read_text().splitlines() if "VmLck" in line)
    return os.sched_getscheduler(0) == os.SCHED_FIFO, int(locked) > 0, Path("/proc/self/timerslack_ns").read_text()
before = state()
with request_real_time_features() as features:
    obtained = {feature.name for feature in features if feature.obtained}
    fifo, locked, slack = state()
    assert fifo == ("SCHED_FIFO" in obtained) and locked == ("locked memory" in obtained), features
    assert fifo or "timer slack" not in obtained or int(slack) == 1, slack
assert state() == before
print(sorted(obtained))
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, encoding="utf-8")
    assert done.returncode == 0, done.stderr
    assert "no garbage collection" in done.stdout


@needs_linux
def test_a_refusal_names_the_remedy(monkeypatch):
    def refuse(*_):
        raise PermissionError(errno.EPERM, "Operation not permitted")

    class NoLibrary:
        def __getattr__(self, name):
            ctypes.set_errno(errno.ENOMEM)
            return lambda *_: -1

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: NoLibrary())
    with request_real_time_features() as features:
        found = by_name(features)
    assert not found["SCHED_FIFO"].obtained
    for remedy in ("Operation not permitted", "ulimit -r", "/etc/security/limits.d/rtprio.conf", "SYS_NICE"):
        assert remedy in found["SCHED_FIFO"].message
    for remedy in ("Cannot allocate memory", "ulimit -l", "memlock unlimited"):
        assert remedy in found["locked memory"].message
    assert "\n" not in "".join(feature.message for feature in features)


def test_other_platforms_say_that_they_have_none(monkeypatch):
    monkeypatch.setattr(sys, "platform", "win32")
    monkeypatch.delattr(os, "sched_setscheduler", raising=False)
    with request_real_time_features() as features:
        found = by_name(features)
    for name in ("SCHED_FIFO", "locked memory", "timer slack"):
        assert found[name].message.startswith(f"{name}: not available on win32")
    assert found["no garbage collection"].obtained
