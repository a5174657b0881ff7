"""Contract of a target: a program for which materials are written, and from whose files they are read."""

from __future__ import annotations

import math
import re
import textwrap
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from tissue_sim.errors import InputError
from tissue_sim.exports.elastic_constants import ElasticConstants
from tissue_sim.exports.unit_systems import SI, UNIT_SYSTEMS, UnitSystem
from tissue_sim.material.fractional_zener import FractionalRelaxation
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh

#: Largest number of characters of a label.
MAX_LABEL_LENGTH = 80
#: Relative loss of force by compressibility times K / mu0, 1: bonded compression by 10 mm of a cylinder of radius
#: 40 mm and height 70 mm; computed by the axisymmetric solver with K / mu0 = 1e3 and 1e4.
BONDED_FORCE_LOSS = 1.0


@dataclass(frozen=True)
class ExportContent:
    """Content of an exported file.

    Attributes:
        materials: the calibrated material, then variants such as posterior draws; SI.
        units: unit system of the file.
        constants: constants of each material, for targets with `ExportTarget.uses_elastic_constants`; same length as
            `materials`, otherwise empty.
        remarks: sentences that the file states in comments, such as the force error by depth.
        mesh: mesh of the specimen, for targets that write one.
        material_file: JSON data of the calibrated material file, for targets that can carry them.
    """

    materials: tuple[Material, ...]
    units: UnitSystem = SI
    constants: tuple[ElasticConstants, ...] = ()
    remarks: tuple[str, ...] = ()
    mesh: SolidMesh | None = None
    material_file: Mapping[str, Any] | None = None

    @property
    def labels(self) -> tuple[str, ...]:
        """Label of each material: letters, digits and underscores; variants have the suffix ``_1``, ``_2``, ..."""
        first = make_label(self.materials[0])
        return (first, *(f"{first[:MAX_LABEL_LENGTH - 6]}_{number}" for number in range(1, len(self.materials))))


@dataclass(frozen=True)
class ImportedMaterial:
    """Material that was read from a file of another program.

    Attributes:
        material: the material, SI.
        remarks: sentences on differences between the response in the program and in this package.
    """

    material: Material
    remarks: tuple[str, ...] = ()


class ExportTarget(ABC):
    """Program for which materials are written. A subclass states the attributes and defines `write`.

    A program whose files are imported also defines `split_materials` and `read_material`.

    Attributes:
        title: name of the program for people, with the version to which the format belongs.
        suffix: suffix of the written file.
        verification: how the export is checked: ``"run in the target"`` or ``"formula checked, not run"``.
        uses_elastic_constants: whether the program has Young's modulus, Poisson's ratio and damping only, so that
            `ExportContent.constants` replace the law.
        has_neo_hookean_law: whether the elastic constants are those of a neo-Hookean law, so that they can be fitted
            to a test without the program.
        writes_mesh: whether the file contains `ExportContent.mesh`.
        max_poisson: largest Poisson's ratio of `ExportContent.constants` that the program accepts, 1.
        parts: parts of a material that the program has: ``{"viscoelastic"}`` with a Prony series, otherwise empty.
        softening_forms: forms of softening that the program has, see `tissue_sim.material.softening.Softening`.
        part_remarks: name of a missing part -> the difference between the program and this package, for the message.
        unit_systems: names of the unit systems in which the file can be written.
        incompressible_bulk_ratio: K / mu0 with which an incompressible material is written; infinite for a program with
            incompressible materials.
    """

    title: ClassVar[str]
    suffix: ClassVar[str]
    verification: ClassVar[str] = "formula checked, not run"
    uses_elastic_constants: ClassVar[bool] = False
    has_neo_hookean_law: ClassVar[bool] = False
    writes_mesh: ClassVar[bool] = False
    max_poisson: ClassVar[float] = 0.49
    parts: ClassVar[frozenset[str]] = frozenset()
    softening_forms: ClassVar[frozenset[str]] = frozenset()
    part_remarks: ClassVar[Mapping[str, str]] = {}
    unit_systems: ClassVar[tuple[str, ...]] = tuple(UNIT_SYSTEMS)
    incompressible_bulk_ratio: ClassVar[float] = math.inf

    @abstractmethod
    def write(self, content: ExportContent) -> str:
        """Return the text of the file.

        Raises:
            InputError: the program has no equivalent of a part of a material.
        """

    def split_materials(self, text: str) -> dict[str, Any]:
        """Return name -> section of the file of each material; the sections are not interpreted.

        Args:
            text: text of the file.

        Raises:
            InputError: a file that cannot be read, with the line; or a program whose files cannot be imported.
        """
        raise InputError(f"files of {self.title} cannot be imported. Use a file of Abaqus, CalculiX or FEBio",
                         field="--from")

    def read_material(self, section: Any, units: UnitSystem) -> ImportedMaterial:
        """Return the material of a section of `split_materials`.

        Args:
            section: section of the file.
            units: unit system of the numbers, which the file does not state.

        Raises:
            InputError: a part of the material has no equivalent in this package, with the line.
        """
        raise InputError(f"materials of {self.title} cannot be imported. Use a file of Abaqus, CalculiX or FEBio",
                         field="--from")

    def read(self, text: str, units: UnitSystem) -> tuple[ImportedMaterial, ...]:
        """Return all materials of a file; arguments and errors as in `split_materials` and `read_material`."""
        return tuple(self.read_material(section, units) for section in self.split_materials(text).values())

    def compute_bulk_modulus(self, material: Material) -> float:
        """Return the bulk modulus with which a material is written, Pa; infinite for an incompressible material."""
        is_incompressible = material.bulk.kind == "incompressible"
        return self.incompressible_bulk_ratio * material.mu0 if is_incompressible else material.bulk_modulus

    def list_file_remarks(self, content: ExportContent) -> tuple[str, ...]:
        """Return the remarks of a file: units, remarks of the content, Prony series of a model, finite K."""
        is_replaced = (self.incompressible_bulk_ratio < math.inf
                       and any(material.bulk.kind == "incompressible" for material in content.materials))
        expansions = [FractionalRelaxation.describe_or_none(material.viscoelastic) for material in content.materials
                      if "viscoelastic" in self.parts]
        return (content.units.describe(), *content.remarks, *filter(None, expansions),
                *([describe_finite_bulk_modulus(self.incompressible_bulk_ratio)] if is_replaced else ()))

    def require_available_parts(self, material: Material) -> None:
        """Raise an error if the program has no equivalent of a part of a material.

        Raises:
            InputError: the material has layers, regions, drainage, puncture, further effects, or relaxation or
                softening that are not in `parts` and `softening_forms`.
        """
        named = {"viscoelastic": "relaxation (a Prony series)", "softening": "softening on first load"}
        soft = material.softening
        is_missing = {"viscoelastic": "viscoelastic" not in self.parts and material.viscoelastic is not None,
                      "softening": soft is not None and soft.form not in self.softening_forms}
        missing = {f"{name} ({self.part_remarks[part]})" if part in self.part_remarks else name: is_missing[part]
                   for part, name in named.items()}
        missing |= {"layers in a material": bool(material.layers),
                    "regions in a material (export each by itself)": bool(material.regions),
                    "drainage in this form": material.poroelasticity is not None,
                    "a puncture": material.puncture is not None,
                    f"the effect {next(iter(material.effects), '')!r}": bool(material.effects)}
        for name, is_present in missing.items():
            if is_present:
                raise InputError(f"{self.title} has no form for {name}; remove it from the material", field="to")


class FunctionTarget(ExportTarget):
    """Target of a plug-in that is a function from one material, SI, to the text of a file.

    Args:
        name: name of the target.
        function: function of the plug-in.
    """

    suffix = ""
    verification = "not checked by this package"
    unit_systems = (SI.name,)

    def __init__(self, name: str, function: Callable[[Material], str]):
        self.title = name  # type: ignore[misc]
        self._function = function

    def list_file_remarks(self, content: ExportContent) -> tuple[str, ...]:
        """Return no remarks, because the text is that of the function alone."""
        return ()

    def write(self, content: ExportContent) -> str:
        """Return the texts of the function for all materials."""
        return "".join(self._function(material) for material in content.materials)


def make_label(material: Material) -> str:
    """Return a label of a material: letters, digits and underscores, first a letter, at most 80 characters."""
    label = re.sub(r"\W+", "_", material.name or material.law, flags=re.ASCII).strip("_").upper()[:MAX_LABEL_LENGTH]
    return label if label[:1].isalpha() else f"TISSUE_{label}"[:MAX_LABEL_LENGTH]


def describe_finite_bulk_modulus(ratio: float) -> str:
    """Return a sentence on the force error of a finite ratio K / mu0 in place of an incompressible material.

    The stiffness of free compression is 3 mu0 / (1 + mu0 / (3 K)). The error of bonded compression is proportional
    to mu0 / K.
    """
    return (f"K / mu0 = {ratio:g} replaces an incompressible material. The force is smaller by "
            f"{100.0 / (3.0 * ratio):.2g} % in free compression, and by {100.0 * BONDED_FORCE_LOSS / ratio:.2g} % in "
            "bonded compression of a cylinder of 40 mm radius and 70 mm height.")


def format_comment_lines(remarks: Sequence[str], prefix: str) -> list[str]:
    """Return remarks as comment lines of at most 100 characters with a prefix such as ``"** "``."""
    return [prefix + line for remark in remarks for part in remark.splitlines()
            for line in textwrap.wrap(part, 100)]
