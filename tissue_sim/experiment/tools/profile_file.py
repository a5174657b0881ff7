"""Outlines of tools from two-column files."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.files import read_text

#: Largest size of a file, bytes.
_LARGEST = 1_000_000


def read_outline_points(path: str | Path) -> np.ndarray:
    """Read the outline of a tool.

    The file has two columns of numbers, r and z in mm, separated by commas, semicolons or blanks; lines that start
    with ``#`` and one header line are skipped. The first point must lie on the axis and be the deepest; the outline
    must run outwards and upwards and be convex.

    Returns:
        Points (r, z), m, the first at z = 0, shape (n, 2).

    Raises:
        InputError: no such file, a line that is not two numbers, or an invalid outline; with file and line.
    """
    path = Path(path)
    lines = read_text(path, "the profile of a tool, r and z in mm", _LARGEST).splitlines()
    points: list[list[float]] = []
    places: list[int] = []
    headers = 0
    for number, line in enumerate(lines, 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        cells = line.replace(",", " ").replace(";", " ").split()
        try:
            values = [float(cell) for cell in cells]
        except ValueError:
            values = []
        if not values and not points and not headers:
            headers = 1
            continue
        if len(values) != 2 or not np.isfinite(values).all():
            raise InputError(f"{line.strip()!r} is not a point of a profile, expected r and z in mm", file=path,
                             line=number)
        points.append(values)
        places.append(number)
    if len(points) < 2:
        raise InputError("a profile needs at least two points, r and z in mm", file=path)
    outline = 1e-3 * np.array(points)
    if fault := find_first_invalid_point_and_problem(outline):
        where, problem = fault
        raise InputError(problem, file=path, line=places[where])
    return outline - [0.0, outline[0, 1]]


def find_first_invalid_point_and_problem(outline: np.ndarray) -> tuple[int, str] | None:
    """Return index and problem of the first invalid point of an outline, (r, z), m, shape (n, 2), or None."""
    if outline[0, 0] != 0.0:
        return 0, f"the first point has r = {1e3 * outline[0, 0]:g} mm; a profile starts on the axis, r = 0"
    segment = np.diff(outline, axis=0)
    for k, (dr, dz) in enumerate(segment):
        if dr < 0 or dz < 0 or (dr == 0 and dz == 0) or (k == 0 and dr == 0):
            return k + 1, "the profile must run outwards and upwards from its deepest point"
        before = segment[k - 1]
        if k and before[0] * dz - before[1] * dr < -1e-12 * np.linalg.norm(before) * np.hypot(dr, dz):
            return k, "the profile must be convex; it is hollow here"
    return None
