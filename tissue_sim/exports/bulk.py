"""Finite bulk moduli of incompressible materials for programs whose elements need one."""

from __future__ import annotations

import math

from tissue_sim.material.material import Material


def make_finite_bulk_modulus(material: Material, ratio: float) -> float:
    """Return the bulk modulus K of a material, Pa; `ratio` times the initial shear modulus if it is infinite."""
    return ratio * material.mu0 if math.isinf(material.bulk_modulus) else material.bulk_modulus


def describe_finite_bulk_modulus(material: Material, ratio: float) -> tuple[str, ...]:
    """Return a sentence about the replaced bulk modulus of an incompressible material; none for another material."""
    if not math.isinf(material.bulk_modulus):
        return ()
    return (f"The calibrated material is incompressible. This file has the finite bulk modulus K = {ratio:g} mu0.",)
