"""Tissues and scripts for test_ring.py and test_loop.py, which another process imports by name."""

import os
import signal
import sys
import time
from functools import partial

import numpy as np
from waiting import wait_until

from haptics.devices.motions import SineMotion
from haptics.loop.loop import LoopSettings
from haptics.loop.process import LoopProcess
from haptics.loop.ring import RingReader, RingWriter
from haptics.loop.shared_slots import SnapshotWriter
from haptics.safety.limits import ForceLimiter
from haptics.safety.rendering import ForceRendering
from tissue_sim.errors import InputError
from tissue_sim.fem.axisymmetric.fields import Fields
from tissue_sim.pose import Pose
from tissue_sim.snapshot import Snapshot
from tissue_sim.tool_force import ForceStatus, ToolForce, get_depth_of_pose_or_number


class Spring:
    """F = k d below the surface, k in N/m."""

    def __init__(self, stiffness=200.0):
        self.stiffness, self.steps, self.warm = stiffness, [], False

    def warm_up(self):
        self.warm = True

    def step(self, pose, dt):
        depth = get_depth_of_pose_or_number(pose)
        self.steps.append((depth, dt))
        inside = depth > 0
        return ToolForce.from_axial_force(self.stiffness * depth if inside else 0.0, self.stiffness if inside else 0.0,
                                          ForceStatus.CONVERGED, iterations=1, residual=1e-9, inertial=True)

    def reset(self):
        self.steps.clear()

    def set_parameters(self, stiffness):
        if stiffness <= 0:
            raise InputError(f"{stiffness:g} N/m is no stiffness; give a number above zero", field="stiffness")
        self.stiffness = stiffness


class Gel(Spring):
    """A spring that shows itself whole: its state is its depth, its material its stiffness."""

    def snapshot(self):
        depth = self.steps[-1][0] if self.steps else 0.0
        return Snapshot(Pose.at_depth(depth), 0.0, gel_fields(self.stiffness, [[depth, 2 * depth]]))


class Bare(Spring):
    """A tissue whose solver has no fields to show."""

    def snapshot(self):
        return Snapshot(Pose.at_depth(0.0), 0.0, None)


def gel_fields(material, displacements, stresses=None):
    empty = np.zeros(0)
    return Fields(None, material, 0.0, np.array(displacements), None, empty, empty, empty, empty, stresses)


class Fuse(Spring):
    """Fails at its tenth step."""

    def step(self, pose, dt):
        if len(self.steps) == 9:
            raise ZeroDivisionError("the tenth\nstep")
        return super().step(pose, dt)


def refuse():
    raise InputError("12 layers are too many; give 1 to 10", field="layers")


def die():
    os.kill(os.getpid(), getattr(signal, "SIGKILL", signal.SIGTERM))


def build_slowly(seconds):
    """A tissue whose computation takes this long; tests stop or outlive it, and none waits for its end."""
    time.sleep(seconds)
    return Spring()


def rendering():
    return ForceRendering(ForceLimiter(force=10.0, rate=1.0))


def loop_process(build=Spring, seconds=None, real_time=False, snapshot_rate=0.0, **options):
    settings = LoopSettings(seconds=seconds, real_time=real_time, snapshot_rate=snapshot_rate)
    return LoopProcess(build, SineMotion(4e-3, -1e-3, 5.0), rendering(), settings, **options)


def record(n):
    """A tick whose fields all follow from its number: what `RingWriter.append` takes."""
    device, tool = (Pose((n + 0.1 * k, n + 0.2 * k, -n - k), (0.6, 0.0, 0.8, 0.0)) for k in (1, 2))
    wrench, tissue = (tuple(n + 10.0 * k + axis for axis in range(6)) for k in (1, 2))
    matrix = tuple(tuple(n + 6.0 * row + column for column in range(6)) for row in range(6))
    within = tuple(tuple(100.0 * part for part in row) for row in matrix) if n % 2 else None
    answer = ToolForce(tissue, matrix, ForceStatus(n % 4), n % 97, n + 6.0, inertial=bool(n % 2), age=n + 9.0,
                       step_stiffness_matrix=within, stiffness_age=n + 0.5, force_error=n + 0.25, error_age=n + 0.125,
                       is_on_axis=bool(n % 3), least_tool_mass=n + 0.75)
    return n, n * 0.5, device, tool, wrench, answer, n + 7.0, n + 8.0, n, n + 1, n % 61


def fields_of(n):
    """The same tick as a reader sees it, flat."""
    _, time, device, tool, wrench, answer, compute_time, lateness, late, missed, flags = record(n)
    return [n, time, device.depth, tool.depth, wrench[2], answer.force, answer.stiffness, answer.residual, compute_time,
            lateness, answer.age, late, missed, answer.status, answer.iterations, flags, answer.inertial,
            *device.position, *device.orientation, *tool.position, *tool.orientation, *wrench, *answer.wrench,
            *(part for row in answer.stiffness_matrix for part in row), answer.step_stiffness, answer.stiffness_age,
            answer.force_error, answer.error_age, answer.least_tool_mass, answer.is_on_axis]


def flat(record):
    """All numbers of a record of the ring."""
    return [number for name in record.dtype.names for number in np.ravel(record[name]).tolist()]


def write_fast(ring_path, board_path, stop_path):
    """Fill a small ring and a board as fast as this process can, until a file appears."""
    pattern = Snapshot(Pose.at_depth(0.0), 0.0, gel_fields(1.0, np.zeros((1, 500))))
    with RingWriter(ring_path, 8) as ring, SnapshotWriter(board_path, pattern) as board:
        n = 0
        print("writing", flush=True)
        while n % 256 or not stop_path.exists():
            n += 1
            ring.append_tick(*record(n))
            if n % 16 == 0:
                board.publish(float(n), Snapshot(Pose.at_depth(n), n, gel_fields(1.0, np.full((1, 500), float(n)))))


def read_forces(path, count):
    """The first forces of a ring, as an unrelated process sees them."""
    with RingReader(path) as reader:
        ticks = reader.read_ticks_after(0)

        def read_on():
            nonlocal ticks
            ticks = reader.read_ticks_after(ticks.number)
            return ticks.number >= count

        wait_until(read_on, lambda: f"{count} ticks; got {ticks.number}")
        print(ticks.number, ticks.lost, reader.latest()["force"])


def main():
    what, *words = sys.argv[1:]
    if what == "write":
        from pathlib import Path

        write_fast(*map(Path, words))
    elif what == "read":
        read_forces(words[0], int(words[1]))
    else:  # a parent of a loop, which waits to be killed
        build = Spring if what == "parent" else partial(build_slowly, 60.0)
        with loop_process(build, ring_path=words[0]) as loop:
            if what == "parent":
                loop.wait_until_ready()
            print(loop.pid, flush=True)
            loop.wait()


if __name__ == "__main__":
    main()
