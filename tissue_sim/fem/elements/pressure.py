"""Bulk modulus of the pressure in mixed elements; negligible for a compressible law."""

import math

from tissue_sim.errors import InputError
from tissue_sim.material.material import BULK_RATIOS, Material, compute_finite_bulk_to_shear_ratio

#: Largest K / mu0 of a compressible law in the finite elements, 1: a Poisson's ratio of 0.45. Displacement elements
#: become too stiff above it.
LARGEST_BULK_RATIO_OF_COMPRESSIBLE_LAW = 10.0
#: Modulus of the pressure of the mixed elements over mu0 for a compressible law, 1. The pressure is then negligible, so
#: that the elements are displacement elements.
NEGLIGIBLE_BULK_RATIO = 1e-12


def compute_element_bulk_modulus(material: Material, radius: float, height: float) -> float:
    """Return the bulk modulus, Pa, of the pressure in the mixed elements.

    An incompressible material gets a finite one that suits the specimen. A compressible law gets a negligible one: the
    law states the volumetric response.

    Args:
        material: the material.
        radius: radius of the specimen, m.
        height: height of the specimen, m.

    Raises:
        InputError: a ratio K / mu0 for which the finite elements are not verified.
    """
    ratio = material.bulk_modulus / material.mu0
    if material.bulk.kind == "of_law":
        if ratio > LARGEST_BULK_RATIO_OF_COMPRESSIBLE_LAW:
            raise InputError(f"must give K/mu0 of at most {LARGEST_BULK_RATIO_OF_COMPRESSIBLE_LAW:g} in displacement "
                             f"elements; got {ratio:.4g} with {material.law}. Use a law with a bulk response",
                             field="parameters")
        return NEGLIGIBLE_BULK_RATIO * material.mu0
    if math.isinf(ratio):
        ratio = compute_finite_bulk_to_shear_ratio(radius, height)
    low, high = BULK_RATIOS
    if not low <= ratio <= high:
        raise InputError(f"K/mu0 must be {low:g} to {high:g}, for which the finite elements are verified; got "
                         f"{ratio:g}.", field="bulk")
    return ratio * material.mu0
