"""Runner of tests in CalculiX: input deck with the exported material card, and reaction forces of the base.

Source of keywords and of the numbering of elements: CalculiX CrunchiX User's Manual, version 2.20.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from calibration.targets.runner import Progress, TargetCurve, TargetRunner, TargetTest
from tissue_sim.errors import InputError
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.exports import ExportContent, find_export_target
from tissue_sim.exports.elastic_constants import ElasticConstants
from tissue_sim.files import read_text
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh


class CalculixElement(NamedTuple):
    """Element of CalculiX for an element of a mesh.

    Attributes:
        name: name in CalculiX.
        nodes: indices of its nodes among those of the element of the mesh, in the order of CalculiX.
    """

    name: str
    nodes: tuple[int, ...]


#: Element of a mesh -> element of CalculiX. Incompatible modes replace C3D8, whose force is 1.6 times (K/mu = 100) to
#: 24 times (K/mu = 1e4) too large under a punch; CalculiX has no linear tetrahedron without volumetric locking.
ELEMENTS = {
    "H8/P0": CalculixElement("C3D8I", (0, 1, 3, 2, 4, 5, 7, 6)),
    "H27/P-1": CalculixElement("C3D20R", (0, 2, 8, 6, 18, 20, 26, 24, 1, 5, 7, 3, 19, 23, 25, 21, 9, 11, 17, 15)),
    "T8/P0": CalculixElement("C3D4", (0, 1, 2, 3)),
    "T15/P-1": CalculixElement("C3D10", tuple(range(10))),
}
#: Number of nodes of an element of CalculiX -> indices of the corners of each face, in the order S1, S2, ...
_FACES = {
    4: ((0, 1, 2), (0, 3, 1), (1, 3, 2), (2, 3, 0)),
    8: ((0, 1, 2, 3), (4, 7, 6, 5), (0, 4, 5, 1), (1, 5, 6, 2), (2, 6, 7, 3), (3, 7, 4, 0)),
}
_FACES |= {10: _FACES[4], 20: _FACES[8]}
#: Interval between two readings of the output, s.
_POLL_SECONDS = 0.1
#: Number of lines of the log in a message.
_LOG_LINES = 3
#: Number of node numbers on a line; the manual allows 16 values.
_PER_LINE = 16
#: Remedy of a missing program.
_MISSING = ("CalculiX is not installed: the program ccx is not on PATH. Install it, on Debian and Ubuntu with "
            "apt install calculix-ccx.")


@dataclass(frozen=True)
class CalculixSettings:
    """Settings of the nonlinear solution and of the contact.

    Attributes:
        first_increment: first increment of a position, as a fraction of the motion to it, 1.
        max_increments: largest number of increments of a position.
        residual: largest residual force over the average force at convergence, 1; the default of CalculiX is 5e-3.
        stiffness: pressure per penetration, in initial shear moduli over the radius of the tool, 1. A larger value
            decreases the penetration and needs more increments.
        stick: shear stress per slip of sticking surfaces, over `stiffness`, 1.
        sectors: number of sectors of the tool, a body of revolution.
        longest_edge: longest edge along the outline of the tool, in radii of the tool, 1.
        thickness: thickness of the layer of elements that represents the tool, in radii of the tool, 1.
        plate_margin: radius of a plate over that of the specimen, 1.
    """

    first_increment: float = 0.1
    max_increments: int = 1000
    residual: float = 1e-4
    stiffness: float = 2e3
    stick: float = 0.1
    sectors: int = 36
    longest_edge: float = 0.25
    thickness: float = 0.05
    plate_margin: float = 1.5


class CalculixRunner(TargetRunner):
    """CalculiX CrunchiX, static, with penalty contact between faces.

    Elements are those of `ELEMENTS` at the nodes of the mesh. Each position is a step. The force on the tool is the
    reaction of the base, which equals it because the test has no gravity. In contact, the top of the mesh (under a
    plate also its side) touches a layer of elements on the outline of the tool, whose nodes are prescribed.
    `TargetCurve.step_seconds` is the mean over the positions.

    Args:
        settings: settings of the solution.
    """

    title = "CalculiX, static"
    uses_elastic_constants = False
    is_static = True

    def __init__(self, settings: CalculixSettings | None = None):
        self.settings = settings or CalculixSettings()

    def describe_missing_program(self) -> str:
        """Return why CalculiX cannot run, with the remedy; an empty text if it can."""
        return "" if shutil.which("ccx") else _MISSING

    def run(self, test: TargetTest, material: Material | ElasticConstants, progress: Progress | None = None
            ) -> TargetCurve:
        """Simulate a test; see `TargetRunner.run`. A position may take `TargetTest.max_seconds`."""
        program = shutil.which("ccx")
        if program is None:
            raise InputError(_MISSING)
        if isinstance(material, ElasticConstants):
            raise InputError("must be a Material; got ElasticConstants. CalculiX reads the calibrated law.",
                             field="material")
        deck = write_deck(test, material, self.settings)
        with TemporaryDirectory(prefix="tissue_sim_") as name:
            folder = Path(name)
            (folder / "test.inp").write_text(deck, encoding="utf-8")
            return _run_deck(program, folder, test, progress)


RUNNER = CalculixRunner()


def write_deck(test: TargetTest, material: Material, settings: CalculixSettings) -> str:
    """Return the input deck of a test, SI.

    Raises:
        InputError: CalculiX has no equivalent of the mesh or of a part of the material.
    """
    if test.mesh.element.name not in ELEMENTS:
        raise InputError(f"must be one of {', '.join(ELEMENTS)}; got {test.mesh.element.name}. Use a mesh of these "
                         "elements.", field="mesh.element")
    content = ExportContent((material,))
    moved = "FACE" if test.is_bonded else "TOOL"
    lines = [*_list_tissue_lines(test.mesh), find_export_target("calculix").write(content).rstrip(),
             f"*SOLID SECTION, ELSET=TISSUE, MATERIAL={content.labels[0]}"]
    if not test.is_bonded:
        lines += _list_contact_lines(test, material.mu0, settings)
    lines += ["*BOUNDARY", "BASE, 1, 3"] + ["SYMMETRY, 2, 2"] * ("symmetry" in test.mesh.sets)
    for motion in np.asarray(test.positions, dtype=float)[1:] - test.positions[0]:
        lines += [f"*STEP, NLGEOM, INC={settings.max_increments}", "*CONTROLS, PARAMETERS=FIELD",
                  f"{settings.residual:g}", "*STATIC", f"{settings.first_increment:g}, 1.", "*BOUNDARY",
                  *(f"{moved}, {axis}, {axis}, {part:.12g}" for axis, part in enumerate(motion, start=1)),
                  "*NODE PRINT, NSET=BASE, TOTALS=ONLY", "RF", "*END STEP"]
    return "\n".join(lines) + "\n"


def _list_tissue_lines(mesh: SolidMesh) -> list[str]:
    """Return the nodes, elements and node sets ``BASE``, ``FACE`` and ``SYMMETRY`` of a mesh."""
    element = ELEMENTS[mesh.element.name]
    elements = mesh.connectivity[:, element.nodes]
    used = np.unique(elements)
    lines = ["*NODE", *_list_node_lines(used + 1, mesh.nodes[used]),
             *_list_element_lines(element.name, "TISSUE", 1, elements + 1)]
    for name in ("base", "face", "symmetry"):
        if name in mesh.sets:
            lines += [f"*NSET, NSET={name.upper()}",
                      *_list_number_lines(np.intersect1d(mesh.sets[name], used) + 1)]
    return lines


def _list_contact_lines(test: TargetTest, modulus: float, settings: CalculixSettings) -> list[str]:
    """Return the elements of the tool, the surfaces and the interaction between them.

    Args:
        test: test.
        modulus: initial shear modulus, Pa.
        settings: settings of the contact.
    """
    mesh, tool = test.mesh, test.tool
    first_node, first_element = len(mesh.nodes) + 1, len(mesh.connectivity) + 1
    width = float(np.hypot(*mesh.nodes[:, :2].T).max())
    radius = tool.radius or width
    reach = float(np.hypot(*np.asarray(test.positions)[:, :2].T).max())
    depth = float(-np.min(np.asarray(test.positions)[:, 2]))
    outline = _sample_outline(tool, depth + radius, settings.plate_margin * width + reach, settings, radius)
    nodes, wedges, bricks = _revolve(outline, settings, radius)
    nodes = nodes + test.positions[0]
    stiffness = settings.stiffness * modulus / radius
    lines = ["*NODE, NSET=TOOL", *_list_node_lines(np.arange(first_node, first_node + len(nodes)), nodes),
             *_list_element_lines("C3D6", "TOOL", first_element, wedges + first_node),
             *_list_element_lines("C3D8", "TOOL", first_element + len(wedges), bricks + first_node),
             "*MATERIAL, NAME=TOOL", "*ELASTIC", f"{modulus:g}, 0.3",
             "*SOLID SECTION, ELSET=TOOL, MATERIAL=TOOL",
             "*SURFACE, NAME=TOUCHING, TYPE=ELEMENT", *_list_surface_lines(mesh, tool.is_plate),
             "*SURFACE, NAME=OUTLINE, TYPE=ELEMENT", "TOOL, S1",
             "*SURFACE INTERACTION, NAME=CONTACT", "*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR",
             f"{stiffness:g}"]
    if test.friction:
        lines += ["*FRICTION", f"{test.friction:g}, {settings.stick * stiffness:g}"]
    return [*lines, "*CONTACT PAIR, INTERACTION=CONTACT, TYPE=SURFACE TO SURFACE", "TOUCHING, OUTLINE"]


def _list_surface_lines(mesh: SolidMesh, has_side: bool) -> list[str]:
    """Return the element faces on the top of a mesh, and on its side if `has_side`."""
    element = ELEMENTS[mesh.element.name]
    outer = np.concatenate([mesh.faces[name] for name in ("top", "side")[:1 + has_side]])
    wanted = {tuple(row) for row in np.sort(outer[:, mesh.element.corner_indices_within_face]).tolist()}
    lines = []
    for side, corners in enumerate(_FACES[len(element.nodes)], start=1):
        rows = np.sort(mesh.connectivity[:, np.take(element.nodes, corners)]).tolist()
        lines += [f"{number}, S{side}" for number, row in enumerate(rows, start=1) if tuple(row) in wanted]
    return lines


def _sample_outline(tool: Tool, height: float, width: float, settings: CalculixSettings, radius: float) -> np.ndarray:
    """Return points (r, z) on the outline of a tool from its axis, up to a height and a radius, m, shape (n, 2)."""
    points = tool.profile.sample_outline_up_to_height(height)
    points[:, 0] = np.minimum(points[:, 0], width)
    points = points[:1 + int(np.argmax(points[:, 1] >= height))] if (points[:, 1] >= height).any() else points
    distinct = np.linalg.norm(np.diff(points, axis=0), axis=1) > 1e-6 * radius
    points = points[np.concatenate([[True], distinct])]
    points[points[:, 0] < 1e-6 * radius, 0] = 0.0
    while points[-1, 0] == 0.0:  # a ball is closed above; its top does not touch the tissue
        points = points[:-1]
    parts = [points[:1]]
    for start, end in pairwise(points):
        count = int(np.ceil(np.linalg.norm(end - start) / (settings.longest_edge * radius)))
        parts.append(start + np.linspace(0.0, 1.0, count + 1)[1:, None] * (end - start))
    return np.concatenate(parts)


def _revolve(outline: np.ndarray, settings: CalculixSettings, radius: float
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Revolve an outline to a layer of elements, whose faces S1 are the outline.

    Args:
        outline: points (r, z), the first on the axis, m, shape (n, 2).
        settings: number of sectors, and thickness of the layer.
        radius: radius of the tool, m.

    Returns:
        Nodes, m, shape (nodes, 3); wedges at the axis and hexahedra, as indices of nodes, shapes (m, 6) and (k, 8).
    """
    segments = np.diff(outline, axis=0)
    normals = np.stack([-segments[:, 1], segments[:, 0]], axis=-1)  # into the tool
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    normals = np.concatenate([[[0.0, 1.0]], normals[1:] + normals[:-1], normals[-1:]])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    # Thinner than the edges of a rounding, so that no element is turned inside out.
    thickness = min(settings.thickness * radius, 0.5 * float(np.linalg.norm(segments, axis=1).min()))
    count = settings.sectors
    layers = [np.concatenate([[[0.0, 0.0, points[0, 1]]], _rotate(points[1:], count)])
              for points in (outline, outline + thickness * normals)]
    ring = 1 + np.arange((len(outline) - 1) * count).reshape(-1, count)
    following = np.roll(ring, -1, axis=1)
    # Seen from inside the tool, the corners of the outer face are counter-clockwise.
    triangles = np.stack([np.zeros(count, dtype=int), ring[0], following[0]], axis=-1)
    squares = np.stack([ring[:-1], ring[1:], following[1:], following[:-1]], axis=-1).reshape(-1, 4)
    inner = len(layers[0])
    return (np.concatenate(layers), np.concatenate([triangles, triangles + inner], axis=1),
            np.concatenate([squares, squares + inner], axis=1))


def _rotate(points: np.ndarray, count: int) -> np.ndarray:
    """Return `count` copies of points (r, z) around the axis, on polygons with the area of the circle, shape (n, 3)."""
    angle = 2.0 * np.pi / count
    angles, radii = angle * np.arange(count), np.sqrt(angle / np.sin(angle)) * points[:, :1]
    heights = np.repeat(points[:, 1:], count, axis=1)
    return np.stack([radii * np.cos(angles), radii * np.sin(angles), heights], axis=-1).reshape(-1, 3)


def _list_node_lines(numbers: Iterable[int], nodes: np.ndarray) -> list[str]:
    return [f"{number}, " + ", ".join(f"{x:.12g}" for x in node) for number, node in zip(numbers, nodes, strict=True)]


def _list_element_lines(name: str, elset: str, first: int, elements: np.ndarray) -> list[str]:
    """Return the lines of elements of one type; node numbers begin with 1."""
    lines = [f"*ELEMENT, TYPE={name}, ELSET={elset}"]
    for number, nodes in enumerate(elements.tolist(), start=first):
        lines += _list_number_lines([number, *nodes], continues=True)
    return lines


def _list_number_lines(numbers: Sequence[int] | np.ndarray, continues: bool = False) -> list[str]:
    """Return numbers on lines of the largest length; `continues`: a comma ends each line but the last."""
    lines = [", ".join(map(str, numbers[i:i + _PER_LINE])) for i in range(0, len(numbers), _PER_LINE)]
    return [line + ("," if continues else "") for line in lines[:-1]] + lines[-1:]


def _run_deck(program: str, folder: Path, test: TargetTest, progress: Progress | None) -> TargetCurve:
    """Run ``test.inp`` of a folder, and return the curve of the positions that end before the time limit."""
    count = len(test.positions)
    report = progress or (lambda finished, total: None)
    before, began, finished, is_late = os.times(), time.monotonic(), 0, False
    with (folder / "test.log").open("w", encoding="utf-8") as log:
        process = subprocess.Popen([program, "test"], cwd=folder, stdin=subprocess.DEVNULL, stdout=log,
                                   stderr=subprocess.STDOUT)
        try:
            while process.poll() is None and not is_late:
                try:
                    process.wait(_POLL_SECONDS)
                except subprocess.TimeoutExpired:
                    done = len(_read_forces(folder))
                    if done > finished:
                        finished, began = done, time.monotonic()
                        report(1 + finished, count)
                    is_late = time.monotonic() - began > test.max_seconds
        finally:
            process.kill()
            process.wait()
    after = os.times()
    forces = _read_forces(folder)
    reached = 1 + len(forces)
    report(reached, count)
    used = after.children_user + after.children_system - before.children_user - before.children_system
    return TargetCurve(np.asarray(test.positions, dtype=float)[:reached], np.vstack([np.zeros(3), *forces]),
                       ended=_explain_end(folder, test, reached, is_late),
                       step_seconds=used / max(len(forces), 1), steps=np.zeros(reached, dtype=int),
                       version=_read_version(folder))


def _read_forces(folder: Path) -> list[np.ndarray]:
    """Return the reactions of the base at the end of each step, N, shape (3,)."""
    path = folder / "test.dat"
    if not path.is_file() or not path.stat().st_size:
        return []
    forces: list[np.ndarray] = []
    for when, numbers in re.findall(r"total force.*?time\s+(\S+)\n\s*\n((?:[ \t]+\S+){3})\n",
                                    read_text(path, "an output of CalculiX", is_growing=True)):
        # The time of a step is 1; its increments print their forces, too.
        if abs(float(when) - len(forces) - 1) < 1e-6:
            forces.append(np.array([float(number) for number in numbers.split()]))
    return forces


def _explain_end(folder: Path, test: TargetTest, reached: int, is_late: bool) -> str:
    """Return why the program stopped before the last position, as a sentence; empty if it did not."""
    count = len(test.positions)
    if reached == count:
        return ""
    place = f"position {reached + 1} of {count} (depth {-1e3 * test.positions[reached][2]:.4g} mm)"
    if is_late:
        return f"CalculiX needed more than {test.max_seconds:g} s for {place}."
    path = folder / "test.log"
    log = read_text(path, "a log of CalculiX").split("\n") if path.stat().st_size else []
    last = "; ".join([line.strip() for line in log if line.strip()][-_LOG_LINES:])
    return f"CalculiX did not converge at {place}. Its log ends with: {last}."


def _read_version(folder: Path) -> str:
    """Return name and version from the log."""
    found = re.search(r"Version\s+([\w.]+)", read_text(folder / "test.log", "a log of CalculiX"))
    return f"CalculiX {found[1].removesuffix(',').rstrip('.')}" if found else "CalculiX"
