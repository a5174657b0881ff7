"""A body of any shape, from a file of its mesh."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from tissue_sim.errors import InputError
from tissue_sim.specimen.specimen import Specimen

if TYPE_CHECKING:
    from tissue_sim.mesh.grading import Grading
    from tissue_sim.mesh.solid import SolidMesh
    from tissue_sim.mesh.solid_file import FileMesh
    from tissue_sim.mesh.vertical_projection import VerticalProjection

#: Corners of elements that a tool has under it, at least.
_FEWEST = 4


@dataclass(frozen=True)
class MeshSpecimen(Specimen):
    """A body whose mesh of tetrahedra or hexahedra another program has made; z points upwards in its file. The middle
    of the box about its top is the origin.

    Attributes:
        mesh_file: .msh of Gmsh, .vtu or .vtk, or .inp of Abaqus or CalculiX.
        mesh_unit: of its coordinates: ``"mm"``, ``"m"``, ``"cm"``, ``"um"``, ``"in"``.
        mesh_base: name in the file of the sides that are held; None: those in the lowest plane.
        mesh_top: of those that the tool may meet; None: those in the highest plane, or all that look up.
        content: the mesh of the file where that is not to be read any more, and `mesh_file` is its name alone.

    Raises:
        InputError: what `tissue_sim.mesh.solid_file.read_file_mesh` refuses; a name that the file does not have.
    """

    shape = "mesh"
    is_prism = False
    from_file = True
    texts = MappingProxyType({"mesh": "mesh_file", "mesh_unit": "mesh_unit", "mesh_base": "mesh_base",
                              "mesh_top": "mesh_top"})
    paths = ("mesh",)
    mesh_file: str | Path
    mesh_unit: str = "mm"
    mesh_base: str | None = None
    mesh_top: str | None = None
    content: FileMesh | None = field(default=None, repr=False, compare=False)

    def __post_init__(self):
        super().__post_init__()
        if self.content is not None and str(self.mesh_file) != Path(self.mesh_file).name:
            raise InputError("the mesh is given, and so is a file to read; leave one of them out",
                             field="specimen.content")
        # Of most shapes a property of the class.
        object.__setattr__(self, "is_flat", self._seen.is_flat)

    def __eq__(self, other: object) -> bool:
        """Whether what is in the files is the same, whatever they are called."""
        return isinstance(other, MeshSpecimen) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)

    @property
    def _key(self) -> tuple:
        return (self.digest, self.mesh_unit, self.mesh_base, self.mesh_top, self.name, self.density, self.gravity,
                self.height_is)

    @cached_property
    def _mesh(self) -> FileMesh:
        if self.content is not None:
            return self.content
        path = Path(self.mesh_file)
        try:
            found = path.stat()
            return _read(path.resolve(), self.mesh_unit, found.st_mtime_ns, found.st_size)
        except (OSError, ValueError):
            return _read(path, self.mesh_unit, 0, 0)  # which says what is the matter

    @property
    def mesh_of_file(self) -> FileMesh:
        """As it was read."""
        return self._mesh

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the bytes that its mesh was read from."""
        return self._mesh.digest

    @cached_property
    def _seen(self) -> VerticalProjection:
        from tissue_sim.mesh.solid_file import base_and_top, origin
        from tissue_sim.mesh.vertical_projection import VerticalProjection

        mesh = self._mesh
        try:
            held, met = base_and_top(mesh, self.mesh_base, self.mesh_top)
        except InputError as error:
            raise error.located(file=self.mesh_file) from None
        return VerticalProjection(mesh.points - origin(mesh, met), mesh.sides[met], mesh.sides[held], mesh.sides)

    @property
    def height(self) -> float:
        """From the lowest to the highest node, m."""
        heights = self._mesh.points[:, 2]
        return float(heights.max() - heights.min())

    @property
    def region_names(self) -> tuple[str, ...]:
        return tuple(self._mesh.regions)

    @property
    def in_words(self) -> str:
        x, y, z = (1e3 * (self._mesh.points.max(axis=0) - self._mesh.points.min(axis=0))).tolist()
        return f"{Path(self.mesh_file).name} of {x:.4g} x {y:.4g} x {z:.4g} mm"

    def margin(self, x: float = 0.0, y: float = 0.0) -> float:
        return self._seen.margin(x, y)

    @property
    def outer_radius(self) -> float:
        return self._seen.outer_radius

    def depth_at(self, x: float = 0.0, y: float = 0.0) -> float:
        return self._seen.depth_at(x, y)

    def solid_mesh(self, grading: Grading) -> SolidMesh:
        """The file's own elements, raised to the order of those that the grading asks for; their sizes are the file's.

        Raises:
            InputError: layers, or a tool with hardly a node under it.
        """
        from tissue_sim.mesh.solid import with_tool_sets
        from tissue_sim.mesh.solid_file import solid_from_file

        if grading.interfaces:
            raise InputError("a mesh of a file has regions of its own and takes no layers; leave them out",
                             field="material.layers")
        try:
            mesh = solid_from_file(self._mesh, grading.element.order, base=self.mesh_base, top=self.mesh_top)
        except InputError as error:
            raise error.located(file=self.mesh_file) from None
        if grading.radius is None:
            return mesh
        mesh = with_tool_sets(mesh, grading.radius, grading.centre)
        if mesh.sets["face"].size < _FEWEST:
            raise InputError(f"only {mesh.sets['face'].size} nodes of the top lie within {grading.radius * 1e3:g} mm "
                             "of the tool's axis; give a mesh that is finer there", file=self.mesh_file,
                             field="specimen.mesh_file")
        return mesh


@lru_cache(maxsize=4)
def _read(path: Path, unit: str, changed: int, size: int) -> FileMesh:
    """A file is read once while it stays as it is."""
    from tissue_sim.mesh.solid_file import read_file_mesh

    return read_file_mesh(path, unit)
