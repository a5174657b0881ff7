"""Reference curves of the jobs off the axis and with a dragged ball: CalculiX and this package on refined meshes.

    python -m benchmarks references off_axis|drag [--program calculix|ours] [--element linear|quadratic]
        [--levels 1 2 3] [--json] [--write]

Both problems are symmetric about the plane y = 0: the mesh is the half y >= 0, and its force is doubled. Each mesh is a
separate run of minutes. `--write` stores the curve of the finest level in benchmarks/engines/reference, with the
differences between the levels.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

import tissue_sim as ts
from benchmarks.engines.jobs import (
    BULK_RATIO,
    CALCULIX_BULK_RATIO,
    FRICTION,
    HEIGHT,
    MATERIAL,
    RADIUS,
    TOOL_RADIUS,
)
from calibration.targets.calculix import ELEMENTS as CALCULIX_ELEMENTS
from calibration.targets.calculix import RUNNER as CALCULIX
from calibration.targets.runner import TargetTest
from tissue_sim.fem.contact.pairs import ContactPair
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh.solid import SolidMesh, create_cylinder_mesh_under_needle, create_mesh_with_surface_sets
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1, Hexahedron
from tissue_sim.pose import Pose

#: Folder of the stored curves.
FOLDER = Path(__file__).with_name("reference")
#: Number of load steps of tissue_sim between two positions.
SUBSTEPS = 2
#: Largest penetration of a node in tissue_sim, m.
PENETRATION = 1e-6
#: Longest time of a position in CalculiX, s.
MAX_SECONDS = 900.0
#: Elements: name on the command line -> element. CalculiX gets C3D8I for `linear` and C3D20R for `quadratic`.
ELEMENTS = {"linear": HEX8P0, "quadratic": HEX27P1}


@dataclass(frozen=True)
class Problem:
    """Problem with a reference curve.

    Attributes:
        title: description in a few words.
        tool: rigid tool.
        is_bonded: whether the face is bonded; otherwise the tool is in contact with `friction`.
        friction: coefficient of friction, 1.
        positions: positions of the tool, m, shape (n, 3).
        centre: position along x of the centre of the finest part of the mesh, m.
        levels: smallest size at the edge of the circle, m, ratio of successive sizes, largest size, m, and number of
            elements along a quarter of the circle, for each level; even, so that y = 0 lies between elements.
    """

    title: str
    tool: ts.Tool
    is_bonded: bool
    friction: float
    positions: np.ndarray
    centre: float
    levels: tuple[tuple[float, float, float, int], ...]

    def make_mesh(self, level: int, element: Hexahedron) -> SolidMesh:
        """Make the half mesh of a level, from 1."""
        smallest, growth, largest, around = self.levels[level - 1]
        return halve_mesh(create_cylinder_mesh_under_needle(RADIUS, HEIGHT, TOOL_RADIUS, element, smallest=smallest,
                                                            growth=growth, largest=largest, around=around,
                                                            centre=(self.centre, 0.0)))


def halve_mesh(mesh: SolidMesh) -> SolidMesh:
    """Return the half y >= 0 of a mesh, with the node set ``symmetry`` of the plane y = 0 outside base and face.

    Raises:
        ValueError: the plane cuts elements.
    """
    slack = 1e-9 * float(np.ptp(mesh.nodes[:, 1]))
    kept = (mesh.nodes[mesh.connectivity, 1] >= -slack).all(axis=1)
    if 2 * np.count_nonzero(kept) != len(kept):
        raise ValueError("the plane y = 0 must lie between elements")
    used, connectivity = np.unique(mesh.connectivity[kept], return_inverse=True)
    half = create_mesh_with_surface_sets(mesh.element, mesh.nodes[used],
                                         connectivity.reshape(-1, mesh.element.node_count))
    face = np.flatnonzero(np.isin(used, mesh.sets["face"]))
    on_plane = np.flatnonzero(np.abs(half.nodes[:, 1]) <= slack)
    symmetry = np.setdiff1d(on_plane, np.union1d(face, half.sets["base"]))
    return replace(half, sets={**half.sets, "face": face, "symmetry": symmetry})


def _list_positions(*corners: tuple[float, float, float], spacing: float) -> np.ndarray:
    """Return positions on the straight lines between corners (x, y, z), with equal spacing, m, shape (n, 3)."""
    path = [np.array(corners[0])]
    for start, end in pairwise(np.array(corners)):
        count = round(float(np.linalg.norm(end - start)) / spacing)
        path += [start + k / count * (end - start) for k in range(1, count + 1)]
    return np.array(path)


#: Levels of both problems.
LEVELS = ((3.2e-3, 2.4, 20e-3, 2), (2.2e-3, 2.2, 18e-3, 2), (1.6e-3, 2.0, 16e-3, 4), (0.8e-3, 2.0, 14e-3, 4),
          (0.4e-3, 2.0, 14e-3, 4))
#: Name -> problem.
PROBLEMS = {
    "off_axis": Problem("bonded flat punch 15 mm off the axis, 10 mm deep", ts.Tool("flat", radius=TOOL_RADIUS), True,
                        0.0, _list_positions((15e-3, 0.0, 0.0), (15e-3, 0.0, -10e-3), spacing=1e-3), 15e-3,
                        LEVELS),
    "drag": Problem("ball with friction 0.3, 5 mm deep, then 5 mm along x", ts.Tool("sphere", radius=TOOL_RADIUS),
                    False, FRICTION,
                    _list_positions((0.0, 0.0, 0.0), (0.0, 0.0, -5e-3), (5e-3, 0.0, -5e-3), spacing=0.5e-3), 2.5e-3,
                    LEVELS),
}


def run_calculix(problem: Problem, level: int, ratio: float, element: Hexahedron) -> tuple[np.ndarray, str]:
    """Return forces on the tool at the reached positions, N, shape (n, 3), and the reason of an early end."""
    test = TargetTest(problem.make_mesh(level, element), problem.tool, problem.positions, problem.is_bonded,
                      problem.friction, max_seconds=MAX_SECONDS)
    material = replace(MATERIAL, bulk=ts.Bulk("bulk_ratio", ratio))
    curve = CALCULIX.run(test, material)
    return 2.0 * curve.forces * [1.0, 0.0, 1.0], curve.ended


def run_ours(problem: Problem, level: int, ratio: float, element: Hexahedron) -> tuple[np.ndarray, str]:
    """Return forces on the tool at the reached positions, N, shape (n, 3), and the reason of an early end."""
    mesh = problem.make_mesh(level, element)
    material = replace(MATERIAL, bulk=ts.Bulk("bulk_ratio", ratio))
    start, fixed = Pose(tuple(problem.positions[0])), {"base": "xyz", "symmetry": "y"}
    if problem.is_bonded:
        solver = SolidSolver(mesh, material, fixed, mesh.sets["face"], start=start)
    else:
        pair = ContactPair(problem.tool.profile, mesh.sets["top"], (problem.friction, problem.friction))
        solver = SolidSolver(mesh, material, fixed, np.zeros(0, int), pairs=[pair], tolerance=PENETRATION,
                             start=start)
    forces = [np.zeros(3)]
    for before, after in pairwise(problem.positions):
        for part in range(1, SUBSTEPS + 1):
            step = solver.step(Pose(tuple(before + part / SUBSTEPS * (after - before))))
            if step.status is not StepStatus.CONVERGED:
                return np.array(forces), step.status.message
        forces.append(2.0 * np.array(step.wrench[:3]) * [1.0, 0.0, 1.0])
    return np.array(forces), ""


#: Program -> function that computes a curve, and K / mu0.
PROGRAMS = {"calculix": (run_calculix, CALCULIX_BULK_RATIO), "ours": (run_ours, BULK_RATIO)}


def format_curve(problem: Problem, program: str, rows: Sequence[dict]) -> str:
    """Return the text of a CSV file with the curve of the finest level.

    Args:
        problem: problem.
        program: name and version of the program, with element and K / mu0.
        rows: results of `main`, coarsest level first.
    """
    finest = np.array(rows[-1]["forces"])
    lines = [f"# {problem.title}", "# cylinder 40 mm x 70 mm, base bonded, no gravity, reduced polynomial N = 2 "
             "(C10 = 1404.9 Pa, C20 = 699.4 Pa), tool radius 8 mm, no contact with the side wall of a bonded punch",
             f"# {program}"]
    for row in rows:
        end = row["forces"][-1]
        lines.append(f"# level {row['level']}: {row['elements']} elements, {row['nodes']} nodes: Fx = {end[0]:.5f} N, "
                     f"Fz = {end[2]:.5f} N at the last position")
    if len(rows) > 1:
        before = np.array(rows[-2]["forces"])
        count = min(len(before), len(finest))
        size = np.linalg.norm(finest[1:count], axis=1)
        change = np.linalg.norm(finest[1:count] - before[1:count], axis=1) / size
        lines.append("# difference of the last two levels, relative, at each position: "
                     + ", ".join(f"{each:.1e}" for each in change))
        coarse, fine = (problem.levels[row["level"] - 1][0] for row in rows[-2:])
        limit = finest[count - 1] + fine / (coarse - fine) * (finest[count - 1] - before[count - 1])
        error = float(np.linalg.norm(finest[count - 1] - limit)) / size[-1]
        lines.append(f"# linear extrapolation of the last two levels to an edge size of 0: Fx = {limit[0]:.5f} N, "
                     f"Fz = {limit[2]:.5f} N; relative difference from the curve, its error: {error:.1e}")
    lines.append("x_mm,depth_mm,Fx_N,Fy_N,Fz_N")
    for position, force in zip(problem.positions, finest, strict=False):
        lines.append(f"{1e3 * position[0]:.4g},{-1e3 * position[2] + 0.0:.4g},"
                     + ",".join(f"{part:.5f}" for part in np.round(force, 5) + 0.0))
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("problem", choices=tuple(PROBLEMS))
    parser.add_argument("--program", choices=tuple(PROGRAMS), default="ours")
    parser.add_argument("--levels", type=int, nargs="+", default=[1, 2, 3])
    parser.add_argument("--element", choices=tuple(ELEMENTS), default="quadratic")
    parser.add_argument("--ratio", type=float, help="K / mu0; default: 1e4, in CalculiX 1e3")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--write", action="store_true")
    asked = parser.parse_args()
    problem, (run, ratio) = PROBLEMS[asked.problem], PROGRAMS[asked.program]
    ratio, element = asked.ratio or ratio, ELEMENTS[asked.element]
    rows = []
    for level in asked.levels:
        mesh, began = problem.make_mesh(level, element), time.perf_counter()
        forces, ended = run(problem, level, ratio, element)
        rows.append({"problem": asked.problem, "program": asked.program, "element": asked.element,
                     "ratio": ratio, "level": level,
                     "elements": len(mesh.connectivity), "nodes": len(mesh.nodes), "ended": ended,
                     "wall_s": time.perf_counter() - began, "forces": forces.tolist()})
        print(json.dumps(rows[-1], indent=None if asked.json else 1), flush=True)
        if asked.write:
            title = {"calculix": f"CalculiX 2.20, {CALCULIX_ELEMENTS[element.name].name}",
                     "ours": f"tissue_sim {ts.__version__}, solid solver, {element.node_count}-node hexahedra"}
            FOLDER.mkdir(exist_ok=True)
            (FOLDER / f"{asked.problem}_{asked.program}.csv").write_text(
                format_curve(problem, f"{title[asked.program]}, K/mu0 = {ratio:g}, half model", rows), encoding="utf-8")


if __name__ == "__main__":
    main()
