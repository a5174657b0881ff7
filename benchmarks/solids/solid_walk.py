"""Random walks of a tool in solids in space, in the 1 kHz loop with the viewer's page open.

    python -m benchmarks solid_walk [--seconds 60] [--cases NAME ...] [--needle FILE] [--ball FILE] [--chromium]
                                    [--every 10] [--json]

A flat needle that holds tissue and a ball with friction on reduced solids (files of `tissue-sim reduce`, made where
none are given), and that ball on a solid in multirate simulation: pressed, dragged aside and lifted off at up to
50 mm/s along a `haptics.devices.motions.SpatialWalk`. Meanwhile a client reads the page, or Chromium draws it.
Afterwards the poses of the ticks are gone through again without a clock: reduced solids tick by tick, and the whole
solid at regular intervals, from touch to lift-off. Counted are deadlines that were missed, statuses, statuses that
were wrong, and the largest change of the force in a tick beyond that of the replay.
"""

from __future__ import annotations

# One thread each, before the libraries start.
import os

os.environ["OMP_NUM_THREADS"] = os.environ["OPENBLAS_NUM_THREADS"] = os.environ["MKL_NUM_THREADS"] = "1"

import argparse
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from delayed_bulk import DelayedBulkLink

import tissue_sim as ts
from benchmarks.measure import about, option_parser, show, table
from benchmarks.realtime.multirate import MESHES, mesh_of
from benchmarks.viewer.processes import looked_at, reading
from haptics.devices.motions import SpatialWalk
from haptics.loop.multirate import MultiRateTissue
from haptics.loop.ring import TICK, RingReader
from scenes.viewer.frame import FrameViewer, Phase, SessionFrame
from scenes.viewer.page import Page
from scenes.viewer.scene import Scene
from scenes.viewer.session import Session
from tissue_sim.experiment.kinds.standard_tests import NEEDLE
from tissue_sim.fem.reduced.solver import ReducedSolver
from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.fem.solid.linearisation import SolidLineariser
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import Step, StepStatus
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.pose import Pose, interpolate_pose
from tissue_sim.tool_force import ERROR_FLOOR, ERROR_SHARE

#: Depth of the box, m.
DEPTH = 4e-3
#: Half width of the box, m.
SIDEWAYS = 3e-3
#: Largest rotation, rad.
TURN = 0.087
#: Top speed, m/s.
SPEED = 0.05
#: How long the page and the loop may take to come up, s.
PATIENCE = 300.0
#: Allowed change of the force in a tick beyond that of the same motion without a clock, N.
JUMP = 0.02
#: Allowed difference of a CONVERGED force from that without a clock, as a fraction of the rms force.
SHARE = 0.01
#: Parts into which a step of the whole solid is cut where it does not come through.
_CUTS = (1, 4, 16)
_KEPT = ("tick", "time", "status", "tool_pose", "tissue_wrench", "compute_time", "lateness", "missed", "age")


@dataclass(frozen=True)
class Case:
    """Tool, interface, rotation and solver of a random walk."""

    tool: ts.Tool
    friction: str | float
    turn: float
    solver: str
    bulk_ratio: float
    #: Simulated delay of the models of the bulk and age limit of tangents, s. None: real delay, one tangent a model.
    delay: float | None = None
    tangent: float | None = None

    @property
    def holds(self) -> bool:
        return self.friction == "bonded"

    def model(self) -> ts.Model:
        experiment = NEEDLE.experiment(specimen=ts.Specimen(0.040, 0.070), tool=self.tool, friction=self.friction,
                                       protocol=ts.Protocol.ramp(DEPTH, points=2))
        return ts.Model(experiment, ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4},
                                                ts.Bulk("bulk_ratio", self.bulk_ratio)))

    def motion(self, seed: int) -> SpatialWalk:
        return SpatialWalk(seed, DEPTH, 0.0 if self.holds else -0.2 * DEPTH, SIDEWAYS, self.turn, SPEED)


CASES = {
    "needle": Case(ts.Tool("flat", radius=8e-3), "bonded", TURN, "reduced", 1e3),
    "ball": Case(ts.Tool("round", radius=8e-3), 0.3, 0.0, "reduced", 1e3),
    "two_rates": Case(ts.Tool("round", radius=8e-3), 0.3, 0.0, "solid", 1e4),
    "two_rates_33_ms": Case(ts.Tool("round", radius=8e-3), 0.3, 0.0, "solid", 1e4, 0.033),
    "two_rates_6_33_ms": Case(ts.Tool("round", radius=8e-3), 0.3, 0.0, "solid", 1e4, 0.006, 0.033),
}


@dataclass
class Watched(FrameViewer):
    """Viewer that shows frames on a page and stores the ticks."""

    page: Page
    ring: RingReader
    number: int = 0
    lost: int = 0
    frames: int = 0
    records: list[np.ndarray] = field(default_factory=list)

    def show(self, frame: SessionFrame) -> None:
        self.page.show(frame)
        self.frames += 1
        if frame.phase is Phase.DIED:
            raise SystemExit(f"the loop has ended: {frame.message}")
        self.take()

    def take(self) -> None:
        ticks = self.ring.read_ticks_after(self.number)
        self.number, self.lost = ticks.number, self.lost + ticks.lost
        self.records.append(ticks.records[list(_KEPT)].copy())

    def close(self) -> None:
        return


def walked(case: Case, reduced: ts.ReducedModel | None, seconds: float, seed: int, chromium: bool) -> tuple:
    """Return the ticks of a walk in the loop with the page open, dtype of `_KEPT`, and the state of the page."""
    model = case.model()
    scene = Scene(NEEDLE, model.experiment, model.material, solver=case.solver, reduced=reduced)
    session = Session(scene, curve_resolution="realtime")
    try:
        first = _running(session)
        page = Page(session, first, Path(__file__).parent, port=0, low_graphics=True)
        try:
            with session.simulation.haptic_loop_process.open_ring_reader() as ring:
                watched = Watched(page, ring)

                def work() -> dict:
                    stop, answers = threading.Event(), []
                    session.run(watched, stop, 1.0)
                    session.post("follow", device=case.motion(seed), reply=answers.append)
                    page.show(session.update_and_make_frame())
                    if answers != [None]:
                        raise SystemExit(f"the loop does not follow: {answers}")
                    watched.number, watched.frames, watched.lost = ring.written_count, 0, 0
                    watched.records.clear()
                    session.run(watched, stop, seconds)
                    watched.take()
                    return {"frames": watched.frames}

                if chromium:
                    looked = looked_at(page.server.get_port(), work)
                    if looked is None:
                        raise SystemExit("there is no Chromium, or no Playwright; leave --chromium out")
                    shown = {**looked[0], "readouts_on_the_page": len(looked[1])}
                else:
                    with reading(page.server.get_port()) as messages:
                        shown = work()
                        shown["kB_sent"] = round(sum(message[2] for message in messages()) / 1e3)
        finally:
            page.close()
    finally:
        session.close()
    return np.concatenate(watched.records), {**shown, "ticks_not_seen": watched.lost}


def stepped(case: Case, seconds: float, seed: int) -> tuple[np.ndarray, SolidMesh]:
    """Ticks without a loop, on the smallest mesh of `multirate`, whose models of the bulk are as late as the case
    says: the same on any computer, however busy it is."""
    mesh, motion = mesh_of(min(MESHES)), case.motion(seed)
    bulk = SolidLineariser(make_solver(case.model(), mesh=mesh))
    tissue = MultiRateTissue(case.model(), link=DelayedBulkLink(bulk, case.delay or 0.0, case.tangent))
    tissue.warm_up()
    ticks = np.zeros(round(seconds / 1e-3), dtype=[(name, TICK[name]) for name in _KEPT])
    for number, tick in enumerate(ticks):
        pose = motion.pose(1e-3 * number)
        began, seen = time.process_time(), tissue._link.linearising
        answer = tissue.step(pose, 1e-3)
        spent = time.process_time() - began - (tissue._link.linearising - seen)
        tissue.prepare()
        for name, value in (("tick", number + 1), ("time", 1e-3 * number), ("status", answer.status),
                            ("tool_pose", pose.position + pose.orientation), ("tissue_wrench", answer.wrench),
                            ("compute_time", spent), ("age", answer.age)):
            tick[name] = value
    return ticks, mesh


def _running(session: Session) -> SessionFrame:
    """Return the first frame of a running loop that has the curve of the whole test."""
    until = time.monotonic() + PATIENCE
    while ((frame := session.update_and_make_frame()).readouts is None or frame.snapshot is None
           or session.is_waiting_for_curve):
        if frame.phase is Phase.DIED or time.monotonic() > until:
            raise SystemExit(f"the simulation does not start: {frame.message}")
        time.sleep(0.05)
    return frame


def poses_of(ticks: np.ndarray) -> list[Pose]:
    return [Pose(tuple(row[:3]), tuple(row[3:])) for row in ticks["tool_pose"].tolist()]


def replayed(reduced: ts.ReducedModel, case: Case, ticks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The reduced solid's forces at the poses of the ticks without a clock, N, shape (n, 3), and where it had some."""
    solver = ReducedSolver(reduced, case.model().material)
    forces, found, clock = np.zeros((len(ticks), 3)), np.zeros(len(ticks), dtype=bool), 0.0
    for number, pose in enumerate(poses_of(ticks)):
        step = solver.step(pose, float(ticks["time"][number]) - clock, max_iterations=60)
        clock = float(ticks["time"][number])
        found[number] = step.status is StepStatus.CONVERGED
        forces[number] = step.wrench[:3] if found[number] else forces[number - 1]
    return forces, found


def pieces(case: Case, ticks: np.ndarray, every: int, most: int) -> list[np.ndarray]:
    """Ticks at which the whole solid is solved, about `most`, in pieces that begin on tissue which remembers nothing.

    A tool that lifts off leaves no friction behind: from touch to lift-off, evenly chosen ones of these.
    """
    if case.holds:
        return [np.arange(0, len(ticks), max(every, len(ticks) // most))]
    down = np.flatnonzero(ticks["tool_pose"][:, 2] < 0.0)
    touches = np.split(down, np.flatnonzero(np.diff(down) > 1) + 1)
    touches = [np.arange(touch[0], touch[-1] + 1, every) for touch in touches if touch.size > every]
    order = np.random.default_rng(0).permutation(len(touches))
    chosen: list[int] = []
    for number in order.tolist():
        if sum(touches[each].size for each in chosen) < most:
            chosen.append(number)
    return [touches[each] for each in sorted(chosen)]


def solved(case: Case, mesh: SolidMesh | None, ticks: np.ndarray, places: list[np.ndarray]) -> list[np.ndarray]:
    """The whole solid's forces, N, shape (n, 3) for each piece; NaN from where it found no equilibrium."""
    solver = make_solver(case.model(), mesh=mesh)
    poses, found = poses_of(ticks), []
    for numbers in places:
        solver.reset_to_first_touch()
        forces, here = np.full((len(numbers), 3), np.nan), poses[numbers[0]]
        for row, number in enumerate(numbers.tolist()):
            step = _step(solver, here, poses[number])
            if step is None:
                break
            forces[row], here = step.wrench[:3], poses[number]
        found.append(forces)
    return found


def _step(solver: SolidSolver, here: Pose, pose: Pose) -> Step | None:
    """Move the tool to a pose, in several increments if one does not converge."""
    for cut in _CUTS:
        steps = (solver.step(interpolate_pose(here, pose, (k + 1) / cut), tolerance=1e-6, max_iterations=40)
                 for k in range(cut))
        if all((step := each).status is StepStatus.CONVERGED for each in steps):
            return step
    return None


def beyond(forces: np.ndarray, expected: np.ndarray, ticks: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Return changes of the force between two samples beyond the largest expected change around them, N.

    Args:
        forces: of all ticks, shape (n, 3).
        expected: at some of them, shape (m, 3); numbers: at which, ascending, shape (m,).
    """
    first, last = numbers[0], numbers[-1]
    rate = np.linalg.norm(np.diff(forces[first : last + 1], axis=0), axis=1)
    # After a missed deadline the tool has moved for two ticks.
    passed = np.diff(ticks["tick"][first : last + 1].astype(float))
    slopes = np.linalg.norm(np.diff(expected, axis=0), axis=1) / np.diff(ticks["tick"][numbers].astype(float))
    around = np.maximum(slopes, np.maximum(np.append(slopes[1:], 0.0), np.append(0.0, slopes[:-1])))
    place = np.searchsorted(numbers, np.arange(first, last), side="right") - 1
    return rate - around[place] * passed


def judged(case: Case, reduced: ts.ReducedModel | None, mesh: SolidMesh | None, ticks: np.ndarray,
           asked: argparse.Namespace) -> dict:
    """Compare the forces of the ticks with replays."""
    forces, good = ticks["tissue_wrench"][:, :3], ticks["status"] == ts.ForceStatus.CONVERGED
    places = pieces(case, ticks, asked.every, asked.samples)
    found = solved(case, mesh, ticks, places)
    kept = [np.isfinite(each).all(axis=1) for each in found]
    numbers = np.concatenate([one[which] for one, which in zip(places, kept, strict=True)])
    true = np.concatenate([one[which] for one, which in zip(found, kept, strict=True)])
    rms = float(np.sqrt((true**2).sum(axis=1).mean()))
    missed = np.linalg.norm(forces[numbers] - true, axis=1)[good[numbers]]
    row: dict = {"rms_force_N": rms, "samples": len(numbers), "samples_not_solved": int(sum((~k).sum() for k in kept)),
                 "rms_percent": 100.0 / rms * float(np.sqrt((missed**2).mean())),
                 "p99_percent": 100.0 / rms * float(np.quantile(missed, 0.99)),
                 "largest_percent": 100.0 / rms * float(missed.max()),
                 "largest_change_N": float(np.linalg.norm(np.diff(forces, axis=0), axis=1).max())}
    if reduced is None:
        allowed = np.maximum(ERROR_FLOOR, ERROR_SHARE * np.linalg.norm(true, axis=1))[good[numbers]]
        row |= {"wrong_statuses": int((missed > allowed).sum()), "looked_at": int(good[numbers].sum())}
        jumps = np.concatenate([beyond(forces, one[which], ticks, place[which])
                                for one, which, place in zip(found, kept, places, strict=True) if which.sum() > 1])
    else:
        expected, answered = replayed(reduced, case, ticks)
        error = np.linalg.norm(forces - expected, axis=1)
        start, box = case.model().experiment.tool_pose(0.0), reduced.box
        inside = np.array([box.contains_pose(pose, start) or (not case.holds and pose.depth < 0.0)
                           for pose in poses_of(ticks)])
        # An answer that is none without a clock either, or a stop inside of the box.
        stopped = ticks["status"] == ts.ForceStatus.STOPPED
        wrong = (good & answered & (error > SHARE * rms)) | (good & ~answered) | (stopped & inside)
        row |= {"wrong_statuses": int(wrong.sum()), "looked_at": len(ticks),
                "largest_from_replay_N": float(error[good & answered].max())}
        jumps = beyond(forces, expected, ticks, np.arange(len(ticks)))
    return row | {"beyond_N": float(jumps.max()), "ticks_beyond": int((jumps > JUMP).sum()),
                  "p99.9_beyond_N": float(np.quantile(jumps, 0.999)), "ticks_looked_at": len(jumps)}


def counted(ticks: np.ndarray) -> dict:
    """Return times, ages and statuses of the ticks."""
    deadlines = int(ticks["tick"][-1] - ticks["tick"][0]) + 1
    missed, spent = deadlines - len(ticks), 1e3 * ticks["compute_time"]
    return {"ticks": len(ticks), "missed": missed, "missed_percent": 100.0 * missed / deadlines,
            "p50_ms": float(np.median(spent)), "p99_ms": float(np.quantile(spent, 0.99)),
            "p999_ms": float(np.quantile(spent, 0.999)), "largest_ms": float(spent.max()),
            "age_p50_ms": 1e3 * float(np.median(ticks["age"])),
            "age_p99_ms": 1e3 * float(np.quantile(ticks["age"], 0.99)),
            "statuses": {status.name: int((ticks["status"] == status).sum()) for status in ts.ForceStatus
                         if (ticks["status"] == status).any()}}


def measure(name: str, file: Path | None, asked: argparse.Namespace) -> dict:
    """Return one row of the table."""
    case = CASES[name]
    reduced = None
    if case.solver == "reduced":
        reduced = ts.load_reduced(file) if file else ts.reduce_solid(
            case.model(), ts.PoseBox(SIDEWAYS, DEPTH, case.turn))
    mesh = None if reduced is None else reduced.mesh
    kept = None if asked.keep is None else asked.keep / f"{name}.npz"
    if case.delay is not None:
        (ticks, mesh), page = stepped(case, asked.seconds, asked.seed), {}
    elif asked.judge and kept is not None:
        with np.load(kept) as stored:
            ticks, page = stored["ticks"], {}
    else:
        ticks, page = walked(case, reduced, asked.seconds, asked.seed, asked.chromium)
        page["load"] = os.getloadavg()[0]
    row = {"case": name, **counted(ticks), **page}
    if kept is not None and not asked.judge:
        kept.parent.mkdir(parents=True, exist_ok=True)
        np.savez(kept, ticks=ticks)
    if asked.walk_only:
        return row
    return row | judged(case, reduced, mesh, ticks, asked)


def draw(result: dict, console) -> None:
    for row in result["walks"]:
        table(console, row["case"], ["", "value"],
              [[name, f"{value:.4g}" if isinstance(value, float) else str(value)] for name, value in row.items()])


def main() -> None:
    parser = option_parser(__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="of each walk (default: 60)")
    parser.add_argument("--cases", nargs="+", default=list(CASES), choices=list(CASES))
    parser.add_argument("--seed", type=int, default=0, help="of the walks")
    parser.add_argument("--every", type=int, default=10, help="ticks between two that the whole solid is solved at")
    parser.add_argument("--samples", type=int, default=600, help="ticks that it is solved at, about")
    parser.add_argument("--chromium", action="store_true", help="Chromium shows the page, in place of a client")
    parser.add_argument("--keep", type=Path, help="folder for the ticks")
    parser.add_argument("--walk-only", action="store_true", help="judge the ticks later, with --judge")
    parser.add_argument("--judge", action="store_true", help="judge the ticks in the folder, and walk no more")
    for name in ("needle", "ball"):
        parser.add_argument(f"--{name}", type=Path, help="its reduced solid, a file of `tissue-sim reduce`")
    asked = parser.parse_args()
    walks = [measure(name, getattr(asked, name, None), asked) for name in asked.cases]
    show({**about("solid_walk", ("viser",)), "seconds": asked.seconds, "walks": walks}, draw, as_json=asked.json)


if __name__ == "__main__":
    main()
