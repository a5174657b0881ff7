"""What a simulation that is felt takes for a material, and what may change while it runs."""

from __future__ import annotations

from tissue_sim.errors import InputError
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.material.material import Material
from tissue_sim.parameters import parameters

#: Moduli, Pa, that are stepped: softer than any gel, stiffer than any tissue.
SOFTEST, STIFFEST = 1e-2, 1e9


def require_live(experiment: Experiment) -> None:
    """Refuse what is a correction of whole recordings.

    Raises:
        InputError: a tool that leans, or slips in part.
    """
    if experiment.tilt:
        raise InputError("a tilted tool is a correction of whole recordings and has no place in real time; leave "
                         "the tilt out", field="tilt")
    if experiment.slip:
        raise InputError("a face that slips in part is a correction of whole recordings and has no place in real "
                         "time; leave the slip out, or use a coefficient of friction", field="slip")


def require_tissue(material: Material) -> None:
    """Raises InputError: no tissue is so stiff, or so soft."""
    for each in parameters(material).values():
        if each.declaration.unit == "Pa" and not abs(each.value) <= STIFFEST:
            raise InputError(f"{each.value:g} Pa is stiffer than any tissue; give {STIFFEST:g} Pa or less",
                             field=each.path)
    if not SOFTEST <= material.mu0 <= STIFFEST:
        raise InputError(f"a shear modulus of {material.mu0:g} Pa is none of tissue; give parameters that make it "
                         f"{SOFTEST:g} to {STIFFEST:g} Pa", field="parameters")


def require_same_layers(before: Material, after: Material) -> None:
    """Raises InputError: the mesh would have to change."""
    thick = [[layer.thickness for layer in material.layers] for material in (before, after)]
    if thick[0] != thick[1]:
        raise InputError("the thickness of a layer is part of the mesh; build another simulator", field="layers")
