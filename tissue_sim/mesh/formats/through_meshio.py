"""Meshes of Gmsh and VTK, through meshio: the extra ``meshes``."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

import numpy as np

from tissue_sim.bounded import uncounted
from tissue_sim.errors import InputError
from tissue_sim.files import open_file
from tissue_sim.mesh.formats.content import Cells, MeshContent

#: Ending -> module of meshio, and the number that the program of the format gives to what stands first.
_MODULES = {".msh": ("gmsh", 1), ".vtu": ("vtu", 0), ".vtk": ("vtk", 0)}
#: Arrays of integers with more values than this name nothing.
_MOST_VALUES = 100
#: Types of elements in Gmsh's files -> meshio's names.
_GMSH = {2: "triangle", 3: "quad", 4: "tetra", 5: "hexahedron", 9: "triangle6", 10: "quad9", 11: "tetra10",
         12: "hexahedron27", 16: "quad8", 17: "hexahedron20"}
#: What meshio calls the arrays of Gmsh that name nothing.
_OF_GMSH = ("gmsh:geometrical", "gmsh:dim_tags", "gmsh:bounding_entities")


def read_through_meshio(path: Path, largest: int) -> MeshContent:
    """The mesh of a file by its ending.

    Args:
        path: the file. largest: bytes that it may have.

    Raises:
        InputError: it cannot be read, or meshio is not installed.
    """
    module, first = _MODULES[path.suffix.lower()]
    with open_file(path, "a mesh", largest) as file:
        head = file.read(1)
    if not head:
        raise InputError("is empty, expected a mesh", file=path)
    try:
        with uncounted():
            reader = importlib.import_module(f"meshio.{module}")
    except ImportError as error:
        raise InputError(f"reading this mesh needs the package meshio ({error}); install it with pip install "
                         "'tissue-sim[meshes]', or save the mesh as .inp", file=path) from None
    try:
        mesh = reader.read(path)
    except MemoryError:
        raise
    except InputError:
        raise
    except BaseException as error:  # what it makes of a damaged file is anything, SystemExit included
        reason = str(error) or type(error).__name__
        raise InputError(f"cannot be read as the mesh that its ending {path.suffix!r} says it is: {reason}",
                         file=path) from None
    numbers, point_numbers = _numbers(path, largest) if module == "gmsh" else ({}, None)
    return _content(mesh, first, numbers, point_numbers)


def _content(mesh: Any, first: int, known: dict[str, np.ndarray], point_numbers: np.ndarray | None) -> MeshContent:
    points = np.asarray(mesh.points, dtype=float)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise InputError(f"its points have the shape {points.shape}, expected three coordinates each")
    if points.shape[1] == 2:
        points = np.column_stack([points, np.zeros(len(points))])
    cells, start, used = [], first, dict.fromkeys(known, 0)
    for block in mesh.cells:
        data = np.asarray(block.data)
        if data.ndim != 2 or not np.issubdtype(data.dtype, np.integer):
            raise InputError(f"its elements of the kind {block.type} are no table of node numbers")
        numbers = np.arange(start, start + len(data))
        of_kind = known.get(block.type)
        if of_kind is not None and used[block.type] + len(data) <= len(of_kind):
            numbers = of_kind[used[block.type] : used[block.type] + len(data)]
            used[block.type] += len(data)
        cells.append(Cells(block.type, data.astype(np.intp), numbers))
        start += len(data)
    if point_numbers is None or len(point_numbers) != len(points):
        point_numbers = np.arange(first, first + len(points))
    return MeshContent(points, point_numbers, cells, _point_sets(mesh), _cell_sets(mesh, cells))


def _point_sets(mesh: Any) -> dict[str, np.ndarray]:
    sets = {str(name): np.asarray(places, dtype=np.intp).ravel() for name, places in (mesh.point_sets or {}).items()}
    for name, values in (mesh.point_data or {}).items():
        values = np.asarray(values)
        if values.ndim == 1 and name not in _OF_GMSH:
            sets.update({each: np.flatnonzero(values == value) for each, value in _values(name, values)})
    return sets


def _cell_sets(mesh: Any, cells: list[Cells]) -> dict[str, list[np.ndarray]]:
    sets: dict[str, list[np.ndarray]] = {}
    for name, blocks in (mesh.cell_sets or {}).items():
        if name not in _OF_GMSH and len(blocks) == len(cells):
            sets[str(name)] = [np.zeros(0, dtype=np.intp) if block is None else np.asarray(block, dtype=np.intp).ravel()
                               for block in blocks]
    named = {int(value[0]): (str(name), int(value[1])) for name, value in (mesh.field_data or {}).items()
             if np.size(value) == 2}
    for name, blocks in (mesh.cell_data or {}).items():
        blocks = [np.asarray(block) for block in blocks]
        if name in _OF_GMSH or len(blocks) != len(cells) or any(block.ndim != 1 for block in blocks):
            continue
        for each, value in _values(name, np.concatenate(blocks) if blocks else np.zeros(0)):
            if name == "gmsh:physical":
                each = named.get(int(value), (f"physical {int(value)}", 0))[0]
            sets.setdefault(each, [np.flatnonzero(block == value) for block in blocks])
    return sets


def _values(name: str, values: np.ndarray) -> list[tuple[str, float]]:
    """Names of the sets that an array of integers stands for, and the value of each: ``name`` where it marks, with
    ones, what belongs to one set, else ``name:value``."""
    finite = np.isfinite(values) if np.issubdtype(values.dtype, np.number) else np.zeros(values.shape, dtype=bool)
    if not values.size or not finite.all() or (values != np.rint(values)).any():
        return []
    found = np.unique(values)
    if found.size > _MOST_VALUES:
        return []
    if set(found.tolist()) <= {0, 1}:
        return [(name, 1.0)]
    return [(f"{name}:{int(value)}", float(value)) for value in found]


def _numbers(path: Path, largest: int) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
    """Numbers of the elements of a text file of Gmsh, by their kind, in the order of the file, and those
    of the nodes; meshio forgets them. None of a binary file, which Gmsh numbers one after the other."""
    with open_file(path, "a mesh", largest) as file:
        data = file.read(largest + 1)
    head = re.match(rb"\s*\$MeshFormat\s+(\S+)\s+0\s", data)
    if head is None:
        return {}, None
    try:
        lines = [line.split() for line in data.decode("ascii", "replace").splitlines()]
        elements, nodes = (lines[lines.index([f"${name}"]) + 1 : lines.index([f"$End{name}"])]
                           for name in ("Elements", "Nodes"))
        found: dict[str, list[int]] = {}
        if head[1].startswith(b"2"):
            for row in elements[1:]:
                found.setdefault(_GMSH.get(int(row[1]), ""), []).append(int(row[0]))
            points = [int(row[0]) for row in nodes[1:]]
        else:
            at = 1
            while at < len(elements):
                kind, count = _GMSH.get(int(elements[at][2]), ""), int(elements[at][3])
                found.setdefault(kind, []).extend(int(row[0]) for row in elements[at + 1 : at + 1 + count])
                at += count + 1
            points, at = [], 1
            while at < len(nodes):
                count = int(nodes[at][3])
                points += [int(row[0]) for row in nodes[at + 1 : at + 1 + count]]
                at += 2 * count + 1
        return {kind: np.array(numbers) for kind, numbers in found.items()}, np.array(points)
    except (ValueError, IndexError):
        return {}, None
