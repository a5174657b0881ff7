"""A body of any shape, whose mesh is read from a file."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from tissue_sim.errors import InputError
from tissue_sim.public_names import OldName
from tissue_sim.specimen.specimen import Specimen

if TYPE_CHECKING:
    from tissue_sim.mesh.sections import VerticalProjection
    from tissue_sim.mesh.solid import Grading, SolidMesh
    from tissue_sim.mesh.solid_file import FileMesh

#: Smallest number of corner nodes under a tool.
_FEWEST = 4


@dataclass(frozen=True)
class MeshSpecimen(Specimen):
    """A body whose mesh of tetrahedra or hexahedra comes from another program.

    In the file z points upwards. The origin is the middle of the bounding box of the top.

    Attributes:
        mesh_file: .msh of Gmsh, .vtu or .vtk, or .inp of Abaqus or CalculiX.
        mesh_unit: unit of the coordinates: ``"mm"``, ``"m"``, ``"cm"``, ``"um"``, ``"in"``.
        mesh_base: name in the file of the faces that are held; None: the faces in the lowest plane.
        mesh_top: name of the faces that the tool may touch; None: the faces in the highest plane, or all upward faces.
        content: mesh of the file, if the file is not to be read again; `mesh_file` is then a name without folder.

    Raises:
        InputError: see `tissue_sim.mesh.solid_file.read_file_mesh`; a name that the file does not have.
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
    mesh_of_file = OldName("loaded_file_mesh")

    def __post_init__(self):
        super().__post_init__()
        if self.content is not None and str(self.mesh_file) != Path(self.mesh_file).name:
            raise InputError("must be left out if mesh_file is a path; the mesh would be defined twice",
                             field="specimen.content")
        # A class attribute in most shapes; here it depends on the file.
        object.__setattr__(self, "is_flat", self._vertical_projection.is_flat)

    def __eq__(self, other: object) -> bool:
        """Whether the contents of the files and all other fields are equal; the names of the files are ignored."""
        return isinstance(other, MeshSpecimen) and self._equality_key == other._equality_key

    def __hash__(self) -> int:
        return hash(self._equality_key)

    @property
    def _equality_key(self) -> tuple:
        """Values that determine equality and hash: digest of the file and all other fields except the path."""
        return (self.digest_of_files, self.mesh_unit, self.mesh_base, self.mesh_top, self.name, self.density,
                self.gravity,
                self.height_is)

    @cached_property
    def _mesh(self) -> FileMesh:
        """Mesh of the file, m: `content`, or read from the file at first use."""
        if self.content is not None:
            return self.content
        path = Path(self.mesh_file)
        try:
            found = path.stat()
            return _read_cached_file_mesh(path.resolve(), self.mesh_unit, found.st_mtime_ns, found.st_size)
        except (OSError, ValueError):
            return _read_cached_file_mesh(path, self.mesh_unit, 0, 0)  # raises the error with its reason

    @property
    def loaded_file_mesh(self) -> FileMesh:
        """Nodes, elements and named sets of the mesh file, as read."""
        return self._mesh

    @cached_property
    def digest_of_files(self) -> str:
        """SHA-256 of the bytes of the mesh file."""
        return self._mesh.digest

    @cached_property
    def _vertical_projection(self) -> VerticalProjection:
        """Plan view of the body: its top and base faces, with the origin in the middle of the top."""
        from tissue_sim.mesh.sections import VerticalProjection
        from tissue_sim.mesh.solid_file import find_base_and_top, find_top_box_centre_and_height

        mesh = self._mesh
        try:
            held, met = find_base_and_top(mesh, self.mesh_base, self.mesh_top)
        except InputError as error:
            raise error.with_location(file=self.mesh_file) from None
        return VerticalProjection(mesh.points - find_top_box_centre_and_height(mesh, met), mesh.sides[met],
                                  mesh.sides[held], mesh.sides)

    @property
    def height(self) -> float:
        """Distance between the lowest and the highest node, m."""
        heights = self._mesh.points[:, 2]
        return float(heights.max() - heights.min())

    @property
    def region_names(self) -> tuple[str, ...]:
        """Names of the regions of the file, in the order of the file."""
        return tuple(self._mesh.regions)

    @property
    def in_words(self) -> str:
        """Name of the file and extent along x, y and z, mm."""
        x, y, z = (1e3 * (self._mesh.points.max(axis=0) - self._mesh.points.min(axis=0))).tolist()
        return f"{Path(self.mesh_file).name} of {x:.4g} x {y:.4g} x {z:.4g} mm"

    def margin(self, x: float = 0.0, y: float = 0.0) -> float:
        """Return the distance of a position (x, y) from the edge of the top, in plan view, m; negative outside."""
        return self._vertical_projection.compute_distance_inside_top_rim(x, y)

    @property
    def outer_radius(self) -> float:
        """Radius of the smallest circle about the axis that contains the body in plan view, m."""
        return self._vertical_projection.outer_radius

    def vertical_thickness(self, x: float = 0.0, y: float = 0.0) -> float:
        """Return the vertical thickness of the body under a point, m."""
        return self._vertical_projection.vertical_thickness(x, y)

    def solid_mesh(self, grading: Grading) -> SolidMesh:
        """Return the elements of the file, raised to the order of the elements of the grading.

        Args:
            grading: element type, and radius and centre of the tool; its element sizes are ignored.

        Raises:
            InputError: layers, or fewer than `_FEWEST` nodes under the tool.
        """
        from tissue_sim.mesh.solid import add_face_and_free_node_sets
        from tissue_sim.mesh.solid_file import convert_file_mesh

        if grading.interfaces:
            raise InputError("must be left out for a mesh from a file; use regions instead",
                             field="material.layers")
        try:
            mesh = convert_file_mesh(self._mesh, grading.element.order, base=self.mesh_base, top=self.mesh_top)
        except InputError as error:
            raise error.with_location(file=self.mesh_file) from None
        if grading.radius is None:
            return mesh
        mesh = add_face_and_free_node_sets(mesh, grading.radius, grading.centre)
        if mesh.sets["face"].size < _FEWEST:
            raise InputError(f"only {mesh.sets['face'].size} nodes of the top lie within {grading.radius * 1e3:g} mm "
                             "of the tool's axis; give a mesh that is finer there", file=self.mesh_file,
                             field="specimen.mesh_file")
        return mesh


@lru_cache(maxsize=4)
def _read_cached_file_mesh(path: Path, unit: str, changed: int, size: int) -> FileMesh:
    """Read a mesh file, with a cache; `changed` and `size` of the file are part of the key of the cache."""
    from tissue_sim.mesh.solid_file import read_file_mesh

    return read_file_mesh(path, unit)
