"""Read input files of Abaqus and CalculiX.

meshio is not used because it follows ``*INCLUDE`` to any file, assigns element sets of ``*ELEMENT`` lines to another
block, discards the numbers of the elements, and does not support ``*SURFACE``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.files import decode_text_and_find_encoding, read_bytes
from tissue_sim.mesh.formats.checks import FACES, SOLIDS, CellBlock, MeshContent
from tissue_sim.mesh.formats.keyword_blocks import KeywordBlock, iterate_keyword_blocks, require_no_include

#: Description of the expected file for messages.
_EXPECTED = "a mesh of Abaqus or CalculiX"
#: Names of volume element types; the digits are the number of nodes.
_SOLID = re.compile(r"C3D(\d+)")
#: Names of surface element types; the digits are the number of nodes.
_FACE = re.compile(r"(?:S|STRI|CPS|CPE|CAX|M3D|SFM3D|R3D|DS)(\d+)")
#: Number of nodes of a volume element -> name in meshio.
_SOLID_KINDS = {4: "tetra", 10: "tetra10", 8: "hexahedron", 20: "hexahedron20", 27: "hexahedron27", 6: "wedge",
                15: "wedge15", 5: "pyramid"}
#: Digits in the name of a surface element type -> name in meshio.
_FACE_KINDS = {3: "triangle", 6: "triangle6", 65: "triangle6", 4: "quad", 8: "quad8", 9: "quad9"}
#: Name in meshio -> number of nodes.
_NODES = SOLIDS | FACES | {"wedge": 6, "wedge15": 15, "pyramid": 5}
#: Indices of the 27 nodes of Abaqus in the order of VTK; in Abaqus the centre is the first of the last seven nodes.
_ORDER_27 = [*range(20), 26, 24, 23, 25, 21, 22, 20]
#: Name of a face of an element.
_SIDE = re.compile(r"S(\d)")
#: Maximum number of members of a generated set.
_MAX_GENERATED = 10_000_000


def read_inp(path: Path, largest: int) -> MeshContent:
    """Read the mesh of an input file.

    Args:
        path: path of the file.
        largest: maximum size of the file, bytes.

    Raises:
        InputError: the file is invalid; the error states the line.
    """
    text, _ = decode_text_and_find_encoding(read_bytes(path, _EXPECTED, largest), path, _EXPECTED)
    reader = _InpReader()
    for keyword in iterate_keyword_blocks(text, _EXPECTED):
        require_no_include(keyword)
        if keyword.name == "INSTANCE" and keyword.rows:
            raise InputError("*INSTANCE with a translation is not supported; export the assembled mesh",
                             line=keyword.line)
        read = getattr(reader, f"read_{keyword.name.lower()}", None)
        if read is not None:
            read(keyword)
    return reader.build_content()


class _InpReader:
    """Collect nodes, elements, sets and surfaces of a file; a method ``read_NAME`` reads the keyword ``*NAME``."""

    def __init__(self) -> None:
        self._numbers: list[np.ndarray] = []
        self._points: list[np.ndarray] = []
        self._blocks: list[tuple[str, np.ndarray]] = []
        self._node_sets: dict[str, np.ndarray] = {}
        self._element_sets: dict[str, np.ndarray] = {}
        self._surfaces: dict[str, list[tuple[np.ndarray, int]]] = {}

    def read_node(self, keyword: KeywordBlock) -> None:
        """Store the numbers and coordinates of ``*NODE``, and its node set if it names one."""
        try:
            rows = [(int(row[0]), *(float(word or 0.0) for word in (row[1:4] + ["0"] * 3)[:3])) for row in keyword.rows]
        except (ValueError, IndexError, OverflowError):
            raise InputError("a node in *NODE must be its number and its coordinates", line=keyword.line) from None
        table = np.array(rows, dtype=float).reshape(-1, 4)
        self._numbers.append(np.array([row[0] for row in rows], dtype=np.int64))
        self._points.append(table[:, 1:])
        if "NSET" in keyword.options:
            self._extend_set(self._node_sets, keyword.options["NSET"], self._numbers[-1])

    def read_element(self, keyword: KeywordBlock) -> None:
        """Store the elements of ``*ELEMENT``, and its element set if it names one; other types are ignored."""
        name = keyword.options.get("TYPE", "").upper()
        solid, face = _SOLID.match(name), _FACE.match(name)
        kind = (_SOLID_KINDS.get(int(solid[1])) if solid else _FACE_KINDS.get(int(face[1])) if face else None)
        if kind is None:
            if solid:
                raise InputError(f"elements must have the type C3D4, C3D10, C3D8, C3D20 or C3D27; got {name}",
                                 line=keyword.line)
            return  # ignored types such as bars and springs
        data = keyword.parse_integers()
        if data.size % (_NODES[kind] + 1):
            raise InputError(f"an element in *ELEMENT must be its number and {_NODES[kind]} nodes for the type {name}",
                             line=keyword.line)
        table = data.reshape(-1, _NODES[kind] + 1)
        if kind == "hexahedron27":
            table = table[:, [0, *(1 + index for index in _ORDER_27)]]
        self._blocks.append((kind, table))
        if "ELSET" in keyword.options:
            self._extend_set(self._element_sets, keyword.options["ELSET"], table[:, 0])

    def read_nset(self, keyword: KeywordBlock) -> None:
        """Add the nodes of ``*NSET`` to the node set that it names."""
        self._read_set(keyword, self._node_sets, "NSET")

    def read_elset(self, keyword: KeywordBlock) -> None:
        """Add the elements of ``*ELSET`` to the element set that it names."""
        self._read_set(keyword, self._element_sets, "ELSET")

    def read_surface(self, keyword: KeywordBlock) -> None:
        """Store the element faces of ``*SURFACE``, or the nodes of a surface of the type ``NODE`` as a node set."""
        name, kind = keyword.options.get("NAME", ""), keyword.options.get("TYPE", "ELEMENT").upper()
        sides = self._surfaces.setdefault(name.upper(), [])
        for row in keyword.rows if kind == "ELEMENT" else []:
            if len(row) > 1 and (side := _SIDE.fullmatch(row[1].upper())):
                numbers = (np.array([int(row[0])]) if row[0].isdigit() else
                           self._get_defined_set(self._element_sets, row[0], keyword))
                sides.append((numbers, int(side[1]) - 1))
        for row in keyword.rows if kind == "NODE" else []:
            numbers = (np.array([int(row[0])]) if row[0].isdigit()
                       else self._get_defined_set(self._node_sets, row[0], keyword))
            self._extend_set(self._node_sets, name, numbers)

    def _read_set(self, keyword: KeywordBlock, sets: dict[str, np.ndarray], option: str) -> None:
        """Add the numbers, generated numbers and earlier sets of a keyword to the set that its option names."""
        name = keyword.options.get(option, "")
        if "GENERATE" in keyword.options:
            for row in keyword.rows:
                try:
                    first, last, step = map(int, (*[word for word in row if word], "1")[:3])
                except ValueError:
                    raise InputError("a generated set must be first, last and step", line=keyword.line) from None
                if step < 1 or (last - first) // step > _MAX_GENERATED:
                    raise InputError(f"a generated set must have a step of at least 1 and at most {_MAX_GENERATED} "
                                     "members", line=keyword.line)
                self._extend_set(sets, name, np.arange(first, last + 1, step))
            return
        words = [word for row in keyword.rows for word in row if word]
        self._extend_set(sets, name, np.array([int(word) for word in words if word.isdigit()], dtype=np.int64))
        for word in words:
            if not word.isdigit():
                self._extend_set(sets, name, self._get_defined_set(sets, word, keyword))

    @staticmethod
    def _get_defined_set(sets: dict[str, np.ndarray], name: str, keyword: KeywordBlock) -> np.ndarray:
        """Return the numbers in a named set; an `InputError` for a set that is not defined yet."""
        if name.upper() not in sets:
            raise InputError(f"*{keyword.name} names the set {name!r}, which is not defined before this line",
                             line=keyword.line)
        return sets[name.upper()]

    @staticmethod
    def _extend_set(sets: dict[str, np.ndarray], name: str, numbers: np.ndarray) -> None:
        """Append numbers to a set, which is created if it does not exist; names are stored in upper case."""
        sets[name.upper()] = np.concatenate([sets.get(name.upper(), np.zeros(0, dtype=np.int64)), numbers])

    def build_content(self) -> MeshContent:
        """Return the content of the file; nodes and elements are referred to by index from 0 instead of by number."""
        nodes = _NumberToIndexMap(self._numbers, "node")
        points = np.concatenate(self._points) if self._points else np.zeros((0, 3))
        elements = _NumberToIndexMap([table[:, 0] for _, table in self._blocks], "element")
        cells = [CellBlock(kind, nodes.find_indices(table[:, 1:], table[:, 0]), table[:, 0])
                 for kind, table in self._blocks]
        starts = np.cumsum([0, *(len(block.numbers) for block in cells)])

        def split_numbers_into_block_indices(numbers: np.ndarray) -> list[np.ndarray]:
            """Return for each block of `cells` the sorted indices in the block of the elements with these numbers."""
            indices = np.sort(elements.find_known_indices(np.unique(numbers)))
            return [indices[(indices >= first) & (indices < last)] - first
                    for first, last in pairwise(starts.tolist())]

        sides = {name: np.array([(block, index, side) for numbers, side in rows
                                 for block, indices in enumerate(split_numbers_into_block_indices(numbers))
                                 for index in indices.tolist()],
                                dtype=np.intp).reshape(-1, 3) for name, rows in self._surfaces.items() if rows}
        return MeshContent(points, nodes.numbers, cells,
                           {name: nodes.find_known_indices(np.unique(numbers))
                            for name, numbers in self._node_sets.items()},
                           {name: split_numbers_into_block_indices(numbers) for name,
                            numbers in self._element_sets.items()}, sides)


class _NumberToIndexMap:
    """Map from numbers of nodes or elements to their indices in the order of the file.

    Args:
        numbers: numbers in the order of the file, in blocks.
        noun: ``node`` or ``element``, for messages.

    Raises:
        InputError: a number occurs twice.
    """

    def __init__(self, numbers: Sequence[np.ndarray], noun: str):
        self.numbers = np.concatenate([np.zeros(0, dtype=np.int64), *numbers])
        self._order = np.argsort(self.numbers, kind="stable")
        self._sorted, self._noun = self.numbers[self._order], noun
        if (twice := self._sorted[1:][np.diff(self._sorted) == 0]).size:
            raise InputError(f"{noun} {twice[0]} is stated twice; numbers must be unique")

    def _look_up_index(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the index of each number, and whether the number exists; the index is meaningless if it does not."""
        if not self._sorted.size:
            return np.zeros(numbers.shape, dtype=np.intp), np.zeros(numbers.shape, dtype=bool)
        at = np.minimum(np.searchsorted(self._sorted, numbers), self._sorted.size - 1)
        return self._order[at], self._sorted[at] == numbers

    def find_known_indices(self, numbers: np.ndarray) -> np.ndarray:
        """Return the indices of those numbers that exist in the file; other numbers are left out."""
        indices, exists = self._look_up_index(numbers)
        return indices[exists]

    def find_indices(self, numbers: np.ndarray, owners: np.ndarray) -> np.ndarray:
        """Return the index of each number, with the shape of `numbers`.

        Args:
            numbers: numbers of the nodes of elements, shape (m, nodes).
            owners: numbers of these elements, shape (m,), for the message.

        Raises:
            InputError: a number does not exist in the file.
        """
        indices, exists = self._look_up_index(numbers)
        if not exists.all():
            row, column = np.argwhere(~exists)[0]
            raise InputError(f"element {owners[row]} has the {self._noun} {numbers[row, column]}, which is not in the "
                             "file")
        return indices
