"""Process of the viewer for `viewer`: a page on a free port; standard input requests runs.

    python -m benchmarks worker RESOLUTION

Says its port, then answers each line of JSON (``viewer``: page or none, ``motion``, ``clients``, ``seconds``) with one
line of JSON. CPU times are of the thread that makes and shows frames, and of the whole process.
"""

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["OPENBLAS_NUM_THREADS"] = "1"
os.environ["MKL_NUM_THREADS"] = "1"

import functools
import json
import math
import multiprocessing
import sys
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

import scenes.viewer.page.solid
import tissue_sim as ts
from benchmarks.viewer.client import readouts_in
from benchmarks.viewer.ticks import MOTION, SETTLING, SPEED, STANDING, TEST, TickCount, peak_memory
from haptics.loop.ring import RingReader
from scenes.viewer.frame import FrameViewer, NullViewer, Phase, SessionFrame
from scenes.viewer.measurement import build_measurement_from_replicates
from scenes.viewer.page import Page
from scenes.viewer.page.readouts import readouts_html
from scenes.viewer.revolution import TriangulatedHalfSection
from scenes.viewer.scene import Scene
from scenes.viewer.session import Session
from tissue_sim.experiment.kinds.standard_tests import NEEDLE
from tissue_sim.fem.axisymmetric.fields import Fields

#: Number of recordings.
REPLICATES = 3
#: Samples of a recording.
SAMPLES = 401
#: Standard deviation of the force, N.
NOISE = 0.02
#: How long the start may take, s; the machine's first one compiles.
PATIENCE = 120.0


class Stopwatch:
    """CPU time of the calling thread by name of the part, s."""

    def __init__(self) -> None:
        self.spent: Counter[str] = Counter()

    def timed(self, part: str, work: Callable) -> Callable:
        """Return the same function, with its time counted for a part."""

        @functools.wraps(work)
        def measured(*arguments, **options):
            began = time.thread_time()
            try:
                return work(*arguments, **options)
            finally:
                self.spent[part] += time.thread_time() - began

        return measured

    def watch(self, page: Page, session: Session) -> None:
        """Time the parts of a frame."""
        solid = scenes.viewer.page.solid
        Fields.at_points = self.timed("fields", Fields.at_points)
        Fields.at_nodes = self.timed("fields", Fields.at_nodes)
        solid.compute_field_quantile_range = self.timed("fields", solid.compute_field_quantile_range)
        TriangulatedHalfSection.compute_band_surfaces = self.timed("bands",
                                                                   TriangulatedHalfSection.compute_band_surfaces)
        page._update_texts_and_controls = self.timed("words", page._update_texts_and_controls)
        page.show = self.timed("show", page.show)
        session.update_and_make_frame = self.timed("frame", session.update_and_make_frame)


class Watched:
    """Viewer between the session and another viewer; records the time and CPU time of each frame."""

    def __init__(self, viewer: FrameViewer, stopwatch: Stopwatch):
        self._viewer, self._spent = viewer, stopwatch.spent
        self._before = self._sum()
        self.shown: list[tuple[float, SessionFrame]] = []
        self.cpu: list[float] = []

    def show(self, frame: SessionFrame) -> None:
        began = time.monotonic()
        self._viewer.show(frame)
        now = self._sum()
        self.cpu.append(now - self._before)
        self._before = now
        self.shown.append((began, frame))

    def close(self) -> None:
        pass

    def _sum(self) -> float:
        return self._spent["frame"] + self._spent["show"]


def study() -> Scene:
    """Return the needle in the study's specimen with three replicates, whose forces do not affect the cost of plots."""
    experiment = NEEDLE.experiment(specimen=ts.Specimen(0.040, 0.070), protocol=TEST)
    depth, noise = np.linspace(0.0, TEST.depth, SAMPLES), np.random.default_rng(0)
    recordings = [ts.Recording({"time": depth / SPEED, "displacement": depth,
                                "force": 250.0 * depth * (1 + 40.0 * depth) + noise.normal(0.0, NOISE, SAMPLES)},
                               {}, {"name": f"needle_{number}", "kind": NEEDLE.name}) for number in range(REPLICATES)]
    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4),
                           density=1040.0)
    return Scene(NEEDLE, experiment, material,
                 measurements={NEEDLE.name: build_measurement_from_replicates(recordings)})


def began_at(ring: RingReader) -> float:
    """Return the time of the loop's clock zero, s of `time.monotonic`.

    The smallest observed value is used: a tick is visible only after its end, and some are visible immediately.
    """
    until, earliest = time.monotonic() + 0.2, math.inf
    while time.monotonic() < until:
        tick = ring.latest()
        earliest = min(earliest, time.monotonic() - tick["time"] - tick["compute_time"])
    return float(earliest)


def move(session: Session, motion: str) -> None:
    """Move the tool or hold it in the tissue, and wait until the loop does only that."""
    if motion == "moves":
        session.post("play", text=MOTION, repeat=True)
    else:
        session.post("aim", depth=STANDING)
    session.run(NullViewer(), threading.Event(), SETTLING)


def run(session: Session, page: Page, stopwatch: Stopwatch, ring: RingReader, asked: dict) -> dict:
    """Return the result and the cost of one run."""
    until = time.monotonic() + PATIENCE
    while len(page.server.get_clients()) != asked["clients"] and time.monotonic() < until:
        time.sleep(0.05)
    move(session, asked["motion"])
    viewer = page if asked["viewer"] == "page" else NullViewer()
    stop = threading.Event()
    session.run(viewer, stop, 0.3)
    zero, count = began_at(ring), TickCount(ring)
    stopwatch.spent.clear()
    watched = Watched(viewer, stopwatch)
    process, thread = time.process_time(), time.thread_time()
    session.run(watched, stop, asked["seconds"])
    process, thread = time.process_time() - process, time.thread_time() - thread
    ticks, records, parts = count.counted(), count.records(), stopwatch.spent
    frames, per_frame = len(watched.shown), 1e3 / len(watched.shown)
    picture = parts["show"] - parts["fields"] - parts["bands"] - parts["words"]
    return {**asked, "frames": frames, "process_ms": process * per_frame,
            "frame_thread_ms": {"mean": sum(watched.cpu) * per_frame,
                                **{name: 1e3 * float(np.quantile(watched.cpu, share))
                                   for name, share in (("p50", 0.5), ("p99", 0.99))}},
            "parts_ms": {**{part: parts[part] * per_frame for part in ("frame", "fields", "bands", "words")},
                         "picture": picture * per_frame, "sending": max(process - thread, 0.0) * per_frame},
            "ticks": ticks, "shown": list(shown(watched, page, zero, records)), "memory_MB": memory(session)}


def shown(watched: Watched, page: Page, zero: float, records: np.ndarray):
    """Yield for each frame its time, the times of the ticks of its picture and of its read-outs, height and read-outs.

    Times are in s of `time.monotonic`; the height is that of the tool in the scene.
    """
    for made, frame in watched.shown:
        if frame.snapshot is None or frame.readouts is None:
            continue
        same = records["time"][records["tool_depth"] == frame.snapshot.depth]
        same = same[np.abs(same - frame.readouts.time) < 0.5]
        picture = zero + float(same[-1]) if same.size else None
        yield (made, picture, zero + frame.readouts.time, -frame.snapshot.depth * page._solid.scale,
               readouts_in(readouts_html(replace(frame, snapshot=None))))


def memory(session: Session) -> dict[str, float | None]:
    """Return the peak memory of the three processes, MB."""
    loop = session.simulation.haptic_loop_process.pid
    others = [child.pid for child in multiprocessing.active_children() if child.pid != loop]
    return {"viewer": peak_memory(os.getpid()), "loop": peak_memory(loop),
            "curves": peak_memory(others[0]) if others else None}


def run_process() -> None:
    session = Session(study(), resolution=sys.argv[1])
    page = None
    try:
        until = time.monotonic() + PATIENCE
        while (frame := session.update_and_make_frame()).curves.model is None or frame.snapshot is None:
            if frame.phase is Phase.DIED or time.monotonic() > until:
                raise SystemExit(f"the simulation does not start: {frame.message}")
            time.sleep(0.02)
        page, stopwatch = Page(session, frame, Path(__file__).parent, port=0, low_graphics=True), Stopwatch()
        stopwatch.watch(page, session)
        print(json.dumps({"port": page.server.get_port(), "elements": len(frame.snapshot.fields.mesh.connectivity),
                          "loop": session.simulation.haptic_loop_process.pid}),
              flush=True)
        with session.simulation.haptic_loop_process.open_ring_reader() as ring:
            for line in sys.stdin:
                print(json.dumps(run(session, page, stopwatch, ring, json.loads(line))), flush=True)
    finally:
        if page is not None:
            page.close()
        session.close()


if __name__ == "__main__":
    run_process()
