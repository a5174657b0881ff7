"""Strain-energy laws: each states one energy formula, from which stresses, moduli and kernels are derived.

To add a law, write its class in a file of this folder and add one line to `LAWS` (see CONTRIBUTING.md). A package adds
a law by an entry point of the group ``tissue_sim.laws``, a program by `register_law`.
"""

from tissue_sim.laws.arruda_boyce import ArrudaBoyce
from tissue_sim.laws.compressible import CompressibleLaw
from tissue_sim.laws.fung_demiray import FungDemiray
from tissue_sim.laws.gent import Gent
from tissue_sim.laws.hyperfoam import Hyperfoam
from tissue_sim.laws.law import InvariantLaw, KernelEnergy, Law, ParameterRange, StretchLaw
from tissue_sim.laws.ogden import Ogden
from tissue_sim.laws.polynomials import Biderman, MooneyRivlin, NeoHooke, ReducedPolynomial
from tissue_sim.laws.stability import StabilityRange, find_stability_range
from tissue_sim.public_names import make_getattr_for_old_names
from tissue_sim.registry import Registry

__getattr__ = make_getattr_for_old_names(__name__, {"Stability": "StabilityRange",
                                                    "register": "register_law",
                                                    "check_stability": "find_stability_range"})

#: Name -> law; an alias finds a law by another name.
LAWS: Registry[Law] = Registry("law", "tissue_sim.laws", {law.name: law for law in (
    NeoHooke(),
    MooneyRivlin(),
    ReducedPolynomial(1), ReducedPolynomial(2), ReducedPolynomial(3),
    Biderman(),
    Gent(),
    ArrudaBoyce(),
    FungDemiray(),
    Ogden(1), Ogden(2), Ogden(3), Ogden(4),
    Hyperfoam(1), Hyperfoam(2), Hyperfoam(3),
)}, accepts=lambda law: isinstance(law, Law),
    expected="an object of a class derived from InvariantLaw, StretchLaw or CompressibleLaw",
    aliases={"yeoh": "reduced_polynomial_3", "hyperfoam": "hyperfoam_1"})


def register_law(law: Law) -> Law:
    """Register a law, so that files and campaigns can name it, and return it.

    Raises:
        InputError: another law has the same name.
    """
    return LAWS.register(law)


def find_law(name: str) -> Law:
    """Return the law with a name or an alias.

    Raises:
        InputError: no law has the name; the message names the nearest.

    Examples:
        >>> find_law("neo_hooke").formula()
        'W = C10*(I1 - 3)'
    """
    return LAWS.find(name, "law")


__all__ = [
    "LAWS",
    "CompressibleLaw",
    "InvariantLaw",
    "KernelEnergy",
    "Law",
    "ParameterRange",
    "StabilityRange",
    "StretchLaw",
    "find_law",
    "find_stability_range",
    "register_law",
]
