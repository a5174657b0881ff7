"""Bulk modulus of the pressure in mixed elements; negligible for a compressible law."""

from tissue_sim.material.material import Material, compute_finite_bulk_to_shear_ratio

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
    material.require_verified_bulk_ratio()
    if material.bulk.kind == "of_law":
        return NEGLIGIBLE_BULK_RATIO * material.mu0
    ratio = compute_finite_bulk_to_shear_ratio(radius, height) if material.bulk.kind == "incompressible" else \
        material.bulk_modulus / material.mu0
    return ratio * material.mu0
