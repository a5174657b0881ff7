"""Convert meshes from files to named arrays and back, to store them in files of this program."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from tissue_sim.mesh.formats.checks import require_valid_mesh
from tissue_sim.mesh.formats.content import SIDES, SOLIDS, CellBlock
from tissue_sim.mesh.solid_file import FileMesh

#: Prefix of the names of arrays with named faces.
_SIDES = "sides "
#: Prefix of the names of arrays with regions.
_REGION = "region "


def file_mesh_to_arrays(mesh: FileMesh) -> dict[str, np.ndarray]:
    """Return the content of a mesh as named arrays, without the kind of elements and the digest."""
    arrays = {"cells": mesh.cells.nodes, "numbers": mesh.cells.numbers, "points": mesh.points, "sides": mesh.sides}
    arrays |= {_SIDES + name: members for name, members in mesh.named_sides.items()}
    return arrays | {_REGION + name: members for name, members in mesh.regions.items()}


def file_mesh_from_arrays(arrays: Mapping[str, np.ndarray], kind: str, digest: str) -> FileMesh:
    """Return the mesh from the arrays of `file_mesh_to_arrays`.

    Args:
        arrays: arrays by name.
        kind: kind of the elements, `CellBlock.kind`.
        digest: digest of the original file.

    Raises:
        ValueError: the arrays do not match each other.
        KeyError: an array is missing, or the kind of elements is unknown.
        InputError: the mesh is invalid.
    """
    nodes, numbers, points, sides = (arrays[name] for name in ("cells", "numbers", "points", "sides"))
    named = {name.removeprefix(_SIDES): each for name, each in arrays.items() if name.startswith(_SIDES)}
    regions = {name.removeprefix(_REGION): each for name, each in arrays.items() if name.startswith(_REGION)}
    cells = CellBlock(kind, nodes, numbers)

    def are_indices(array: np.ndarray, count: int, *shape: int) -> bool:
        """Return whether an array of rows of the shape `shape` contains indices from 0 to count - 1."""
        return (array.dtype.kind in "iu" and array.ndim == 1 + len(shape) and array.shape[1:] == shape
                and array.size > 0 and int(array.min()) >= 0 and int(array.max()) < count)

    if not (points.ndim == 2 and points.shape[1] == 3 and points.dtype.kind == "f" and np.isfinite(points).all()
            and are_indices(nodes, len(points), SOLIDS[kind]) and numbers.shape == nodes.shape[:1]
            and are_indices(sides, len(points), len(SIDES[cells.cell_shape][0]))
            and all(are_indices(each, len(sides)) for each in named.values())
            and all(are_indices(each, len(nodes)) for each in regions.values())):
        raise ValueError("the arrays of the mesh do not match each other; write the file of the model again")
    require_valid_mesh(cells, points, np.arange(len(points)))
    return FileMesh(cells, points, sides, named, regions, digest)
