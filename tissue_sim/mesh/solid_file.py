"""Read tetrahedral and hexahedral meshes from files of other programs, and convert them.

Elements of any order get their nodes from element corners, hexahedra can be split into tetrahedra, and a mesh is
converted to named arrays for files of this program.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tissue_sim.bounded import run_in_sandbox
from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.files import read_bytes, write_bytes
from tissue_sim.mesh.formats.checks import (
    FACES,
    SIDES,
    SOLIDS,
    CellBlock,
    MeshContent,
    get_volume_cells_of_one_kind,
    require_specimen_size,
    require_valid_mesh,
)
from tissue_sim.mesh.formats.inp import read_inp
from tissue_sim.mesh.formats.through_meshio import read_through_meshio
from tissue_sim.mesh.solid import SolidMesh, create_mesh_with_surface_sets
from tissue_sim.mesh.solid_element import (
    HEX8P0,
    HEX27P1,
    TET8P0,
    TET15P1,
    SolidElement,
    Tetrahedron,
    evaluate_ten_node_functions,
)
from tissue_sim.mesh.tetrahedral import cut_hexahedra_at_lowest_corners


@dataclass(frozen=True)
class SharedNodeSettings:
    """Tolerances by which elements share nodes.

    Attributes:
        same: largest distance between the positions of a shared node in two elements, as a fraction of the element
            size, 1.
        min_weight: smallest weight of a corner on which a node depends, 1.
    """

    same: float = 1e-6
    min_weight: float = 1e-9


_SHARED = SharedNodeSettings()


def number_nodes_by_shared_corners(element: SolidElement, corners: np.ndarray,
                                   positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number the nodes of elements so that elements with the same corners of an edge or face share the nodes there.

    Args:
        element: element type.
        corners: numbers of the corners in the order of `SolidElement.corner_nodes`, shape (elements, corners).
        positions: coordinates of the nodes of each element, m, shape (elements, nodes of the element, 3).

    Returns:
        Coordinates, shape (n, 3), corners first in the order of their numbers; and node numbers, shape (elements, nodes
        of the element).

    Raises:
        InputError: two elements have different positions of the middle of a shared edge or face.
    """
    # A node is identified by the corners on which it depends: two for an edge, those of a face, all for the interior.
    depends = element.corner_functions_at_nodes > _SHARED.min_weight
    keys = np.sort(np.where(depends, corners[:, None], -1), axis=-1).reshape(-1, corners.shape[1])
    _, first, numbers = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    nodes, connectivity = positions.reshape(-1, 3)[first], numbers.reshape(len(corners), -1)
    distance = np.abs(nodes[connectivity] - positions).max(axis=(1, 2))
    mismatched = np.flatnonzero(distance > _SHARED.same * np.ptp(positions, axis=1).max(axis=1))
    if mismatched.size:
        raise InputError(f"element {mismatched[0]} does not fit its neighbour: both have different positions of the "
                         "middle of a shared edge or face. Correct the mesh", field="mesh")
    return nodes, connectivity


def convert_to_element_type(mesh: SolidMesh, element: SolidElement) -> SolidMesh:
    """Return the mesh of the same cells with another element type; elements of order 2 keep curved edges and faces.

    Args:
        mesh: mesh of elements of the same shape.
        element: element type with the same reference coordinates and order of the corners.
    """
    given = mesh.element
    values, _ = given.evaluate_shape_functions_and_gradients(element.reference_nodes)
    positions = np.einsum("ng,egi->eni", values, mesh.nodes[mesh.connectivity])
    corners = mesh.connectivity[:, given.local_corner_indices]
    if element.order == 1:  # straight edges
        positions = np.einsum("nc,eci->eni", element.corner_functions_at_nodes, mesh.nodes[corners])
    return create_mesh_with_surface_sets(element, *number_nodes_by_shared_corners(element, corners, positions))


def split_hexahedra(mesh: SolidMesh, element: Tetrahedron) -> SolidMesh:
    """Return the mesh of tetrahedra, six for each hexahedron of a mesh; quadratic tetrahedra keep curved faces.

    Args:
        mesh: mesh of hexahedra.
        element: element type of the tetrahedra.
    """
    given = mesh.element
    corners, cut = mesh.connectivity[:, given.local_corner_indices], cut_hexahedra_at_lowest_corners(mesh)
    vertices = given.reference_nodes[given.local_corner_indices][cut]
    inside = np.einsum("nc,etci->etni", element.corner_functions_at_nodes, vertices)
    values, _ = given.evaluate_shape_functions_and_gradients(inside.reshape(-1, 3))
    positions = np.einsum("etng,egi->etni", values.reshape(*inside.shape[:-1], -1), mesh.nodes[mesh.connectivity])
    if element.order == 1:  # straight edges
        positions = np.einsum("nc,etci->etni", element.corner_functions_at_nodes,
                              positions[:, :, element.local_corner_indices])
    numbers = np.take_along_axis(corners[:, None], cut, axis=2).reshape(-1, 4)
    nodes, connectivity = number_nodes_by_shared_corners(element, numbers, positions.reshape(-1, element.node_count, 3))
    return create_mesh_with_surface_sets(element, nodes, connectivity)


#: Size of the largest accepted file, bytes.
LARGEST_MESH = 100_000_000
#: Supported file name extensions.
ENDINGS = (".msh", ".vtu", ".vtk", ".inp")
#: Unit of coordinates -> value in m.
MESH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
#: Element of the solver for each shape in a file and each order of the displacements.
_ELEMENTS: dict[str, Mapping[int, SolidElement]] = {"tetra": {1: TET8P0, 2: TET15P1},
                                                    "hexahedron": {1: HEX8P0, 2: HEX27P1}}
#: Reference coordinates of the 27 nodes of a hexahedron in the order of VTK; the first eight are the corners.
_HEXAHEDRON = np.array([
    (-1, -1, -1), (1, -1, -1), (1, 1, -1), (-1, 1, -1), (-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1),
    (0, -1, -1), (1, 0, -1), (0, 1, -1), (-1, 0, -1), (0, -1, 1), (1, 0, 1), (0, 1, 1), (-1, 0, 1),
    (-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0),
    (-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), (0, 0, -1), (0, 0, 1), (0, 0, 0)], dtype=float)
#: Indices of the corners in VTK order for each corner in the order of `SolidElement.corner_nodes`.
_CORNERS = {"tetra": [0, 1, 2, 3], "hexahedron": [0, 1, 3, 2, 4, 5, 7, 6]}
#: Smallest cosine between the normal of an upward face and the vertical.
_UPWARDS = 0.5


@dataclass(frozen=True, eq=False)
class FileMesh:
    """Valid mesh from a file, in m.

    Attributes:
        cells: elements of the volume.
        points: coordinates, m, shape (n, 3).
        sides: faces of the surface as indices of their corners in `points`, shape (m, corners of a face).
        named_sides: named sets of faces as sorted indices in `sides`.
        regions: named sets of elements as sorted indices in `cells`.
        digest: SHA-256 of the file.
    """

    cells: CellBlock
    points: np.ndarray
    sides: np.ndarray
    named_sides: dict[str, np.ndarray]
    regions: dict[str, np.ndarray]
    digest: str = ""


def read_file_mesh(path: str | Path, unit: str = "mm") -> FileMesh:
    """Read a mesh file of Gmsh (.msh), VTK (.vtu, .vtk), Abaqus or CalculiX (.inp).

    Args:
        path: path of the file.
        unit: unit of the coordinates, one of `MESH_UNITS`.

    Raises:
        InputError: the file cannot be read, or the mesh is invalid; the error states the number of an element or node
            in the file.
    """
    path = Path(path)
    if unit not in MESH_UNITS:
        raise InputError(f"unknown unit {unit!r}{make_hint_with_similar_or_known_words(unit, MESH_UNITS)}",
                         field="mesh_unit")
    if path.suffix.lower() not in ENDINGS:
        raise InputError(f"has the ending {path.suffix!r}, expected a mesh with one of {', '.join(ENDINGS)}", file=path)
    data = read_bytes(path, "a mesh", LARGEST_MESH)
    # Readers open the file by name, some of them twice: a copy cannot change in the meantime.
    with TemporaryDirectory(prefix="tissue_sim_") as folder:
        copy = Path(folder) / path.name
        write_bytes(copy, data)
        try:
            mesh: FileMesh = run_in_sandbox(_read_and_check_file_mesh, copy, unit, file=copy)
        except InputError as error:
            raise InputError(error.problem.replace(str(copy), path.name), file=path, line=error.line,
                             field=error.field) from None
    return replace(mesh, digest=hashlib.sha256(data).hexdigest())


def _read_and_check_file_mesh(path: Path, unit: str) -> FileMesh:
    """Read and check a mesh file inside the sandbox, and return its mesh in m, without the digest."""
    reader = read_inp if path.suffix.lower() == ".inp" else read_through_meshio
    content = reader(path, LARGEST_MESH)
    cells = get_volume_cells_of_one_kind(content)
    points = content.points * MESH_UNITS[unit]
    # Nodes that belong only to lines and surfaces are also not part of the volume.
    require_specimen_size(points, unit)
    require_valid_mesh(cells, points, content.point_numbers)
    return _make_file_mesh_with_named_sets(content, cells, points)


def _make_file_mesh_with_named_sets(content: MeshContent, cells: CellBlock, points: np.ndarray) -> FileMesh:
    """Make the `FileMesh` of checked elements, with named surface faces and regions from the sets of the file."""
    sides = np.array(SIDES[cells.cell_shape])
    all_faces = cells.corner_nodes[:, sides].reshape(-1, sides.shape[1])
    keys = _compute_face_keys_from_corners(all_faces, len(points))
    _, inverse, times = np.unique(keys, return_inverse=True, return_counts=True)
    outer = times[inverse] == 1
    surface, outer_keys = all_faces[outer], keys[outer]
    order = np.argsort(outer_keys)
    # Index of the first element of each block in `cells`, and index of each face in the surface (-1 inside).
    starts, start = {}, 0
    for number, block in enumerate(content.cells):
        if block.kind == cells.kind:
            starts[number] = start
            start += len(block.nodes)
    surface_index = np.full(len(all_faces), -1)
    surface_index[np.flatnonzero(outer)] = np.arange(len(surface))
    found: dict[str, list[np.ndarray]] = {}
    regions: dict[str, np.ndarray] = {}
    for name, blocks in content.cell_sets.items():
        members = [starts[number] + chosen for number, chosen in enumerate(blocks) if number in starts]
        regions[name] = np.unique(np.concatenate([np.zeros(0, dtype=np.intp), *members])).astype(np.intp)
        for block, chosen in zip(content.cells, blocks, strict=True):
            if block.kind in FACES and len(chosen) and block.corner_nodes.shape[1] == sides.shape[1]:
                face_keys = _compute_face_keys_from_corners(block.corner_nodes[chosen], len(points))
                at = np.minimum(np.searchsorted(outer_keys, face_keys, sorter=order), len(order) - 1)
                found.setdefault(name, []).append(order[at[outer_keys[order[at]] == face_keys]])
    for name, rows in content.side_sets.items():
        rows = rows[[block in starts for block in rows[:, 0].tolist()]] if len(rows) else rows
        at = np.array([len(sides) * (starts[block] + element) + side for block, element, side in rows.tolist()
                       if side < len(sides)], dtype=np.intp)
        found.setdefault(name, []).append(surface_index[at][surface_index[at] >= 0])
    for name, chosen in content.point_sets.items():
        member = np.zeros(len(points), dtype=bool)
        member[chosen] = True
        found.setdefault(name, []).append(np.flatnonzero(member[surface].all(axis=1)))
    named = {name: np.unique(np.concatenate(members)) for name, members in found.items()}
    return FileMesh(cells, points, surface, {name: members for name, members in named.items() if members.size},
                    _keep_disjoint_sets(regions, len(cells.nodes)))


def _compute_face_keys_from_corners(sides: np.ndarray, points: int) -> np.ndarray:
    """Return an identifying integer for each face, computed from three of its corners, shape (m,).

    Two faces of a valid mesh have the same integer only if they are the same face.
    """
    low = np.sort(sides, axis=1)[:, :3].astype(np.int64)
    return (low[:, 0] * points + low[:, 1]) * points + low[:, 2]


def _keep_disjoint_sets(regions: dict[str, np.ndarray], count: int) -> dict[str, np.ndarray]:
    """Return the named sets of elements that do not overlap with others, without sets of all elements."""
    parts = {name: members for name, members in regions.items() if name and 0 < members.size < count}
    times = np.bincount(np.concatenate([np.zeros(0, dtype=np.intp), *parts.values()]), minlength=count)
    return {name: members for name, members in parts.items() if (times[members] == 1).all()}


def convert_file_mesh(mesh: FileMesh, order: int = 2, *, base: str | None = None, top: str | None = None) -> SolidMesh:
    """Convert the mesh of a file to elements of the solver and name its base and top.

    The mesh is translated so that the centre of the bounding box of the top is at x = y = 0 and its highest node at
    z = 0.

    Args:
        mesh: mesh of a file.
        order: order of the displacements: 1 (`TET8P0`, `HEX8P0`) or 2 (`TET15P1`, `HEX27P1`).
        base: name in the file of the fixed faces; None: the faces in the lowest plane.
        top: name in the file of the faces that the tool may touch; None: the faces in the highest plane, or all upward
            faces if the highest plane contains no face.

    Raises:
        InputError: the name does not exist, no face lies in the lowest plane, or a curved element is inverted.
    """
    cells, points = mesh.cells, mesh.points
    element = _ELEMENTS[cells.cell_shape][order]
    corners = cells.corner_nodes[:, _CORNERS[cells.cell_shape]]
    values = _evaluate_file_element_functions(cells.kind if order == 2 else cells.cell_shape, element.reference_nodes)
    given = cells.nodes if order == 2 else cells.corner_nodes
    nodes, connectivity = number_nodes_by_shared_corners(element, corners,
                                                         np.einsum("ng,egi->eni", values, points[given]))
    _require_positive_element_volumes(element, nodes, connectivity, cells)
    # Corners are first, in the order of the file.
    number = np.full(len(points), -1)
    number[np.unique(corners)] = np.arange(np.unique(corners).size)
    held, met = find_base_and_top(mesh, base, top)
    chosen = {"base": mesh.sides[held], "top": mesh.sides[met], "side": np.delete(mesh.sides, np.union1d(held, met), 0)}
    nodes = nodes - find_top_box_centre_and_height(mesh, met)
    all_faces = connectivity[:, element.local_face_node_indices].reshape(-1, element.local_face_node_indices.shape[1])
    keys = _compute_face_keys_from_corners(all_faces[:, element.corner_indices_within_face], len(points))
    sorter = np.argsort(keys)
    faces = {name: all_faces[
        sorter[np.searchsorted(keys, _compute_face_keys_from_corners(number[sides], len(points)), sorter=sorter)]]
             for name, sides in chosen.items()}
    return SolidMesh(element, nodes, connectivity, {name: np.unique(each) for name, each in faces.items()}, faces,
                     dict(mesh.regions))


def find_top_box_centre_and_height(mesh: FileMesh, met: np.ndarray) -> np.ndarray:
    """Return the centre (x, y) of the bounding box of the top and the height of its highest node, m, shape (3,)."""
    high = mesh.points[np.unique(mesh.sides[met])]
    return np.array([*(0.5 * (high.min(axis=0) + high.max(axis=0)))[:2], high[:, 2].max()])


def _evaluate_file_element_functions(kind: str, positions: np.ndarray) -> np.ndarray:
    """Return the shape functions of an element type of a file at reference positions of the solver's element.

    Args:
        kind: element type of the file.
        positions: reference coordinates, shape (q, 3).

    Returns:
        Values, shape (q, nodes of the element type).
    """
    if kind == "tetra":
        return TET15P1.evaluate_corner_functions(positions)
    if kind == "tetra10":
        return evaluate_ten_node_functions(positions)
    powers = [(i, j, k) for k in range(3) for j in range(3) for i in range(3)]
    count = {"hexahedron": 8, "hexahedron20": 20, "hexahedron27": 27}[kind]
    # At most one factor is squared in the serendipity element, none in the trilinear element.
    most = {8: 0, 20: 1, 27: 3}[count]
    powers = [each for each in powers if each.count(2) <= most]

    def evaluate_monomials(points: np.ndarray) -> np.ndarray:
        """Return the monomials with the exponents `powers` at points, shape (q, monomials)."""
        return np.stack([(points ** np.array(each)).prod(axis=1) for each in powers], axis=-1)

    return evaluate_monomials(positions) @ np.linalg.inv(evaluate_monomials(_HEXAHEDRON[:count]))


def _require_positive_element_volumes(element: SolidElement, nodes: np.ndarray, connectivity: np.ndarray,
                                      cells: CellBlock) -> None:
    """Require a positive Jacobian determinant at every quadrature point of every element."""
    _, slopes = element.evaluate_shape_functions_and_gradients(element.quadrature[0])
    volumes = np.linalg.det(np.einsum("eai,qaj->eqij", nodes[connectivity], slopes)).min(axis=1)
    if not (volumes > 0.0).all():
        raise InputError(f"element {cells.numbers[np.argmin(volumes)]} is turned inside out by its mid-edge nodes; "
                         "correct the mesh", field="mesh_file")


def find_base_and_top(mesh: FileMesh, base: str | None, top: str | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the indices of the fixed faces and of the faces that the tool may touch; see `convert_file_mesh`."""
    heights = mesh.points[mesh.sides, 2]
    low, high = heights.min(), heights.max()
    slack = 1e-6 * (high - low)
    held = _find_named_faces(mesh, base, "mesh_base") if base is not None else np.flatnonzero(
        (heights <= low + slack).all(axis=1))
    if not held.size:
        raise InputError("no side of the mesh lies in its lowest plane; name the fixed sides (mesh_base, --mesh-base)"
                         f"{_format_known_face_names(mesh)}", field="mesh_base")
    if top is not None:
        met = _find_named_faces(mesh, top, "mesh_top")
    else:
        met = np.flatnonzero((heights >= high - slack).all(axis=1))
        if not met.size:
            corners = mesh.points[mesh.sides]
            normals = np.cross(corners, np.roll(corners, -1, axis=1)).sum(axis=1)
            met = np.flatnonzero(normals[:, 2] > _UPWARDS * np.linalg.norm(normals, axis=1))
    met = np.setdiff1d(met, held)
    if not met.size:
        raise InputError("no side of the mesh remains for contact with a tool; name the sides of the top (mesh_top, "
                         f"--mesh-top){_format_known_face_names(mesh)}", field="mesh_top")
    return held, met


def _find_named_faces(mesh: FileMesh, name: str, field: str) -> np.ndarray:
    """Return the indices in `FileMesh.sides` of the faces with a name, in any case; an `InputError` if unknown."""
    known = {each.upper(): members for each, members in mesh.named_sides.items()}
    if name.upper() not in known:
        hint = make_hint_with_similar_or_known_words(name, mesh.named_sides) if mesh.named_sides \
            else "; the file names none"
        raise InputError(f"no sides on the surface of the mesh are named {name!r}{hint}", field=field)
    return known[name.upper()]


def _format_known_face_names(mesh: FileMesh) -> str:
    """Return the end of a message: the names of faces in the file."""
    return f"; the file names {', '.join(sorted(mesh.named_sides))}" if mesh.named_sides else "; the file names none"


def read_solid_mesh(path: str | Path, unit: str = "mm", order: int = 2, *, base: str | None = None,
                    top: str | None = None) -> SolidMesh:
    """Read the mesh of a file and convert it to solver elements; see `read_file_mesh` and `convert_file_mesh`."""
    mesh = read_file_mesh(path, unit)
    try:
        return convert_file_mesh(mesh, order, base=base, top=top)
    except InputError as error:
        raise error.with_location(file=path) from None


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
