"""Specimens: contract of a shape, and registry by name.

A new shape is a frozen dataclass in its own file, derived from `Specimen`, whose sizes are declared by
`tissue_sim.parameters.parameter`. It is listed in `SPECIMENS`, or added by another package through an entry point of
the group ``tissue_sim.specimens``. Command line, campaigns and fits read the sizes from the declarations.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from tissue_sim.errors import InputError, require_positive_length
from tissue_sim.files import read_bytes
from tissue_sim.parameters import Declaration, list_field_declarations, parameter
from tissue_sim.public_names import OldName, rename_old_members_of_subclass, with_old_names
from tissue_sim.registry import Registry

if TYPE_CHECKING:
    from tissue_sim.mesh.mesh_mapping import Circle
    from tissue_sim.mesh.solid import Grading, SolidMesh

#: Standard value of gravity, m/s2.
STANDARD_GRAVITY = 9.81
#: Meanings of a height: undeformed, or settled under its weight.
HEIGHTS = ("moulded", "placed")


class _ShapeChoosingSpecimenMeta(type):
    """Metaclass: ``Specimen(0.04, 0.07)`` makes a cylinder, ``Specimen(shape="block", ...)`` a block.

    Positional values are first the sizes of the shape, then the fields that all shapes have.
    """

    def __call__(cls, *values: Any, **named: Any) -> Any:
        kind: Any = SPECIMENS.find(named.pop("shape", "cylinder"), field="specimen.shape") if cls is Specimen else cls
        entries = {entry.name: entry for entry in sorted(fields(kind), key=lambda entry: entry.name in _COMMON)}
        unknown = [name for name in named if name not in entries]
        if unknown or len(values) > len(entries):
            what = _replace_underscores_by_blanks(unknown[0]) if unknown else "more sizes"
            raise InputError(f"{add_indefinite_article(kind.shape)} has no {what}; leave it out",
                             field=f"specimen.{unknown[0] if unknown else 'shape'}")
        named |= zip(entries, values, strict=False)
        for name, entry in entries.items():
            if entry.default is entry.default_factory is MISSING and named.get(name) is None:
                raise InputError(f"{add_indefinite_article(kind.shape)} needs {add_indefinite_article(name)}",
                                 field=f"specimen.{name}")
        return type.__call__(kind, **named)


@with_old_names(digest="digest_of_files", stated="values_by_file_key")
@dataclass(frozen=True, kw_only=True)
class Specimen(metaclass=_ShapeChoosingSpecimenMeta):
    """A body of the material that stands on its base; the origin is the middle of its top, z points out of the body.

    ``Specimen(radius, height, ...)`` makes a cylinder, ``Specimen(shape=..., **sizes)`` any shape. A specimen is a
    frozen dataclass with the sizes of its shape as fields, m.

    Attributes:
        shape: name of the shape: ``"cylinder"``, ``"block"``, ``"ellipsoid_shell"``, ``"mesh"``; packages may add
            others.
        is_prism: whether all cross-sections are equal, so that the body deforms homogeneously between frictionless
            plates.
        is_flat: whether top and base are planes.
        is_round: whether the body is axisymmetric.
        from_file: whether shape and sizes come from a file.
        texts: key in files -> field, for fields that are texts, such as a file or a unit.
        paths: keys of the texts that are file names.
        name: name in reports and campaign files.
        density: kg/m3; None if unknown.
        gravity: m/s2, towards the base; 0: without self-weight.
        height_is: ``"moulded"``: `height` is the undeformed height; ``"placed"``: the height under the weight.

    Raises:
        InputError: an unknown shape; a size that is missing, not positive or not one of the shape; gravity without a
            density.

    Examples:
        >>> Specimen(0.040, 0.070).area == math.pi * 0.040**2
        True
        >>> Specimen(shape="block", length=0.02, width=0.03, height=0.01).shape
        'block'
    """

    depth_at = OldName("vertical_thickness")

    shape: ClassVar[str]
    is_prism: ClassVar[bool] = True
    is_flat: ClassVar[bool] = True
    is_round: ClassVar[bool] = False
    from_file: ClassVar[bool] = False
    texts: ClassVar[Mapping[str, str]] = {}
    paths: ClassVar[tuple[str, ...]] = ()
    name: str = "specimen"
    density: float | None = parameter("rho", "kg/m3", key="density_kg_m3", bounds=(1.0, 1e5), default=None)
    gravity: float = parameter("g0", "m/s2", key="gravity_m_s2", bounds=(0.0, 100.0), absent=0.0, default=0.0)
    height_is: str = "moulded"

    if TYPE_CHECKING:  # the arguments of `_ShapeChoosingSpecimenMeta.__call__`, and a field or property of every shape
        def __init__(self, *values: Any, **named: Any): ...

        @property
        def height(self) -> float:
            """Distance between the base and the highest point, m; see `height_is`."""

    def __init_subclass__(cls, **options: Any):
        super().__init_subclass__(**options)
        rename_old_members_of_subclass(cls, {"depth_at": "vertical_thickness", "digest": "digest_of_files",
                                             "stated": "values_by_file_key"})

    def __post_init__(self):
        for name, what in list_field_declarations(type(self)).items():
            if what.shapes_mesh and what.absent is None:
                require_positive_length(getattr(self, name), f"specimen.{name}")
        if self.density is not None and not (math.isfinite(self.density) and self.density > 0):
            raise InputError(f"must be positive and finite; got {self.density:g} kg/m3.", field="specimen.density")
        if not (math.isfinite(self.gravity) and self.gravity >= 0):
            raise InputError(f"must be 0 or positive, towards the base, such as {STANDARD_GRAVITY}; got "
                             f"{self.gravity:g} m/s2.",
                             field="specimen.gravity")
        if self.gravity and self.density is None:
            raise InputError("must be given, in kg/m3, if gravity acts.", field="specimen.density")
        if self.height_is not in HEIGHTS:
            raise InputError(f"must be 'moulded' or 'placed'; got {self.height_is!r}.",
                             field="specimen.height_is")

    @property
    def specific_weight(self) -> float:
        """Density times gravity, N/m3; 0 without self-weight."""
        return self.density * self.gravity if self.density else 0.0

    @property
    def area(self) -> float:
        """Undeformed cross-section of a prism, m2.

        Raises:
            InputError: the body is not a prism.
        """
        raise InputError(f"{add_indefinite_article(self.shape)} has no constant cross-section and no closed form; use "
                         f"the solver "
                         "\"solid\" (--solid)", field="specimen.shape")

    @property
    def sizes(self) -> dict[str, float]:
        """Sizes of the shape: key in files -> value in the unit of the key."""
        return {what.key: float(f"{getattr(self, name) / what.factor:.15g}")
                for name, what in list_field_declarations(type(self)).items() if name not in _COMMON}

    @property
    def values_by_file_key(self) -> dict[str, float | str]:
        """Sizes and texts that define the specimen: key in files -> value."""
        words = {key: value for key, name in self.texts.items() if (value := getattr(self, name)) is not None}
        return {**self.sizes, **{key: str(value) for key, value in words.items()}}

    @cached_property
    def digest_of_files(self) -> str:
        """SHA-256 of the files of the specimen; "" without files.

        Raises:
            InputError: a file cannot be read.
        """
        content = [read_bytes(getattr(self, self.texts[key]), f"the {key} of {add_indefinite_article(self.shape)}")
                   for key in self.paths]
        return hashlib.sha256(b"".join(content)).hexdigest() if content else ""

    @property
    def region_names(self) -> tuple[str, ...]:
        """Names of the regions of the mesh that may have their own material."""
        return ()

    @property
    def in_words(self) -> str:
        """Sizes in words, such as ``radius 40 mm, height 70 mm``."""
        return ", ".join(
            f"{_replace_underscores_by_blanks(name)} {getattr(self, name) / what.factor:g} "
            f"{what.key.rpartition('_')[2]}"
            for name, what in list_field_declarations(type(self)).items() if name not in _COMMON)

    def margin(self, x: float = 0.0, y: float = 0.0) -> float:
        """Return the distance of a position (x, y) from the edge of the top, in plan view, m; negative outside."""
        raise NotImplementedError

    @property
    def outer_radius(self) -> float:
        """Radius of the smallest circle about the axis that contains the body in plan view, m."""
        raise NotImplementedError

    def vertical_thickness(self, x: float = 0.0, y: float = 0.0) -> float:
        """Return the vertical thickness of the body at a point (x, y), m."""
        return self.height

    def solid_mesh(self, grading: Grading) -> SolidMesh:
        """Make the three-dimensional mesh of the specimen.

        Its faces are ``top`` (may touch the tool), ``base`` (held) and ``side`` (others); under a needle it has the
        sets ``face`` and ``free`` of `SolidMesh`.

        Raises:
            InputError: the grading does not fit.
        """
        raise NotImplementedError

    def moved_mesh(self, mesh: SolidMesh, before: Specimen, circles: tuple[Circle, Circle]) -> SolidMesh:
        """Move a mesh of another specimen of this shape to this specimen; the elements stay the same.

        Args:
            mesh: mesh of `before`.
            before: specimen of the mesh.
            circles: circles about the tool in the mesh before and after.

        Raises:
            InputError: the shape does not support this.
        """
        raise InputError(f"the mesh of {add_indefinite_article(self.shape)} cannot be moved to another geometry; do "
                         f"not fit "
                         "sizes of the specimen or of its tool", field="topology")


#: Names of the fields that all shapes have.
_COMMON = frozenset(entry.name for entry in fields(Specimen))


def _replace_underscores_by_blanks(name: str) -> str:
    """Return a name with blanks instead of underscores."""
    return name.replace("_", " ")


def add_indefinite_article(name: str) -> str:
    """Return the name of a shape or a size with its indefinite article: ``an ellipsoid shell``."""
    return f"{'an' if name[0] in 'aeiou' else 'a'} {_replace_underscores_by_blanks(name)}"


#: Shape -> class.
SPECIMENS: Registry[type[Specimen]] = Registry("specimen shape", "tissue_sim.specimens", {
    "cylinder": "tissue_sim.specimen.cylinder:Cylinder", "block": "tissue_sim.specimen.block:Block",
    "ellipsoid_shell": "tissue_sim.specimen.ellipsoid_shell:EllipsoidShell",
    "mesh": "tissue_sim.specimen.mesh:MeshSpecimen"},
    accepts=lambda kind: isinstance(kind, type) and issubclass(kind, Specimen) and is_dataclass(kind),
    expected="a frozen dataclass derived from Specimen", named_by="shape")


class SizeDeclarationWithShapes(NamedTuple):
    """A size of one or several shapes of specimens.

    Attributes:
        declaration: declaration of the parameter.
        field: field of the specimens.
        shapes: names of the shapes with this size.
    """

    declaration: Declaration
    field: str
    shapes: tuple[str, ...]


def specimen_sizes() -> dict[str, SizeDeclarationWithShapes]:
    """Return key in files and on the command line -> declaration and shapes, for the sizes of all shapes.

    Raises:
        InputError: two shapes use one key for different sizes.
    """
    found: dict[str, SizeDeclarationWithShapes] = {}
    for shape, kind in SPECIMENS.items():
        for name, what in list_field_declarations(kind).items():
            if name in _COMMON:
                continue
            first = found.get(what.key, SizeDeclarationWithShapes(what, name, ()))
            if (first.declaration.factor, first.field) != (what.factor, name):
                raise InputError(f"the shapes {first.shapes[0]} and {shape} use the key {what.key} for different "
                                 "sizes; rename one of them", field="tissue_sim.specimens")
            found[what.key] = first._replace(shapes=(*first.shapes, shape))
    return found


def get_size_declarations_of_shape(shape: str) -> dict[str, Declaration]:
    """Return key in files -> declaration, for the sizes of a shape, in the order of its fields."""
    return {what.key: what for name, what in list_field_declarations(SPECIMENS.find(shape, "specimen.shape")).items()
            if name not in _COMMON}


def specimen_texts() -> dict[str, tuple[str, ...]]:
    """Return key in files -> names of the shapes with this key, for all keys whose value is a text.

    Raises:
        InputError: the key of a text is the key of a size of another shape.
    """
    found: dict[str, tuple[str, ...]] = {}
    for shape, kind in SPECIMENS.items():
        for key in kind.texts:
            if key in specimen_sizes():
                raise InputError(f"{add_indefinite_article(shape)} uses the key {key} for a text and another shape "
                                 f"for a size; "
                                 "rename one of them", field="tissue_sim.specimens")
            found[key] = (*found.get(key, ()), shape)
    return found


def map_shape_keys_to_required(shape: str) -> dict[str, bool]:
    """Return key in files -> whether the key is required, for the sizes and texts of a shape."""
    kind = SPECIMENS.find(shape, "specimen.shape")
    usual = {entry.name: entry.default is not MISSING for entry in fields(kind)}
    return {**{key: what.absent is None for key, what in get_size_declarations_of_shape(shape).items()},
            **{key: not usual[name] for key, name in kind.texts.items()}}


def make_specimen_from_keys(shape: str, stated: Mapping[str, float | str], **common: Any) -> Specimen:
    """Make a specimen from the keys of files.

    Args:
        shape: name of the shape.
        stated: sizes in the units of their keys (`specimen_sizes`), and texts.
        common: fields that all shapes have, SI.

    Raises:
        InputError: see `Specimen`; the field is the key of a size.
    """
    known = specimen_sizes()
    texts = SPECIMENS[shape].texts if shape in SPECIMENS else {}
    try:
        return Specimen(shape=shape, **common, **{texts[key] if key in texts else known[key].field:
                                                  known[key].declaration.factor * value
                                                  if isinstance(value, float | int) else value
                                                  for key, value in stated.items()})
    except InputError as error:
        field = (error.field or "").removeprefix("specimen.")
        declarations = list_field_declarations(SPECIMENS[shape]) if shape in SPECIMENS else {}
        keys = {what.key: name for name, what in declarations.items()}
        keys |= {key: size.field for key, size in known.items() if key not in keys} | dict(texts)
        raise InputError(error.problem, file=error.file, line=error.line,
                         field=next((key for key, name in keys.items() if name == field), field)) from None
