"""Export of materials as keyword blocks of Abaqus, which CalculiX reads as well.

Source: Abaqus Analysis User's Manual, "Hyperelastic behavior of rubberlike materials" and "Time domain
viscoelasticity". The laws have the convention of the manual; only K is converted, to D1 = 2/K.
"""

from __future__ import annotations

import re

from tissue_sim.errors import InputError
from tissue_sim.exports.target import ExportContent, ExportTarget, format_comment_lines
from tissue_sim.exports.unit_systems import UnitSystem
from tissue_sim.material.material import Material

#: Number of values on a data line.
_PER_LINE = 8
#: D_i, 1/Pa, of an absent volumetric term; CalculiX would replace 0 by a value of its choice.
_ABSENT = 1e20
#: Law -> keyword of a law without order.
_LAWS = {"neo_hooke": "NEO HOOKE", "mooney_rivlin": "MOONEY-RIVLIN"}
#: Law -> order of the full polynomial of (I1 - 3, I2 - 3) as which it is written, with D_i of that number.
_POLYNOMIALS = {"biderman": 3}
#: Law without its order -> keyword.
_SERIES = {"reduced_polynomial": "REDUCED POLYNOMIAL", "ogden": "OGDEN"}


class AbaqusTarget(ExportTarget):
    """Keyword block of Abaqus: ``*MATERIAL`` with ``*HYPERELASTIC``, ``*VISCOELASTIC`` and ``*DENSITY``.

    The hereditary integral of Abaqus acts on the Kirchhoff stress in the current configuration, that of this package on
    the second Piola-Kirchhoff stress: relaxing forces agree to first order in the strain.
    """

    title = "Abaqus"
    suffix = ".inp"
    parts = frozenset({"viscoelastic"})
    part_remarks = {"softening": "its Mullins effect has an error function where ours has tanh"}

    def write(self, content: ExportContent) -> str:
        """Return the keyword blocks of the materials."""
        lines = format_comment_lines(content.remarks, "** ")
        for label, material in zip(content.labels, content.materials, strict=True):
            self.require_available_parts(material)
            lines += _list_material_lines(material, label, content.units)
        return "\n".join(lines) + "\n"


def _list_material_lines(material: Material, label: str, units: UnitSystem) -> list[str]:
    """Return the lines of one material."""
    moduli = "" if material.viscoelastic is None else material.viscoelastic.moduli.upper().replace("_", " ")
    keyword, terms = _get_law_keyword_and_volumetric_count(material.law)
    law = material.energy_law
    factors = [1.0 / units.stress if law.units[name] == "Pa" else 1.0 for name in law.parameters]
    K = material.bulk_modulus / units.stress
    volumetric = [0.0] * terms if material.bulk.kind == "incompressible" else [2.0 / K, *[_ABSENT] * (terms - 1)]
    own = law.kernel_coefficients(material.values) / units.stress if law.name in _POLYNOMIALS else (
        material.values * factors)
    numbers = [*own, *volumetric]
    lines = [f"*MATERIAL, NAME={label}",
             f"*HYPERELASTIC, {keyword}{moduli and f', MODULI={moduli}'}"]
    lines += [", ".join(f"{number:.15g}" for number in numbers[i:i + _PER_LINE])
              for i in range(0, len(numbers), _PER_LINE)]
    if material.viscoelastic is not None:
        lines.append("*VISCOELASTIC, TIME=PRONY")
        lines += [f"{term.g:.15g}, 0, {term.tau:.15g}" for term in material.viscoelastic.terms]
    if material.density is not None:
        lines += ["*DENSITY", f"{material.density / units.density:.15g}"]
    return lines


def _get_law_keyword_and_volumetric_count(name: str) -> tuple[str, int]:
    """Return the options of the keyword *HYPERELASTIC for a law, and the number of volumetric terms."""
    if name in _POLYNOMIALS:
        return f"POLYNOMIAL, N={_POLYNOMIALS[name]}", _POLYNOMIALS[name]
    series = re.fullmatch(r"(\w+?)_(\d+)", name)
    if name in _LAWS:
        return _LAWS[name], 1
    if series and series[1] in _SERIES:
        return f"{_SERIES[series[1]]}, N={series[2]}", int(series[2])
    raise InputError(f"Abaqus has no keyword for the law {name!r}; write a user subroutine", field="to")


ABAQUS = AbaqusTarget()
