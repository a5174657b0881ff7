"""Materials as keyword blocks of Abaqus, which CalculiX reads, too.

Source: Abaqus Analysis User's Manual, "Hyperelastic behavior of rubberlike materials" and "Time domain
viscoelasticity"; the convention of the laws is that of the manual, so that no number is converted but K, to D1 = 2/K.
"""

from __future__ import annotations

import re

from tissue_sim.errors import InputError
from tissue_sim.material.material import Material

#: Numbers on a data line.
_PER_LINE = 8
#: D_i, 1/Pa, of a volumetric term that is not there; CalculiX takes 0 for a number that it has to choose.
_ABSENT = 1e20
_LAWS = {"neo_hooke": "NEO HOOKE", "mooney_rivlin": "MOONEY-RIVLIN"}
#: Laws that are written as the full polynomial of (I1 - 3, I2 - 3), with as many D_i as its order.
_POLYNOMIALS = {"biderman": 3}
_SERIES = {"reduced_polynomial": "REDUCED POLYNOMIAL", "ogden": "OGDEN"}


def export(material: Material) -> str:
    """The material as ``*MATERIAL`` with its ``*HYPERELASTIC``, ``*VISCOELASTIC`` and ``*DENSITY``, SI.

    Abaqus' hereditary integral acts on the Kirchhoff stress in the current configuration, ours on the second
    Piola-Kirchhoff stress: relaxing forces agree to the first order of the strain.

    Raises:
        InputError: a law, or something beside it, that Abaqus has no form for.
    """
    for what, part in (("softening on first load (its Mullins effect has an error function where ours has tanh)",
                        material.softening), ("layers in a material", material.layers),
                       ("regions in a material (export each by itself)", material.regions),
                       ("drainage in this form", material.poroelasticity), ("a puncture", material.puncture),
                       (f"the effect {next(iter(material.effects), '')!r}", material.effects)):
        if part:
            raise InputError(f"Abaqus has no form for {what}; take it out of the material", field="to")
    moduli = "" if material.viscoelastic is None else material.viscoelastic.moduli.upper().replace("_", " ")
    keyword, terms = _law(material.law)
    K = material.bulk_modulus
    volumetric = [0.0] * terms if material.bulk.kind == "incompressible" else [2.0 / K, *[_ABSENT] * (terms - 1)]
    law = material.energy_law
    own = law.kernel_coefficients(material.values) if law.name in _POLYNOMIALS else material.values
    numbers = [*own, *volumetric]
    lines = [f"*MATERIAL, NAME={_name(material)}", f"*HYPERELASTIC, {keyword}{moduli and f', MODULI={moduli}'}"]
    lines += [", ".join(f"{number:.12g}" for number in numbers[i:i + _PER_LINE])
              for i in range(0, len(numbers), _PER_LINE)]
    if material.viscoelastic is not None:
        lines.append("*VISCOELASTIC, TIME=PRONY")
        lines += [f"{term.g:.12g}, 0, {term.tau:.12g}" for term in material.viscoelastic.terms]
    if material.density is not None:
        lines += ["*DENSITY", f"{material.density:.12g}"]
    return "\n".join(lines) + "\n"


def _law(name: str) -> tuple[str, int]:
    """Words of the keyword, and the number of terms."""
    if name in _POLYNOMIALS:
        return f"POLYNOMIAL, N={_POLYNOMIALS[name]}", _POLYNOMIALS[name]
    series = re.fullmatch(r"(\w+?)_(\d+)", name)
    if name in _LAWS:
        return _LAWS[name], 1
    if series and series[1] in _SERIES:
        return f"{_SERIES[series[1]]}, N={series[2]}", int(series[2])
    raise InputError(f"Abaqus has no law like {name!r} among its keywords; write a user subroutine", field="to")


def _name(material: Material) -> str:
    """A label of Abaqus: letters, digits and underscores, a letter first, at most 80."""
    label = re.sub(r"\W+", "_", material.name or material.law, flags=re.ASCII).strip("_").upper()[:80]
    return label if label[:1].isalpha() else f"TISSUE_{label}"[:80]
