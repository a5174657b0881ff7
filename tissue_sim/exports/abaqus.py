"""Keyword blocks of Abaqus: materials are written and read.

Source: Abaqus Analysis User's Guide, "Hyperelastic behavior of rubberlike materials", "Time domain viscoelasticity" and
"Mullins effect"; Keywords Reference Guide, ``*HYPERELASTIC``, ``*VISCOELASTIC``, ``*MULLINS EFFECT``, ``*DENSITY``.
The laws have the convention of the guide; only K is converted, to D1 = 2/K. ``*MULLINS EFFECT`` is softening
of the form erf.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from tissue_sim.errors import InputError
from tissue_sim.exports.foams import is_foam, list_foam_lines, read_foam
from tissue_sim.exports.keyword_materials import MaterialSection, parse_data_rows, require_options, split_into_sections
from tissue_sim.exports.target import ExportContent, ExportTarget, ImportedMaterial, format_comment_lines
from tissue_sim.exports.unit_systems import UnitSystem
from tissue_sim.laws import find_law
from tissue_sim.material.material import Bulk, Material
from tissue_sim.material.softening import Softening
from tissue_sim.material.viscoelasticity import Prony, PronyTerm
from tissue_sim.mesh.formats.keyword_blocks import KeywordBlock

#: Number of values on a data line.
VALUES_PER_LINE = 8
#: D_i, 1/Pa, of an absent volumetric term; CalculiX would replace 0 by a value of its choice.
_ABSENT = 1e20
#: Largest ratio D1 / D_i of a volumetric term (J - 1)^(2i) that is treated as absent, 1.
_NEGLIGIBLE = 1e-12
#: Coefficients of the full polynomial of (I1 - 3, I2 - 3) to third order, in the order of the data.
_POLYNOMIAL = ("C10", "C01", "C20", "C11", "C02", "C30", "C21", "C12", "C03")


@dataclass(frozen=True)
class HyperelasticForm:
    """Form of the strain energy on the keyword ``*HYPERELASTIC``.

    Attributes:
        keyword: option that names the form.
        law: law of this package.
        coefficients: names of the coefficients in the order of the data, followed by `terms` numbers D_i.
        terms: number of volumetric terms (J - 1)^(2i) / D_i.
        order: value of the option N; None for a form without it.
    """

    keyword: str
    law: str
    coefficients: tuple[str, ...]
    terms: int = 1
    order: int | None = None

    @property
    def options(self) -> str:
        """Options of the keyword, such as ``"OGDEN, N=2"``."""
        return self.keyword if self.order is None else f"{self.keyword}, N={self.order}"

    @property
    def value_count(self) -> int:
        """Number of values of the data."""
        return len(self.coefficients) + self.terms


def _list_series_forms() -> list[HyperelasticForm]:
    """Return the forms with an order: the reduced polynomial from 1 to 3, Ogden's law from 1 to 4."""
    reduced = [HyperelasticForm("REDUCED POLYNOMIAL", f"reduced_polynomial_{n}", ("C10", "C20", "C30")[:n], n, n)
               for n in (1, 2, 3)]
    ogden = [HyperelasticForm("OGDEN", f"ogden_{n}", find_law(f"ogden_{n}").parameters, n, n)
             for n in (1, 2, 3, 4)]
    return [*reduced, *ogden]


#: Forms that are written, one for each law.
_WRITTEN = {form.law: form for form in (
    HyperelasticForm("NEO HOOKE", "neo_hooke", ("C10",)),
    HyperelasticForm("MOONEY-RIVLIN", "mooney_rivlin", ("C10", "C01")),
    HyperelasticForm("ARRUDA-BOYCE", "arruda_boyce", find_law("arruda_boyce").parameters),
    *_list_series_forms(),
    HyperelasticForm("POLYNOMIAL", "biderman", _POLYNOMIAL, 3, 3))}
#: Forms that are read: (option without blanks, order) -> form.
_READ = {(form.keyword.replace(" ", ""), form.order): form for form in (
    *_WRITTEN.values(),
    HyperelasticForm("YEOH", "reduced_polynomial_3", ("C10", "C20", "C30"), 3),
    HyperelasticForm("POLYNOMIAL", "mooney_rivlin", _POLYNOMIAL[:2], 1, 1),
    HyperelasticForm("POLYNOMIAL", "biderman", _POLYNOMIAL[:5], 2, 2))}
#: Difference of the relaxation in Abaqus from that in this package.
_RELAXATION_REMARK = ("Abaqus relaxes the Kirchhoff stress in the current configuration, tissue_sim the second "
                      "Piola-Kirchhoff stress. Relaxing forces agree to first order in the strain.")
#: Difference of the volumetric energy of the form ARRUDA-BOYCE.
_ARRUDA_BOYCE_REMARK = ("U(J) of ARRUDA-BOYCE is K/2 ((J^2 - 1)/2 - ln J), that of tissue_sim K/2 (J - 1)^2. The "
                        "pressures differ by a fraction of 0.5 |J - 1|.")
#: Reason why softening with relaxation is neither written nor read.
_MULLINS_AND_RELAXATION = ("a material must not have both relaxation and softening, because *MULLINS EFFECT of Abaqus "
                           "acts on the long-term stress and the softening of tissue_sim on the whole stress. Remove "
                           "one of them")
#: Value of the option MODULI without blanks -> moduli of `Prony`.
_MODULI = {"INSTANTANEOUS": "instantaneous", "LONGTERM": "long_term"}


class AbaqusTarget(ExportTarget):
    """Keyword block of Abaqus: ``*MATERIAL`` with its elasticity, relaxation, softening and density.

    Laws of compressible foams are ``*HYPERFOAM``, see `tissue_sim.exports.foams`.

    The hereditary integral of Abaqus acts on the Kirchhoff stress in the current configuration, that of this package on
    the second Piola-Kirchhoff stress: relaxing forces agree to first order in the strain.

    Attributes:
        laws: laws that have a form.
        fewest_foam_terms: smallest order N of ``*HYPERFOAM``.
        hyperelastic_options: options of ``*HYPERELASTIC`` besides the form and its order.
        readable_keywords: keywords of a material that are read.
    """

    title = "Abaqus"
    suffix = ".inp"
    parts = frozenset({"viscoelastic"})
    laws: ClassVar[frozenset[str]] = frozenset(_WRITTEN)
    fewest_foam_terms: ClassVar[int] = 1
    softening_forms = frozenset({"erf"})
    part_remarks = {"softening": "its Mullins effect is the form 'erf', an error function in place of tanh"}
    hyperelastic_options: ClassVar[frozenset[str]] = frozenset({"MODULI"})
    readable_keywords: ClassVar[tuple[str, ...]] = ("HYPERELASTIC", "HYPERFOAM", "VISCOELASTIC", "MULLINS EFFECT",
                                                   "DENSITY")

    def write(self, content: ExportContent) -> str:
        """Return the keyword blocks of the materials."""
        lines = format_comment_lines(self.list_file_remarks(content), "** ")
        for label, material in zip(content.labels, content.materials, strict=True):
            self.require_available_parts(material)
            lines += self._list_material_lines(material, label, content.units)
        return "\n".join(lines) + "\n"

    def list_file_remarks(self, content: ExportContent) -> tuple[str, ...]:
        """Return the remarks of a file, with the differences of relaxation and volumetric energy."""
        is_relaxing = any(material.viscoelastic is not None for material in content.materials)
        has_chains = any(material.law == "arruda_boyce" for material in content.materials)
        return (*super().list_file_remarks(content), *([_RELAXATION_REMARK] if is_relaxing else ()),
                *([_ARRUDA_BOYCE_REMARK] if has_chains else ()))

    def _list_material_lines(self, material: Material, label: str, units: UnitSystem) -> list[str]:
        """Return the lines of one material."""
        if is_foam(material.energy_law):
            return [f"*MATERIAL, NAME={label}",
                    *list_foam_lines(material, units, self.fewest_foam_terms, _format_value),
                    *self._list_density_lines(material, units)]
        if material.law not in self.laws:
            raise InputError(f"{self.title} has no keyword for the law {material.law!r}; fit another law, or write a "
                             "user subroutine", field="to")
        form, law = _WRITTEN[material.law], material.energy_law
        values = {name: value / (units.stress if law.units[name] == "Pa" else 1.0)
                  for name, value in zip(law.parameters, material.values, strict=True)}
        numbers = [*(values.get(name, 0.0) for name in form.coefficients),
                   *self.list_volumetric_values(material, form.terms, units)]
        moduli = "" if material.viscoelastic is None else material.viscoelastic.moduli.upper().replace("_", " ")
        lines = [f"*MATERIAL, NAME={label}", f"*HYPERELASTIC, {form.options}{moduli and f', MODULI={moduli}'}"]
        lines += [", ".join(map(_format_value, numbers[i:i + VALUES_PER_LINE]))
                  for i in range(0, len(numbers), VALUES_PER_LINE)]
        if material.viscoelastic is not None:
            lines.append("*VISCOELASTIC, TIME=PRONY")
            lines += [f"{_format_value(term.g)}, 0, {_format_value(term.tau)}" for term in material.viscoelastic.terms]
        soft = material.softening
        if soft is not None and soft.loss > 0.0:
            if material.viscoelastic is not None:
                raise InputError(_MULLINS_AND_RELAXATION, field="to")
            lines += ["*MULLINS EFFECT",
                      ", ".join(map(_format_value, (1.0 / soft.loss, soft.modulus / units.stress, soft.share)))]
        return [*lines, *self._list_density_lines(material, units)]

    @staticmethod
    def _list_density_lines(material: Material, units: UnitSystem) -> list[str]:
        """Return the lines of the density; none if the material has no density."""
        return [] if material.density is None else ["*DENSITY", _format_value(material.density / units.density)]

    def list_volumetric_values(self, material: Material, terms: int, units: UnitSystem) -> list[float]:
        """Return D_1 = 2/K and the values of the absent terms D_2, ..., in the units of the file.

        An incompressible material has D_i = 0.
        """
        K = self.compute_bulk_modulus(material) / units.stress
        return [0.0] * terms if 2.0 / K == 0.0 else [2.0 / K, *[_ABSENT] * (terms - 1)]

    def split_materials(self, text: str) -> dict[str, MaterialSection]:
        """Return name -> keywords of each material."""
        return split_into_sections(text, f"a material of {self.title}")

    def read_material(self, section: MaterialSection, units: UnitSystem) -> ImportedMaterial:
        """Return the material of a section."""
        blocks = section.index_blocks_by_name(self.readable_keywords, self.title)
        if "HYPERFOAM" in blocks:
            return ImportedMaterial(self._read_foam_material(section, blocks, units))
        if "HYPERELASTIC" not in blocks:
            raise InputError(f"material {section.name} has no keyword *HYPERELASTIC. Choose another material",
                             line=section.line)
        hyperelastic = blocks["HYPERELASTIC"]
        form = self._find_form(hyperelastic)
        values, D = self._read_coefficients(form, hyperelastic)
        law = find_law(form.law)
        relaxation = self._read_relaxation(blocks["VISCOELASTIC"], hyperelastic) if "VISCOELASTIC" in blocks else None
        remarks = [] if relaxation is None else [f"{section.name}: {_RELAXATION_REMARK}"]
        if law.name == "arruda_boyce":
            remarks.append(f"{section.name}: {_ARRUDA_BOYCE_REMARK}")
        # CalculiX uses mu of the Arruda-Boyce law as its initial shear modulus.
        used = self.replace_absent_volumetric_values(D, values["mu"] if law.name == "arruda_boyce"
                                                     else law.mu0(values))
        soft = self._read_softening(blocks["MULLINS EFFECT"], units) if "MULLINS EFFECT" in blocks else None
        if soft is not None and relaxation is not None:
            raise InputError(_MULLINS_AND_RELAXATION, line=blocks["MULLINS EFFECT"].line)
        if used != D:
            remarks.append(f"{section.name}: {self.title} replaces D_i = {', '.join(f'{d:g}' for d in D)} by "
                           f"{', '.join(f'{d:g}' for d in used)}; the material has these values.")
        try:
            material = Material(
                law.name, {name: value * (units.stress if law.units[name] == "Pa" else 1.0)
                           for name, value in values.items()},
                _make_bulk(used, hyperelastic, units), self._read_density(blocks.get("DENSITY"), units), section.name,
                viscoelastic=relaxation, softening=soft)
        except InputError as error:
            raise InputError(error.problem, line=error.line or hyperelastic.line, field=error.field) from None
        return ImportedMaterial(material, tuple(remarks))

    def _read_foam_material(self, section: MaterialSection, blocks: Mapping[str, KeywordBlock],
                            units: UnitSystem) -> Material:
        """Return the material of a section with the keyword ``*HYPERFOAM``."""
        if others := [name for name in blocks if name not in ("HYPERFOAM", "DENSITY")]:
            raise InputError(f"*{others[0]} with *HYPERFOAM cannot be imported, because a compressible law here is "
                             "elastic. Delete it", line=blocks[others[0]].line)
        block = blocks["HYPERFOAM"]
        law, values = read_foam(block, units, self.fewest_foam_terms, sorted(self.hyperelastic_options), self.title)
        try:
            return Material(law.name, values, density=self._read_density(blocks.get("DENSITY"), units),
                            name=section.name)
        except InputError as error:
            raise InputError(error.problem, line=error.line or block.line, field=error.field) from None

    def replace_absent_volumetric_values(self, D: Sequence[float], mu0: float) -> Sequence[float]:
        """Return the numbers D_i with which the program computes, in the units of the file.

        Args:
            D: numbers of the file.
            mu0: value that the program uses as the initial shear modulus, in the units of the file.
        """
        return D

    def _find_form(self, block: KeywordBlock) -> HyperelasticForm:
        """Return the form that a keyword ``*HYPERELASTIC`` states."""
        options = {name.replace(" ", ""): value for name, value in block.options.items()}
        readable = {key: form for key, form in _READ.items() if form.law in self.laws}
        keywords = {keyword for keyword, _ in readable} & set(options)
        require_options(block, {"N", *self.hyperelastic_options, *keywords})
        if len(keywords) != 1:
            raise InputError("*HYPERELASTIC must name one form of the energy: NEO HOOKE, MOONEY-RIVLIN, ARRUDA-BOYCE, "
                             "YEOH, REDUCED POLYNOMIAL, POLYNOMIAL or OGDEN; got "
                             f"{', '.join(sorted(keywords)) or 'none'}.", line=block.line)
        keyword = next(iter(keywords))
        stated = options.get("N")
        if (keyword, None) in readable and stated is None:
            return readable[keyword, None]
        order = int(stated or 1) if re.fullmatch(r"\d{1,3}|", stated or "", re.ASCII) else 0
        if (keyword, order) not in readable:
            orders = ", ".join(str(order) for name, order in readable if name == keyword and order is not None)
            raise InputError(f"the order N of {keyword} must be {f'one of {orders}' if orders else 'absent'}; got "
                             f"{stated!r}.", line=block.line)
        return readable[keyword, order]

    def _read_coefficients(self, form: HyperelasticForm, block: KeywordBlock
                           ) -> tuple[dict[str, float], list[float]]:
        """Return the parameters of the law, and the numbers D_i, in the units of the file."""
        counts = [min(VALUES_PER_LINE, form.value_count - i) for i in range(0, form.value_count, VALUES_PER_LINE)]
        numbers = [number for row in parse_data_rows(block, counts) for number in row]
        values = dict(zip(form.coefficients, numbers, strict=False))
        names = find_law(form.law).parameters
        for name in form.coefficients:
            if name not in names and values[name] != 0.0:
                raise InputError(f"{name} must be 0, because the law {form.law} has no such coefficient; got "
                                 f"{values[name]:g}.", line=block.line)
        return {name: values.get(name, 0.0) for name in names}, numbers[len(form.coefficients):]

    def _read_relaxation(self, block: KeywordBlock, hyperelastic: KeywordBlock) -> Prony | None:
        """Return the Prony series of a keyword ``*VISCOELASTIC``; None if all its terms are 0."""
        require_options(block, {"TIME"})
        if block.options.get("TIME", "").upper() != "PRONY":
            raise InputError(f"*VISCOELASTIC must have TIME=PRONY; got TIME={block.options.get('TIME')!r}.",
                             line=block.line)
        stated = hyperelastic.options.get("MODULI", "LONG TERM").upper().replace(" ", "")
        if stated not in _MODULI:
            raise InputError(f"MODULI must be INSTANTANEOUS or LONG TERM; got {stated!r}.", line=hyperelastic.line)
        terms = []
        for (g, k, tau), line in zip(parse_data_rows(block, [3] * len(block.rows)), block.row_lines, strict=True):
            if k != 0.0:
                raise InputError(f"the relaxing fraction of the bulk modulus must be 0; got {k:g}.", line=line)
            if g != 0.0:
                try:
                    terms.append(PronyTerm(g, tau))
                except InputError as error:
                    raise InputError(error.problem, line=line, field=error.field) from None
        return Prony(tuple(terms), _MODULI[stated]) if terms else None  # type: ignore[arg-type]

    def _read_softening(self, block: KeywordBlock, units: UnitSystem) -> Softening:
        """Return the softening of a keyword ``*MULLINS EFFECT`` with the numbers R, M and BETA."""
        require_options(block, set())
        [[r, m, beta]] = parse_data_rows(block, [3])
        if not r > 1.0:
            raise InputError(f"R must be above 1; got {r:g}.", line=block.row_lines[0])
        try:
            return Softening(1.0 / r, m * units.stress, beta, "erf")
        except InputError as error:
            raise InputError(error.problem, line=block.row_lines[0], field=error.field) from None

    def _read_density(self, block: KeywordBlock | None, units: UnitSystem) -> float | None:
        """Return the density of a keyword ``*DENSITY``, kg/m3; None without the keyword."""
        if block is None:
            return None
        require_options(block, set())
        [[density]] = parse_data_rows(block, [1])
        return density * units.density


def _format_value(value: float) -> str:
    """Return a number with 14 digits, which has at most the 20 characters that CalculiX reads."""
    return f"{value:.14g}"


def _make_bulk(D: Sequence[float], block: KeywordBlock, units: UnitSystem) -> Bulk:
    """Return the bulk response of numbers D_i in the units of a file.

    Raises:
        InputError: a negative number, or a term of higher order.
    """
    first, *others = D
    if not any(D):
        return Bulk()
    if not (first > 0.0 and 0.0 < 2.0 / first < math.inf):
        raise InputError(f"D1 must be positive, or 0 with all other D; got {first:g}.", line=block.line)
    for number, value in enumerate(others, start=2):
        if value != 0.0 and not first <= _NEGLIGIBLE * value:
            raise InputError(f"D{number} must be absent, 0 in Abaqus or 1e20 in CalculiX, because the volumetric "
                             f"energy of this package is K/2 (J - 1)^2; got {value:g}.", line=block.line)
    return Bulk("D1_per_Pa", first / units.stress)


ABAQUS = AbaqusTarget()
