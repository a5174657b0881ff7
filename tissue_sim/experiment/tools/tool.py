"""Rigid tools: contract of a shape, registry by name, and outlines of rigid bodies of revolution.

Outlines have distances of the tissue from them, and sizes that several shapes share.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, InitVar, dataclass, field, fields, is_dataclass
from enum import IntEnum
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from tissue_sim.errors import InputError, require_positive_length
from tissue_sim.parameters import Declaration, list_field_declarations, parameter
from tissue_sim.public_names import rename_old_members_of_subclass, with_old_names
from tissue_sim.registry import Registry

if TYPE_CHECKING:
    import numpy as np

#: Smallest and largest radius in a fit, m.
_RADII = (1e-6, 1.0)


def radius() -> Any:
    """Declare the field `radius` of a tool: radius of the shaft, or of the ball, m."""
    return parameter("a", "m", key="tool_radius_mm", factor=1e-3, bounds=_RADII, shapes_mesh=True)


def edge_radius() -> Any:
    """Declare the field `edge_radius` of a tool: radius of the rounding between a flat face and the shaft, m."""
    return parameter("r_e", "m", key="edge_radius_mm", factor=1e-3, bounds=(0.0, _RADII[1]), absent=0.0,
                     shapes_mesh=True, default=0.0)


#: Length of a shaft in radii of the tool; longer than any specimen.
SHAFT_LENGTH = 1e3


class OutlineLineColumn(IntEnum):
    """Columns of `Profile.lines`, one row for each line segment.

    Attributes:
        R, Z: first point, m.
        DIRECTION_R, DIRECTION_Z: unit vector to the second point.
        LENGTH: length, m.
    """

    R = 0
    Z = 1
    DIRECTION_R = 2
    DIRECTION_Z = 3
    LENGTH = 4


class PolylineDistances(NamedTuple):
    """Distances and normals at the closest points of a polyline.

    Attributes:
        line: index of the line segment, shape (n,).
        distance: signed distance, m, negative inside of the body, shape (n,).
        normal: outward unit normal (r, z), shape (n, 2).
        curvature: curvature of the offset curve through the point, 1/m, shape (n,): 1 / distance if a vertex is
            closest, otherwise 0.
    """

    line: np.ndarray
    distance: np.ndarray
    normal: np.ndarray
    curvature: np.ndarray


@dataclass(frozen=True, eq=False)
class Profile:
    """Outline of a rigid body of revolution: a polyline thickened by a rounding radius.

    The frame is the tool's: r from the axis, z out of the tissue, origin at the deepest point. The polyline runs from
    the axis outwards and upwards with the body on its left.

    Args:
        points: the vertices, (r, z), m.

    Attributes:
        vertices: (r, z), m, shape (n, 2).
        rounding: distance between the polyline and the surface outside of it, m.
        shaft: index of the first segment that belongs to the shaft; the segments before form the face.
    """

    points: InitVar[np.ndarray | Sequence[tuple[float, float]]]
    rounding: float
    shaft: int
    vertices: np.ndarray = field(init=False)

    def __post_init__(self, points: np.ndarray | Sequence[tuple[float, float]]):
        # Local import: the command line's help knows the shapes and must not import numpy.
        import numpy as np

        object.__setattr__(self, "vertices", np.asarray(points, dtype=float))

    @cached_property
    def lines(self) -> np.ndarray:
        """Line segments of the polyline, with the columns `OutlineLineColumn`, shape (n - 1, 5)."""
        import numpy as np

        segment = np.diff(self.vertices, axis=0)
        length = np.linalg.norm(segment, axis=1)
        return np.column_stack([self.vertices[:-1], segment / length[:, None], length])

    def compute_distances_to_polyline(self, points: np.ndarray, first_line: int = 0,
                                      is_endless: bool = False) -> PolylineDistances:
        """Compute distances and normals at the closest points of the polyline, without its rounding.

        `tissue_sim.fem.contact.surface_geometry` is the same algorithm for kernels.

        Args:
            points: (r, z), m, shape (n, 2).
            first_line: index of the first line segment.
            is_endless: whether the first line segment is extended without end before its first point.
        """
        import numpy as np

        lines = self.lines[first_line:]
        start, t, length = lines[:, :2], lines[:, 2:4], lines[:, OutlineLineColumn.LENGTH]
        offset = np.asarray(points, dtype=float)[:, None] - start
        along = np.einsum("nsi,si->ns", offset, t)
        lower = np.where(is_endless & (np.arange(len(length)) == 0), -np.inf, 0.0)
        share = np.maximum(np.minimum(along, length), lower)
        arrow = offset - share[..., None] * t
        distance = np.linalg.norm(arrow, axis=-1)
        front = arrow[..., 0] * t[:, 1] - arrow[..., 1] * t[:, 0]
        # At a vertex two segments are equally close; the one with the larger normal distance determines the sign.
        best = np.lexsort((-np.abs(front), np.round(distance, 15)), axis=-1)[:, 0]
        rows = np.arange(len(points))
        distance, front, share, along, arrow = (each[rows, best] for each in (distance, front, share, along, arrow))
        # Points before the start of the polyline are outside.
        inside = (front < 0.0) & (is_endless | ~((best == 0) & (along < 0.0)))
        sign = np.where(inside, -1.0, 1.0)
        beyond = (share != along) & (distance > 0.0)
        safe = np.where(distance > 0.0, distance, 1.0)
        normal = np.where(beyond[:, None], (sign / safe)[:, None] * arrow, np.stack([t[best, 1], -t[best, 0]], axis=-1))
        return PolylineDistances(best + first_line, sign * distance, normal, np.where(beyond, sign / safe, 0.0))

    def gap(self, points: np.ndarray) -> np.ndarray:
        """Return the signed distance of points from the surface, m, positive outside, shape (n,).

        Args:
            points: (r, z), m, shape (n, 2).
        """
        return self.compute_distances_to_polyline(points).distance - self.rounding

    def sample_outline_up_to_height(self, height: float) -> np.ndarray:
        """Return points (r, z), m, on the surface from the axis up to `height`, m, for drawing, shape (n, 2)."""
        import numpy as np

        segment = np.diff(self.vertices, axis=0)
        angle = np.arctan2(-segment[:, 0], segment[:, 1])  # of the outward normal
        # The surface begins on the axis, under the first vertex.
        angle = np.concatenate([[-np.pi / 2], angle, [np.pi / 2 if self.vertices[-1, 1] < height else angle[-1]]])
        turns = np.linspace(angle[:-1], angle[1:], 25, axis=1)
        normals = np.stack([np.cos(turns), np.sin(turns)], axis=-1)
        points = (self.vertices[:, None] + self.rounding * normals).reshape(-1, 2)
        points[:, 1] = np.minimum(points[:, 1], height)
        return points


class _MakeToolByShapeNameMeta(type):
    """Metaclass: ``Tool("flat", radius=0.008)`` makes a tool of that shape."""

    def __call__(cls, *values: Any, **sizes: Any) -> Any:
        if cls is not Tool:
            return super().__call__(*values, **sizes)
        shape, *unnamed = (sizes.pop("shape", "plate"),) if "shape" in sizes or not values else values
        kind = TOOLS.find(shape, field="tool")
        entries = {entry.name: entry for entry in fields(kind)}
        if len(unnamed) > len(entries):
            raise _make_inapplicable_size_error(kind, "radius" if not entries else "more sizes")
        sizes = {name: value for name, value in (*zip(entries, unnamed, strict=False), *sizes.items())
                 if value is not None and (value or name in entries)}
        for name in sizes:
            if name not in entries:
                raise _make_inapplicable_size_error(kind, name)
        for entry in entries.values():
            if entry.default is entry.default_factory is MISSING and entry.name not in sizes:
                raise InputError(f"a {shape} tool needs a {_spell_name(entry.name)}", field=f"tool.{entry.name}")
        return kind(**sizes)


@with_old_names(require_sizes="require_valid_radius_and_roundings", sharp_edge="has_sharp_edge")
class Tool(metaclass=_MakeToolByShapeNameMeta):
    """A rigid body that is moved into the specimen.

    ``Tool(shape, **sizes)`` makes one; a tool is a frozen dataclass with the sizes of its shape as fields, m and rad.

    Attributes:
        name: name of the shape: ``"plate"`` covers the whole top; ``"flat"`` is a needle with a flat face, ``"round"``
            one with a hemispherical tip, ``"cone"`` one with a conical tip; ``"sphere"`` is a ball; ``"profile"`` comes
            from a file; packages may add others.
        is_plate: whether the tool covers the whole top.
        has_shaft: whether tissue may meet a shaft above the face.
        from_file: whether the outline comes from a file.
        radius: of the shaft or of the ball, m; None for a plate.
        edge_radius: radius of the rounding between a flat face and the shaft, m.

    Raises:
        InputError: an unknown shape; a size that is missing, invalid or not one of the shape.
    """

    name: ClassVar[str]
    is_plate: ClassVar[bool] = False
    has_shaft: ClassVar[bool] = True
    from_file: ClassVar[bool] = False
    radius: float | None = None
    edge_radius: float = 0.0
    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    def __init_subclass__(cls, **options: Any):
        super().__init_subclass__(**options)
        rename_old_members_of_subclass(cls, {"sharp_edge": "has_sharp_edge"})

    @property
    def shape(self) -> str:
        """Name of the shape."""
        return self.name

    if TYPE_CHECKING:  # the arguments of `_MakeToolByShapeNameMeta.__call__`
        def __init__(self, *values: Any, **sizes: Any): ...

    @property
    def profile(self) -> Profile:
        """Outline for contact; each shape defines its own."""
        # No abstract class: Tool("flat") makes a shape by its name, and type checkers refuse to call an abstract one.
        raise NotImplementedError

    @property
    def face_radius(self) -> float | None:
        """Radius of the flat part of the face, m; 0 if there is none, None for a plate."""
        return 0.0

    @property
    def has_sharp_edge(self) -> bool:
        """Whether a flat face ends in an edge without rounding. Tissue cannot slide around such an edge."""
        return False

    def contact_radius(self, depth: float, specimen_radius: float = math.inf) -> float:
        """Approximate radius of the contact at a depth, m.

        For a pointed or round tool that on an elastic half-space (Hertz; Sneddon, Int. J. Eng. Sci. 3 (1965) 47), for a
        plate the radius of the specimen.

        Examples:
            >>> Tool("sphere", radius=0.008).contact_radius(0.002)
            0.004
        """
        raise NotImplementedError

    def require_radius(self) -> float:
        """Return the radius, m.

        Raises:
            InputError: the tool has no radius, or the radius is not a positive finite length.
        """
        radius = self.radius or 0.0
        require_positive_length(radius, "tool.radius")
        return radius

    def require_valid_radius_and_roundings(self, *roundings: str) -> None:
        """Check the radius, and that roundings are smaller than the radius.

        Args:
            roundings: names of fields.

        Raises:
            InputError: an invalid size.
        """
        radius = self.require_radius()
        for name in roundings:
            value = getattr(self, name)
            if not 0 <= value < radius:
                raise InputError(f"must be 0 or more and less than the radius {radius:g} m; got {value:g} m.",
                                 field=f"tool.{name}")


def _spell_name(name: str) -> str:
    return name.replace("_", " ")


def _make_inapplicable_size_error(kind: type[Tool], name: str) -> InputError:
    """Return the error for a size `name` that the shape does not have; the caller raises it."""
    problem = "a plate covers the whole top face and has no radius" if kind.is_plate else \
        f"a {kind.name} tool has no {_spell_name(name)}"
    return InputError(f"{problem}; leave it out", field=f"tool.{name}")


#: Shape -> its class.
TOOLS: Registry[type[Tool]] = Registry("tool shape", "tissue_sim.tools", {
    "plate": "tissue_sim.experiment.tools.shapes:Plate",
    "flat": "tissue_sim.experiment.tools.shapes:Flat",
    "round": "tissue_sim.experiment.tools.shapes:HemisphericalNeedle",
    "cone": "tissue_sim.experiment.tools.shapes:Cone",
    "sphere": "tissue_sim.experiment.tools.shapes:Sphere",
    "profile": "tissue_sim.experiment.tools.profile:ProfileTool",
}, accepts=lambda kind: isinstance(kind, type) and issubclass(kind, Tool) and is_dataclass(kind),
    expected="a frozen dataclass derived from Tool")


class ToolSizeOfShapes(NamedTuple):
    """A size of one or several shapes of tools.

    Attributes:
        declaration: declaration of the parameter.
        field: field of the tools.
        shapes: names of the shapes with this size.
    """

    declaration: Declaration
    field: str
    shapes: tuple[str, ...]


def list_all_tool_sizes_by_key() -> dict[str, ToolSizeOfShapes]:
    """Return the sizes of all shapes by their keys in files and on the command line.

    Raises:
        InputError: two shapes use one key for different sizes.
    """
    found: dict[str, ToolSizeOfShapes] = {}
    for shape, kind in TOOLS.items():
        for name, what in list_field_declarations(kind).items():
            first = found.get(what.key, ToolSizeOfShapes(what, name, ()))
            if (first.declaration.factor, first.field) != (what.factor, name):
                raise InputError(f"the shapes {first.shapes[0]} and {shape} use the key {what.key} for different "
                                 "sizes; rename one of them", field="tissue_sim.tools")
            found[what.key] = first._replace(shapes=(*first.shapes, shape))
    return found


def convert_tool_sizes_to_si(stated: Mapping[str, float]) -> dict[str, float]:
    """Convert sizes from keys and units of files (see `list_all_tool_sizes_by_key`) to fields of a tool in SI."""
    known = list_all_tool_sizes_by_key()
    return {known[key].field: known[key].declaration.factor * value for key, value in stated.items()}


def list_shapes_without_file() -> tuple[str, ...]:
    """Names of the shapes that are defined by sizes, without a file."""
    return tuple(name for name, kind in TOOLS.items() if not kind.from_file)


def interpret_shape_or_profile_path(word: str, folder: Path = Path()) -> tuple[str, Path | None]:
    """Interpret the name of a shape or of a file; a word with a suffix or a folder that is not a shape is a file.

    Args:
        word: text from the user.
        folder: folder that files are relative to.

    Returns:
        Name of the shape, and path of its profile or None.
    """
    path = Path(word)
    if word in TOOLS or not (path.suffix or len(path.parts) > 1):
        return word, None
    return "profile", folder / path
