"""Read mesh files of Gmsh and VTK with meshio; requires the extra ``meshes``."""

from __future__ import annotations

import importlib
import re
from pathlib import Path
from typing import Any

import numpy as np

from tissue_sim.bounded import exclude_cpu_time_from_limit
from tissue_sim.errors import InputError
from tissue_sim.files import open_input_file
from tissue_sim.mesh.formats.checks import CellBlock, MeshContent

#: File name extension -> module of meshio, and number of the first node or element in this format.
_MODULES = {".msh": ("gmsh", 1), ".vtu": ("vtu", 0), ".vtk": ("vtk", 0)}
#: Maximum number of different values of an integer array that defines sets.
_MAX_VALUES = 100
#: Element type in Gmsh files -> name in meshio.
_GMSH = {2: "triangle", 3: "quad", 4: "tetra", 5: "hexahedron", 9: "triangle6", 10: "quad9", 11: "tetra10",
         12: "hexahedron27", 16: "quad8", 17: "hexahedron20"}
#: Names of Gmsh arrays in meshio that define no sets.
_IGNORED = ("gmsh:geometrical", "gmsh:dim_tags", "gmsh:bounding_entities")


def read_through_meshio(path: Path, largest: int) -> MeshContent:
    """Read a mesh file; the format depends on the file name extension.

    Args:
        path: path of the file.
        largest: maximum size of the file, bytes.

    Raises:
        InputError: the file cannot be read, or meshio is not installed.
    """
    module, first = _MODULES[path.suffix.lower()]
    with open_input_file(path, "a mesh", largest) as file:
        head = file.read(1)
    if not head:
        raise InputError("is empty, expected a mesh", file=path)
    try:
        with exclude_cpu_time_from_limit():
            reader = importlib.import_module(f"meshio.{module}")
    except ImportError as error:
        raise InputError(f"reading this mesh requires the package meshio ({error}); install it with pip install "
                         "'tissue-sim[meshes]', or save the mesh as .inp", file=path) from None
    try:
        mesh = reader.read(path)
    except MemoryError:
        raise
    except InputError:
        raise
    except BaseException as error:  # meshio may raise any exception for a damaged file, including SystemExit
        reason = str(error) or type(error).__name__
        raise InputError(f"cannot be read as a mesh of the format {path.suffix!r}: {reason}", file=path) from None
    numbers, point_numbers = _read_gmsh_element_and_node_numbers(path, largest) if module == "gmsh" else ({}, None)
    return _convert_mesh(mesh, first, numbers, point_numbers)


def _convert_mesh(mesh: Any, first: int, known: dict[str, np.ndarray], point_numbers: np.ndarray | None) -> MeshContent:
    """Return the content of a mesh of meshio; nodes and elements without known numbers count from `first`."""
    points = np.asarray(mesh.points, dtype=float)
    if points.ndim != 2 or points.shape[1] not in (2, 3):
        raise InputError(f"points must have three coordinates each; got an array of shape {points.shape}")
    if points.shape[1] == 2:
        points = np.column_stack([points, np.zeros(len(points))])
    cells, start, used = [], first, dict.fromkeys(known, 0)
    for block in mesh.cells:
        data = np.asarray(block.data)
        if data.ndim != 2 or not np.issubdtype(data.dtype, np.integer):
            raise InputError(f"elements of the kind {block.type} must be a table of node numbers; got an array of "
                             f"shape {data.shape} and type {data.dtype}")
        numbers = np.arange(start, start + len(data))
        of_kind = known.get(block.type)
        if of_kind is not None and used[block.type] + len(data) <= len(of_kind):
            numbers = of_kind[used[block.type] : used[block.type] + len(data)]
            used[block.type] += len(data)
        cells.append(CellBlock(block.type, data.astype(np.intp), numbers))
        start += len(data)
    if point_numbers is None or len(point_numbers) != len(points):
        point_numbers = np.arange(first, first + len(points))
    return MeshContent(points, point_numbers, cells, _collect_point_sets(mesh), _collect_cell_sets(mesh, cells))


def _collect_point_sets(mesh: Any) -> dict[str, np.ndarray]:
    """Return name -> sorted point indices of the sets that a mesh of meshio defines by point sets or integer arrays."""
    sets = {str(name): np.asarray(members, dtype=np.intp).ravel() for name, members in (mesh.point_sets or {}).items()}
    for name, values in (mesh.point_data or {}).items():
        values = np.asarray(values)
        if values.ndim == 1 and name not in _IGNORED:
            sets.update({each: np.flatnonzero(values == value) for each,
                         value in _list_set_names_and_values(name, values)})
    return sets


def _collect_cell_sets(mesh: Any, cells: list[CellBlock]) -> dict[str, list[np.ndarray]]:
    """Return name -> element indices in each block of the sets that cell sets, integer arrays or groups define."""
    sets: dict[str, list[np.ndarray]] = {}
    for name, blocks in (mesh.cell_sets or {}).items():
        if name not in _IGNORED and len(blocks) == len(cells):
            sets[str(name)] = [np.zeros(0, dtype=np.intp) if block is None else np.asarray(block, dtype=np.intp).ravel()
                               for block in blocks]
    named = {int(value[0]): (str(name), int(value[1])) for name, value in (mesh.field_data or {}).items()
             if np.size(value) == 2}
    for name, blocks in (mesh.cell_data or {}).items():
        blocks = [np.asarray(block) for block in blocks]
        if name in _IGNORED or len(blocks) != len(cells) or any(block.ndim != 1 for block in blocks):
            continue
        for each, value in _list_set_names_and_values(name, np.concatenate(blocks) if blocks else np.zeros(0)):
            if name == "gmsh:physical":
                each = named.get(int(value), (f"physical {int(value)}", 0))[0]
            sets.setdefault(each, [np.flatnonzero(block == value) for block in blocks])
    return sets


def _list_set_names_and_values(name: str, values: np.ndarray) -> list[tuple[str, float]]:
    """Return the sets that an integer array defines: for each set its name, and the array value of its members.

    An array of zeros and ones defines one set with the name of the array; other arrays define sets ``name:value``. An
    array that is not integer or has more than 100 values defines no set.
    """
    finite = np.isfinite(values) if np.issubdtype(values.dtype, np.number) else np.zeros(values.shape, dtype=bool)
    if not values.size or not finite.all() or (values != np.rint(values)).any():
        return []
    found = np.unique(values)
    if found.size > _MAX_VALUES:
        return []
    if set(found.tolist()) <= {0, 1}:
        return [(name, 1.0)]
    return [(f"{name}:{int(value)}", float(value)) for value in found]


def _read_gmsh_element_and_node_numbers(path: Path, largest: int) -> tuple[dict[str, np.ndarray], np.ndarray | None]:
    """Read the numbers of elements and nodes in a text file of Gmsh, which meshio discards.

    Returns:
        Numbers of the elements by kind in the order of the file, and numbers of the nodes. Empty and None for a binary
        file, in which Gmsh numbers consecutively.
    """
    with open_input_file(path, "a mesh", largest) as file:
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
