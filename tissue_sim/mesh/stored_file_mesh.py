"""Meshes of files as named arrays, for files of our own that keep them."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tissue_sim.mesh.formats.checks import require_sound
from tissue_sim.mesh.formats.content import SIDES, SOLIDS, Cells
from tissue_sim.mesh.solid_file import FileMesh

_SIDES, _REGION = "sides ", "region "


def file_mesh_arrays(mesh: FileMesh) -> dict[str, np.ndarray]:
    """All that a mesh of a file is but its kind of elements and its digest, by name."""
    arrays = {"cells": mesh.cells.nodes, "numbers": mesh.cells.numbers, "points": mesh.points, "sides": mesh.sides}
    arrays |= {_SIDES + name: places for name, places in mesh.named_sides.items()}
    return arrays | {_REGION + name: places for name, places in mesh.regions.items()}


def file_mesh_of_arrays(arrays: Mapping[str, np.ndarray], kind: str, digest: str) -> FileMesh:
    """The mesh that `file_mesh_arrays` took apart.

    Args:
        arrays: by name. kind: of its elements, `Cells.kind`. digest: of the file that it was read from.

    Raises:
        ValueError: arrays that do not fit each other.
        KeyError: one is missing, or no kind of elements.
        InputError: a mesh that is not sound.
    """
    nodes, numbers, points, sides = (arrays[name] for name in ("cells", "numbers", "points", "sides"))
    named = {name.removeprefix(_SIDES): each for name, each in arrays.items() if name.startswith(_SIDES)}
    regions = {name.removeprefix(_REGION): each for name, each in arrays.items() if name.startswith(_REGION)}
    cells = Cells(kind, nodes, numbers)

    def places(array: np.ndarray, count: int, *shape: int) -> bool:
        return (array.dtype.kind in "iu" and array.ndim == 1 + len(shape) and array.shape[1:] == shape
                and array.size > 0 and int(array.min()) >= 0 and int(array.max()) < count)

    if not (points.ndim == 2 and points.shape[1] == 3 and points.dtype.kind == "f" and np.isfinite(points).all()
            and places(nodes, len(points), SOLIDS[kind]) and numbers.shape == nodes.shape[:1]
            and places(sides, len(points), len(SIDES[cells.shape][0]))
            and all(places(each, len(sides)) for each in named.values())
            and all(places(each, len(nodes)) for each in regions.values())):
        raise ValueError("the mesh of a file")
    require_sound(cells, points, np.arange(len(points)))
    return FileMesh(cells, points, sides, named, regions, digest)
