"""The loop with a Haply device whose service is another process: forces arrive, and failures leave no force."""

import json
import math
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from waiting import wait_until

from haptics.devices.back_ends import make_haptic_device
from haptics.loop.loop import LoopSettings
from haptics.loop.process import LoopError, LoopProcess
from haptics.safety.limits import ForceLimiter
from haptics.safety.rendering import ForceRendering, RenderFlag
from tissue_sim.tool_force import ForceStatus, ToolForce

#: Origin of the scene at the initial position of the emulated hand.
AT_START = "x_mm=0,y_mm=-150,z_mm=150"


class Block:
    """A tissue of 300 N/m."""

    def step(self, pose, dt):
        depth = max(pose.depth, 0.0)
        return ToolForce.from_axial_force(300.0 * depth, 300.0 if depth else 0.0, ForceStatus.CONVERGED)


@pytest.fixture
def other_process():
    """A service in another process, whose hand moves 6 mm into the tissue and out."""
    root = Path(__file__).resolve().parents[3]
    with subprocess.Popen([sys.executable, Path(__file__).with_name("haply_service.py"),
                           "port=0,depth_mm=6,frequency_hz=2,grip_N_m=1000"], cwd=root, text=True,
                          stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        process.address = process.stdout.readline().strip()
        yield process
        process.kill()


def felt(process):
    process.stdin.write("\n")
    process.stdin.flush()
    return json.loads(process.stdout.readline())


def loop_with(address, seconds=None):
    return LoopProcess(Block, make_haptic_device(f"{address},{AT_START}"), ForceRendering(ForceLimiter(5.0, 0.5)),
                       LoopSettings(seconds=seconds, real_time=False))


@pytest.mark.slow
def test_the_loop_renders_the_tissue_to_the_device(other_process):
    with loop_with(other_process.address, seconds=1.5) as loop:
        loop.wait_until_ready()
        with loop.open_ring_reader() as ring:
            report = loop.wait()
            records = ring.read_ticks_after(0).records
    hand = felt(other_process)
    # The grip of 1000 N/m yields to the tissue of 300 N/m: depth = 6 mm x 1000/1300, force = 300 N/m x depth.
    assert report.ended_by == "time" and report.largest_force == pytest.approx(300 * 6e-3 / 1.3, rel=0.1)
    assert hand["largest_force_N"] == pytest.approx(report.largest_force, rel=0.05)
    assert hand["force_N"] == [0.0, 0.0, 0.0], "the device is stopped"
    touching = records[records["tool_depth"] > 2e-3]
    # On a busy machine the watchdog reduces the force after late poses, and says so in the flags.
    rendered = touching[touching["flags"] & (RenderFlag.LOST_POSE | RenderFlag.RATE_LIMITED) == 0]
    assert len(rendered) > 100 and rendered["force"] == pytest.approx(300.0 * rendered["tool_depth"], rel=1e-6)


def test_a_dead_service_leaves_no_force_and_the_loop_continues(other_process):
    with loop_with(other_process.address) as loop:
        loop.wait_until_ready()
        with loop.open_ring_reader() as ring:
            wait_until(lambda: (last := ring.latest()) is not None and last["force"] > 0.5)
            other_process.kill()
            wait_until(lambda: ring.latest()["force"] == 0.0 and math.isnan(ring.latest()["device_pose"][0]))
            tick = ring.latest()["tick"]
            wait_until(lambda: ring.latest()["tick"] > tick + 20)
        report = loop.stop()
    assert report.ended_by == "stop" and report.flagged["lost_pose"] > 0
    assert "is gone" in report.device["trouble"] and other_process.address[6:] in report.device["trouble"]


def test_a_dead_service_is_described_after_the_stop(other_process):
    device = make_haptic_device(f"{other_process.address},{AT_START}")
    device.start()
    assert "trouble" not in device.describe()
    other_process.kill()
    other_process.wait()
    device.stop()
    assert "is gone" in device.describe()["trouble"] and device.pose(0.0) is None


def test_a_loop_without_a_service_does_not_start():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        with loop_with(f"haply:ws://127.0.0.1:{taken.getsockname()[1]}") as loop, \
                pytest.raises(LoopError, match="no Haply Inverse service answers"):
            loop.wait_until_ready()


@pytest.mark.skipif(sys.platform == "win32", reason="Windows cannot hold a process still")
def test_a_stopped_or_killed_loop_leaves_no_force(other_process):
    """The emulator removes the force; the behaviour of the real service is not documented."""
    with loop_with(other_process.address) as loop:
        loop.wait_until_ready()
        wait_until(lambda: felt(other_process)["force_N"][2] > 0.5)
        os.kill(loop.pid, signal.SIGSTOP)
        wait_until(lambda: felt(other_process)["force_N"] == [0.0, 0.0, 0.0])
        os.kill(loop.pid, signal.SIGCONT)
        wait_until(lambda: felt(other_process)["force_N"][2] > 0.5)
        os.kill(loop.pid, signal.SIGKILL)
        wait_until(lambda: felt(other_process)["force_N"] == [0.0, 0.0, 0.0])
