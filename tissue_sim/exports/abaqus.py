"""Export of materials as keyword blocks of Abaqus, which CalculiX reads as well.

Source: Abaqus Analysis User's Manual, "Hyperelastic behavior of rubberlike materials" and "Time domain
viscoelasticity". The laws have the convention of the manual; only K is converted, to D1 = 2/K.
"""

from __future__ import annotations

import re

from tissue_sim.errors import InputError
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


def export(material: Material) -> str:
    """Write a material as ``*MATERIAL`` with ``*HYPERELASTIC``, ``*VISCOELASTIC`` and ``*DENSITY``, SI.

    The hereditary integral of Abaqus acts on the Kirchhoff stress in the current configuration, that of this package on
    the second Piola-Kirchhoff stress: relaxing forces agree to first order in the strain.

    Raises:
        InputError: a law or another part of the material has no equivalent in Abaqus.
    """
    for what, part in (("softening on first load (its Mullins effect has an error function where ours has tanh)",
                        material.softening), ("layers in a material", material.layers),
                       ("regions in a material (export each by itself)", material.regions),
                       ("drainage in this form", material.poroelasticity), ("a puncture", material.puncture),
                       (f"the effect {next(iter(material.effects), '')!r}", material.effects)):
        if part:
            raise InputError(f"Abaqus has no form for {what}; remove it from the material", field="to")
    moduli = "" if material.viscoelastic is None else material.viscoelastic.moduli.upper().replace("_", " ")
    keyword, terms = _get_law_keyword_and_volumetric_count(material.law)
    K = material.bulk_modulus
    volumetric = [0.0] * terms if material.bulk.kind == "incompressible" else [2.0 / K, *[_ABSENT] * (terms - 1)]
    law = material.energy_law
    own = law.kernel_coefficients(material.values) if law.name in _POLYNOMIALS else material.values
    numbers = [*own, *volumetric]
    lines = [f"*MATERIAL, NAME={_make_abaqus_label(material)}",
             f"*HYPERELASTIC, {keyword}{moduli and f', MODULI={moduli}'}"]
    lines += [", ".join(f"{number:.12g}" for number in numbers[i:i + _PER_LINE])
              for i in range(0, len(numbers), _PER_LINE)]
    if material.viscoelastic is not None:
        lines.append("*VISCOELASTIC, TIME=PRONY")
        lines += [f"{term.g:.12g}, 0, {term.tau:.12g}" for term in material.viscoelastic.terms]
    if material.density is not None:
        lines += ["*DENSITY", f"{material.density:.12g}"]
    return "\n".join(lines) + "\n"


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


def _make_abaqus_label(material: Material) -> str:
    """Convert a name to a label for Abaqus: letters, digits and underscores, first a letter, at most 80 characters."""
    label = re.sub(r"\W+", "_", material.name or material.law, flags=re.ASCII).strip("_").upper()[:80]
    return label if label[:1].isalpha() else f"TISSUE_{label}"[:80]
