"""Runs of the benchmark of engines, and the file of their results, which a stopped benchmark continues."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import date
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import tissue_sim as ts
from benchmarks.engines import newton_xpbd
from benchmarks.engines.jobs import CALCULIX_BULK_RATIO, JOBS, MATERIAL, MESHES, Job, make_mesh
from benchmarks.engines.ours import OURS
from benchmarks.engines.truth import REFERENCES, read_reference, simulate_truth
from calibration.targets.calculix import RUNNER as CALCULIX
from calibration.targets.matching import CalibratedForces, compute_calibrated_forces, match_constants
from calibration.targets.runner import RUNNERS, TargetCurve, TargetRunner
from tissue_sim.errors import InputError
from tissue_sim.exports.elastic_constants import ElasticConstants, linearise_material

#: Largest Poisson's ratio of engines with elastic constants, 1.
MAX_POISSON = 0.49
#: Poisson's ratio of the fitted constants, 1, of bonded tools and of tools in contact, as `material export --match`
#: finds it: near 0.49 linear tetrahedra lock, which a ball in contact feels more than a bonded face.
POISSON = {True: 0.49, False: 0.45}
#: Longest wall time of one position, s.
MAX_POSITION_SECONDS = 40.0
#: Title of an engine -> material that replaces `MATERIAL`.
MATERIALS = {CALCULIX.title: replace(MATERIAL, bulk=ts.Bulk("bulk_ratio", CALCULIX_BULK_RATIO))}
#: Engines whose constants are not fitted: XPBD does not come to rest, and its force is not proportional to E.
UNMATCHED = ("newton_xpbd",)
#: Number of depths, the surface included, at which the constants are fitted.
MATCHED_POINTS = 11
#: Name of the mesh of engines that make their own.
OWN_MESH = "own"
#: Job whose pressing part the constants reproduce, for bonded tools and for contact.
MATCHED_JOBS = {True: "punch", False: "drag"}


@dataclass(frozen=True)
class Run:
    """One run of the benchmark.

    Attributes:
        engine: name of the engine.
        job: name of the job.
        mesh: name of the mesh.
        step: time step, s; 0: a static program.
        is_matched: whether the constants reproduce the calibrated test; False: those of the material at rest. True for
            engines with the law of the material.
    """

    engine: str
    job: str
    mesh: str
    step: float
    is_matched: bool = True

    @property
    def key(self) -> str:
        """Key of the run in the file of results."""
        return json.dumps([self.engine, self.job, self.mesh, self.step, self.is_matched])


class Results:
    """File of results, one JSON object a line; a run is appended when it ends.

    Args:
        path: file; it need not exist.
    """

    def __init__(self, path: Path):
        self.path = path

    def read(self) -> dict[str, dict[str, Any]]:
        """Return the rows by key; of rows with the same key the last."""
        if not self.path.exists():
            return {}
        rows = [json.loads(line) for line in self.path.read_text(encoding="utf-8").splitlines() if line]
        return {row["key"]: row for row in rows}

    def append(self, row: dict[str, Any]) -> None:
        """Append a row."""
        with self.path.open("a", encoding="utf-8") as stream:
            stream.write(json.dumps(row) + "\n")


def list_engines() -> dict[str, TargetRunner]:
    """Return name -> engine: the four forms of this package, then the runners of other programs."""
    return {**OURS, **RUNNERS, "newton_xpbd": newton_xpbd.ENGINE}


def list_runs(engines: Sequence[str], jobs: Sequence[str], meshes: Sequence[str]) -> Iterator[Run]:
    """Yield the runs of these engines, jobs and meshes, in two time steps; constants before and after matching.

    Static programs run quasi-static jobs only, without a time step (0).
    """
    known = list_engines()
    for job in jobs:
        for engine in engines:
            has_own_mesh = engine in OURS and not OURS[engine].uses_mesh_of_test
            for mesh in (OWN_MESH,) if has_own_mesh else meshes:
                if known[engine].is_static:
                    if JOBS[job].is_quasi_static:
                        yield Run(engine, job, mesh, 0.0)
                    continue
                for step in JOBS[job].steps:
                    yield Run(engine, job, mesh, step, is_matched=engine not in UNMATCHED)
                if known[engine].uses_elastic_constants and engine not in UNMATCHED:
                    yield Run(engine, job, mesh, JOBS[job].steps[-1], is_matched=False)


def get_or_compute_truth(job: str, results: Results) -> dict[str, Any]:
    """Return the true curve of a job: a stored reference, or a simulation that is computed once."""
    if job in REFERENCES:
        return read_reference(job)
    key = json.dumps(["truth", job])
    rows = results.read()
    if key not in rows:
        results.append({"key": key, **simulate_truth(job)})
        rows = results.read()
    return rows[key]


def execute(run: Run, results: Results) -> dict[str, Any]:
    """Execute a run and return its row; a failure of the engine is part of the row."""
    engine, job = list_engines()[run.engine], JOBS[run.job]
    began, constants = time.perf_counter(), None
    missing = engine.describe_missing_program()
    if missing:
        raise InputError(f"{engine.title} cannot run here: {missing}", field="--engine")
    try:
        if engine.uses_elastic_constants:
            constants = get_or_fit_constants(run, job, results)
        curve = run_job(engine, job, run.mesh, run.step, constants)
    except InputError as error:
        curve = TargetCurve(np.zeros((0, 3)), np.zeros((0, 3)), ended=str(error))
    return {"key": run.key, **asdict(run), "title": engine.title, "constants": constants and asdict(constants),
            "forces": np.round(curve.forces, 6).tolist(), "ended": curve.ended, "step_seconds": curve.step_seconds,
            "steps": int(np.sum(curve.steps)), "penetrations": np.round(curve.penetrations, 7).tolist(),
            "flagged": curve.flagged, "version": curve.version, "wall_seconds": time.perf_counter() - began,
            "date": date.today().isoformat()}


def run_job(engine: TargetRunner, job: Job, mesh: str, step: float, constants: ElasticConstants | None) -> TargetCurve:
    """Run a job in an engine, with its constants or with the material of the study."""
    size = next(iter(MESHES)) if mesh == OWN_MESH else mesh
    test = job.make_test(make_mesh(size, job.offset), step or None, MAX_POSITION_SECONDS)
    return engine.run(test, MATERIALS.get(engine.title, MATERIAL) if constants is None else constants)


def get_or_fit_constants(run: Run, job: Job, results: Results) -> ElasticConstants:
    """Return the constants of a run: those of the material at rest, or those that reproduce the pressing of a job.

    The constants are fitted once for each engine, mesh and kind of contact, at the Poisson's ratio of `POISSON`.
    """
    if not run.is_matched:
        return linearise_material(MATERIAL, MAX_POISSON)
    key = json.dumps(["constants", run.engine, run.mesh, job.is_bonded])
    if key not in (rows := results.read()):
        pressing = JOBS[MATCHED_JOBS[job.is_bonded]]
        matched = match_constants(pressing.make_model(MATCHED_POINTS), _compute_calibrated_forces(pressing.name),
                                  MAX_POISSON, poisson=POISSON[job.is_bonded], runner=list_engines()[run.engine],
                                  mesh=make_mesh(run.mesh, 0.0), max_seconds=MAX_POSITION_SECONDS)
        results.append({
            "key": key, "engine": run.engine, "mesh": run.mesh, "is_bonded": job.is_bonded,
            "calibrated_depths": matched.calibrated.depths.tolist(), "constants": asdict(matched.constants),
            "uncompensated": asdict(matched.uncompensated),
            "depths": matched.depths.tolist(), "forces": matched.target_forces.tolist(),
            "errors": matched.errors.tolist(), "uncompensated_errors": matched.uncompensated_errors.tolist(),
            "ended": matched.ended, "runs": matched.runs, "version": matched.version})
        rows = results.read()
    return ElasticConstants(**rows[key]["constants"])


def list_constants(stored: dict[str, dict[str, Any]], engines: Sequence[str]) -> list[dict[str, Any]]:
    """Return the rows of fitted constants of engines."""
    return [row for key, row in stored.items() if json.loads(key)[0] == "constants" and row["engine"] in engines]


@cache
def _compute_calibrated_forces(job: str) -> CalibratedForces:
    """Return the calibrated forces of the pressing of a job."""
    return compute_calibrated_forces(JOBS[job].make_model(MATCHED_POINTS))
