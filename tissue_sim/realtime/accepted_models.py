"""Checks of experiments and materials for real-time simulation."""

from __future__ import annotations

from dataclasses import dataclass

from tissue_sim.errors import InputError
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.material.material import Material
from tissue_sim.parameters import parameters


@dataclass(frozen=True)
class AcceptedModulusRange:
    """Moduli that a real-time simulation accepts.

    Attributes:
        smallest: smallest shear modulus, Pa; softer than any gel.
        largest: largest modulus, Pa; stiffer than any tissue.
    """

    smallest: float = 1e-2
    largest: float = 1e9


#: Range of every real-time simulation.
MODULI = AcceptedModulusRange()


def require_no_tilt_or_partial_slip(experiment: Experiment) -> None:
    """Require an experiment without tilt and partial slip, which are corrections of whole recordings.

    Raises:
        InputError: a tilted tool, or partial slip.
    """
    if experiment.tilt:
        raise InputError("must be 0 in real time: the effect of a tilt is a correction of whole recordings. Leave the "
                         "tilt out", field="tilt")
    if experiment.slip:
        raise InputError("must be 0 in real time: partial slip is a correction of whole recordings. Leave the slip "
                         "out, or use a coefficient of friction", field="slip")


def require_moduli_in_range(material: Material) -> None:
    """Check that the moduli of a material are in the range of tissues and gels.

    Raises:
        InputError: a modulus above `AcceptedModulusRange.largest`, or a shear modulus below
            `AcceptedModulusRange.smallest`.
    """
    for each in parameters(material).values():
        if each.declaration.unit == "Pa" and not abs(each.value) <= MODULI.largest:
            raise InputError(f"must be at most {MODULI.largest:g} Pa; got {each.value:g} Pa.",
                             field=each.path)
    if not MODULI.smallest <= material.mu0 <= MODULI.largest:
        raise InputError(f"must give a shear modulus of {MODULI.smallest:g} to {MODULI.largest:g} Pa; got "
                         f"{material.mu0:g} Pa.",
                         field="parameters")


def require_equal_layer_thicknesses(before: Material, after: Material) -> None:
    """Check that two materials have layers of the same thickness, on which the mesh depends.

    Raises:
        InputError: other layers.
    """
    thick = [[layer.thickness for layer in material.layers] for material in (before, after)]
    if thick[0] != thick[1]:
        raise InputError("must keep the thickness of the layers, which is part of the mesh; make another simulator",
                         field="layers")
