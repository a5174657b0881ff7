"""Rigid tools: contract of a shape, and registry by name.

A new shape is a frozen dataclass in its own file, derived from `Tool`, whose sizes are declared by
`tissue_sim.parameters.parameter`. It is listed in `TOOLS`, or added by another package through an entry point of the
group ``tissue_sim.tools``. Command line, campaigns and fits read the sizes from the declarations.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from tissue_sim.errors import InputError, require_positive_length
from tissue_sim.experiment.tools.outline import Profile
from tissue_sim.parameters import Declaration, list_field_declarations
from tissue_sim.public_names import rename_old_members_of_subclass, with_old_names
from tissue_sim.registry import Registry


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
    "plate": "tissue_sim.experiment.tools.plate:Plate",
    "flat": "tissue_sim.experiment.tools.flat:Flat",
    "round": "tissue_sim.experiment.tools.round:HemisphericalNeedle",
    "cone": "tissue_sim.experiment.tools.cone:Cone",
    "sphere": "tissue_sim.experiment.tools.sphere:Sphere",
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
