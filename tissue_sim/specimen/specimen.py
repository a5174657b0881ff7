"""Specimens: what every shape answers, and the shapes by name.

A new shape is a frozen dataclass in a file of its own, derived from `Specimen`, with its sizes declared by
`tissue_sim.parameters.parameter`; it stands in `SPECIMENS`, or a package adds it by an entry point of that group.
Command line, campaigns and parameters of fits take its sizes from the declarations.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from tissue_sim.errors import InputError, require_length
from tissue_sim.files import read_bytes
from tissue_sim.parameters import Declaration, declared, parameter
from tissue_sim.registry import Registry

if TYPE_CHECKING:
    from tissue_sim.mesh.grading import Grading
    from tissue_sim.mesh.mesh_mapping import Circle
    from tissue_sim.mesh.solid import SolidMesh

#: Gravity where nothing else is said, m/s2.
STANDARD_GRAVITY = 9.81
HEIGHTS = ("moulded", "placed")


class _ByShape(type):
    """``Specimen(0.04, 0.07)`` makes a cylinder, ``Specimen(shape="block", ...)`` a block. Values without names are
    the sizes of the shape first, then what all shapes have."""

    def __call__(cls, *values: Any, **named: Any) -> Any:
        kind: Any = SPECIMENS.find(named.pop("shape", "cylinder"), field="specimen.shape") if cls is Specimen else cls
        entries = {entry.name: entry for entry in sorted(fields(kind), key=lambda entry: entry.name in _COMMON)}
        unknown = [name for name in named if name not in entries]
        if unknown or len(values) > len(entries):
            what = _words(unknown[0]) if unknown else "more sizes"
            raise InputError(f"{with_article(kind.shape)} has no {what}; leave it out",
                             field=f"specimen.{unknown[0] if unknown else 'shape'}")
        named |= zip(entries, values, strict=False)
        for name, entry in entries.items():
            if entry.default is entry.default_factory is MISSING and named.get(name) is None:
                raise InputError(f"{with_article(kind.shape)} needs {with_article(name)}", field=f"specimen.{name}")
        return type.__call__(kind, **named)


@dataclass(frozen=True, kw_only=True)
class Specimen(metaclass=_ByShape):
    """A body of the material that stands on its base; the middle of its top is the origin, z points out of it.

    ``Specimen(radius, height, ...)`` makes a cylinder, ``Specimen(shape=..., **sizes)`` any; a specimen is a frozen
    dataclass with the sizes of its shape as fields, m.

    Attributes:
        shape: name of the shape: ``"cylinder"``, ``"block"``, ``"ellipsoid_shell"``,
            ``"mesh"``; a package may add others.
        is_prism: whether all cross-sections are alike, so that one between plates that slip deforms homogeneously.
        is_flat: whether top and base are planes.
        is_round: whether an axisymmetric section is all of it.
        from_file: whether shape and sizes come from a file.
        texts: key in files -> field, of what it states in words, such as a file or a unit.
        paths: keys of those that name files.
        name: for people and campaign files.
        density: kg/m3, or None where nobody said.
        gravity: m/s2, along z and towards the base; 0 leaves self-weight out.
        height_is: ``"moulded"``, the undeformed height, or ``"placed"``, measured on its base after it has settled.

    Raises:
        InputError: unknown shape; a size that is missing, not positive or not one of the shape; gravity without a
            density.
    """

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

    if TYPE_CHECKING:  # what `_ByShape` takes, and what is a field or a property of every shape
        def __init__(self, *values: Any, **named: Any): ...

        @property
        def height(self) -> float:
            """From the base to the highest point, m; what `height_is` says."""

    def __post_init__(self):
        for name, what in declared(type(self)).items():
            if what.shapes_mesh and what.absent is None:
                require_length(getattr(self, name), f"specimen.{name}")
        if self.density is not None and not (math.isfinite(self.density) and self.density > 0):
            raise InputError(f"{self.density:g} is not a positive density; give kg/m3", field="specimen.density")
        if not (math.isfinite(self.gravity) and self.gravity >= 0):
            raise InputError(f"{self.gravity:g} m/s2 is not a gravity towards the base; give 0 or {STANDARD_GRAVITY}",
                             field="specimen.gravity")
        if self.gravity and self.density is None:
            raise InputError("gravity needs a density; give density in kg/m3", field="specimen.density")
        if self.height_is not in HEIGHTS:
            raise InputError(f"{self.height_is!r} is not a way to measure a height; use 'moulded' or 'placed'",
                             field="specimen.height_is")

    @property
    def specific_weight(self) -> float:
        """Density times gravity, N/m3; 0 where self-weight is left out."""
        return self.density * self.gravity if self.density else 0.0

    @property
    def area(self) -> float:
        """Undeformed cross-section of a prism, m2.

        Raises:
            InputError: it is none.
        """
        raise InputError(f"{with_article(self.shape)} has not one cross-section, and no closed form; simulate it with "
                         "the solver \"solid\" (--solid)", field="specimen.shape")

    @property
    def sizes(self) -> dict[str, float]:
        """Key in files -> value in its unit, of the sizes of its shape."""
        return {what.key: float(f"{getattr(self, name) / what.factor:.15g}")
                for name, what in declared(type(self)).items() if name not in _COMMON}

    @property
    def stated(self) -> dict[str, float | str]:
        """Key in files -> value, of its sizes and of what it states in words: what makes it again."""
        words = {key: value for key, name in self.texts.items() if (value := getattr(self, name)) is not None}
        return {**self.sizes, **{key: str(value) for key, value in words.items()}}

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the files that it comes from; empty where there are none.

        Raises:
            InputError: a file that cannot be read.
        """
        content = [read_bytes(getattr(self, self.texts[key]), f"the {key} of {with_article(self.shape)}")
                   for key in self.paths]
        return hashlib.sha256(b"".join(content)).hexdigest() if content else ""

    @property
    def region_names(self) -> tuple[str, ...]:
        """Of the parts of its mesh that may have a material of their own."""
        return ()

    @property
    def in_words(self) -> str:
        """Its sizes, such as ``radius 40 mm, height 70 mm``."""
        return ", ".join(f"{_words(name)} {getattr(self, name) / what.factor:g} {what.key.rpartition('_')[2]}"
                         for name, what in declared(type(self)).items() if name not in _COMMON)

    def margin(self, x: float = 0.0, y: float = 0.0) -> float:
        """How far a place is from the edge of the top, seen from above, m; negative beyond it."""
        raise NotImplementedError

    @property
    def outer_radius(self) -> float:
        """Of the circle about the axis that it fits in, seen from above, m."""
        raise NotImplementedError

    def depth_at(self, x: float = 0.0, y: float = 0.0) -> float:
        """How much of it is under a place, along the vertical, m."""
        return self.height

    def solid_mesh(self, grading: Grading) -> SolidMesh:
        """Its mesh in space, with the faces ``top``, what a tool may meet, ``base``, what is held, and ``side``, the
        rest; under a needle with the sets ``face`` and ``free`` of `SolidMesh`.

        Raises:
            InputError: a grading that does not fit.
        """
        raise NotImplementedError


    def moved_mesh(self, mesh: SolidMesh, before: Specimen, circles: tuple[Circle, Circle]) -> SolidMesh:
        """A mesh of another specimen of this shape, moved to this one, element by element the same.

        Args:
            mesh: of `before`. circles: that it has about the tool, and that it gets.

        Raises:
            InputError: this shape cannot.
        """
        raise InputError(f"the mesh of {with_article(self.shape)} cannot be moved to another geometry; fit no sizes of "
                         "it, and none of its tool", field="topology")


_COMMON = frozenset(entry.name for entry in fields(Specimen))


def _words(name: str) -> str:
    return name.replace("_", " ")


def with_article(name: str) -> str:
    """A shape or a size in words: ``an ellipsoid shell``."""
    return f"{'an' if name[0] in 'aeiou' else 'a'} {_words(name)}"


#: Shape -> its class.
SPECIMENS: Registry[type[Specimen]] = Registry("specimen shape", "tissue_sim.specimens", {
    "cylinder": "tissue_sim.specimen.cylinder:Cylinder", "block": "tissue_sim.specimen.block:Block",
    "ellipsoid_shell": "tissue_sim.specimen.ellipsoid_shell:EllipsoidShell",
    "mesh": "tissue_sim.specimen.mesh:MeshSpecimen"},
    accepts=lambda kind: isinstance(kind, type) and issubclass(kind, Specimen) and is_dataclass(kind),
    expected="a frozen dataclass derived from Specimen", named_by="shape")


class Size(NamedTuple):
    """A size that shapes of specimens have.

    Attributes:
        declaration: what it is. field: of the specimens. shapes: names of those that have it.
    """

    declaration: Declaration
    field: str
    shapes: tuple[str, ...]


def specimen_sizes() -> dict[str, Size]:
    """Key in files and on the command line -> size, of all shapes.

    Raises:
        InputError: two shapes mean different sizes by one key.
    """
    found: dict[str, Size] = {}
    for shape, kind in SPECIMENS.items():
        for name, what in declared(kind).items():
            if name in _COMMON:
                continue
            first = found.get(what.key, Size(what, name, ()))
            if (first.declaration.factor, first.field) != (what.factor, name):
                raise InputError(f"the shapes {first.shapes[0]} and {shape} mean different sizes by {what.key}; one of "
                                 "them has to take another key", field="tissue_sim.specimens")
            found[what.key] = first._replace(shapes=(*first.shapes, shape))
    return found


def sizes_of(shape: str) -> dict[str, Declaration]:
    """Key in files -> what it is, of the sizes of a shape, in order."""
    return {what.key: what for name, what in declared(SPECIMENS.find(shape, "specimen.shape")).items()
            if name not in _COMMON}


def specimen_texts() -> dict[str, tuple[str, ...]]:
    """Key in files -> names of the shapes that state it, of what shapes state in words.

    Raises:
        InputError: one shape means a size by a key that is a word of another.
    """
    found: dict[str, tuple[str, ...]] = {}
    for shape, kind in SPECIMENS.items():
        for key in kind.texts:
            if key in specimen_sizes():
                raise InputError(f"{with_article(shape)} states {key} in words, which is a size of another shape; one "
                                 "of them has to take another key", field="tissue_sim.specimens")
            found[key] = (*found.get(key, ()), shape)
    return found


def keys_of(shape: str) -> dict[str, bool]:
    """Key in files -> whether it has to be stated, of the sizes of a shape and of what it states in words."""
    kind = SPECIMENS.find(shape, "specimen.shape")
    usual = {entry.name: entry.default is not MISSING for entry in fields(kind)}
    return {**{key: what.absent is None for key, what in sizes_of(shape).items()},
            **{key: not usual[name] for key, name in kind.texts.items()}}


def specimen_of_keys(shape: str, stated: Mapping[str, float | str], **common: Any) -> Specimen:
    """A specimen of a shape from sizes by their keys of `specimen_sizes`, in the units of files, from what it states in
    words, and from what all shapes have, in SI.

    Raises:
        InputError: what `Specimen` raises, the field the key of a size.
    """
    known = specimen_sizes()
    texts = SPECIMENS[shape].texts if shape in SPECIMENS else {}
    try:
        return Specimen(shape=shape, **common, **{texts[key] if key in texts else known[key].field:
                        known[key].declaration.factor * value if isinstance(value, float | int) else value
                        for key, value in stated.items()})
    except InputError as error:
        field = (error.field or "").removeprefix("specimen.")
        keys = {what.key: name for name, what in declared(SPECIMENS[shape]).items()} if shape in SPECIMENS else {}
        keys |= {key: size.field for key, size in known.items() if key not in keys} | dict(texts)
        raise InputError(error.problem, file=error.file, line=error.line,
                         field=next((key for key, name in keys.items() if name == field), field)) from None
