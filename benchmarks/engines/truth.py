"""True forces of the jobs: of independent programs, or of this package at its finest mesh and step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import ROOT
from benchmarks.engines.jobs import JOBS, MATERIAL, MESHES, make_mesh
from benchmarks.engines.ours import OURS

#: Time step of the true forces of the jobs with inertia, s.
FINEST_STEP = 0.5e-3
#: Number of columns of a reference with displacement, mm, and force, N, on the axis.
AXIAL_COLUMNS = 2


@dataclass(frozen=True)
class Reference:
    """Stored reference curve of a job.

    Attributes:
        path: CSV file with comments; columns: displacement, mm, and force, N; or x and depth, mm, and three forces, N.
        source: program that computed the curve.
    """

    path: Path
    source: str


#: Folder of the curves that `benchmarks.engines.references` writes.
FOLDER = Path(__file__).with_name("reference")
#: Job -> reference curve.
REFERENCES = {
    "punch": Reference(ROOT / "tests" / "reference" / "punch_bonded_face_side_wall_RP.csv",
                       "independent axisymmetric Taylor-Hood elements, error 0.2 %"),
    "off_axis": Reference(FOLDER / "off_axis_ours.csv",
                          "tissue_sim, quadratic solid, error 0.6 %; CalculiX within 0.5 %"),
    "drag": Reference(FOLDER / "drag_ours.csv",
                      "tissue_sim, quadratic solid, error 0.7 %; its axisymmetric form within 1 %"),
}


def read_reference(job: str) -> dict[str, Any]:
    """Return positions, m, and forces, N, of a stored curve, no times, and its source."""
    reference = REFERENCES[job]
    lines = reference.path.read_text(encoding="utf-8").splitlines()
    rows = np.array([line.split(",") for line in lines if line[:1].isdigit() or line[:1] == "-"], dtype=float)
    positions, forces = np.zeros((len(rows), 3)), np.zeros((len(rows), 3))
    if rows.shape[1] == AXIAL_COLUMNS:
        positions[:, 2], forces[:, 2] = -1e-3 * rows[:, 0], rows[:, 1]
    else:
        positions[:, 0], positions[:, 2], forces[:] = 1e-3 * rows[:, 0], -1e-3 * rows[:, 1], rows[:, 2:]
    return {"positions": positions.tolist(), "forces": forces.tolist(), "times": None, "source": reference.source}


def simulate_truth(name: str) -> dict[str, Any]:
    """Return positions, m, forces, N, times, s, and source of the true curve of a job on the axis with inertia."""
    job = JOBS[name]
    positions, times = job.make_motion()
    assert times is not None, "quasi-static jobs have a stored reference"
    mesh = make_mesh(next(iter(MESHES)), job.offset)
    curve = OURS["axisymmetric"].run(job.make_test(mesh, FINEST_STEP, math.inf), MATERIAL)
    return {"positions": positions.tolist(), "forces": curve.forces.tolist(), "times": times.tolist(),
            "source": f"tissue_sim, axisymmetric, accurate, {1e3 * FINEST_STEP:g} ms"}
