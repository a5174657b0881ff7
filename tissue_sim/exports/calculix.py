"""Keyword blocks of CalculiX: the hyperelastic forms of Abaqus with a finite bulk modulus, without relaxation.

Source: CalculiX CrunchiX User's Manual, ``*HYPERELASTIC``; ``hyperelastics.f`` and ``rubber.f`` of version 2.20.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.exports.abaqus import AbaqusTarget
from tissue_sim.exports.unit_systems import UnitSystem
from tissue_sim.material.material import Material

#: D_i of smaller absolute value are replaced by (0.1 / mu0)^i, in the units of the file (``hyperelastics.f``).
_SMALLEST_D = 1e-10


class CalculixTarget(AbaqusTarget):
    """Keyword block of CalculiX: ``*MATERIAL`` with ``*HYPERELASTIC`` and ``*DENSITY``.

    CalculiX has no incompressible materials: it replaces D_1 = 0 by 0.1 / mu0, K = 20 mu0.
    """

    title = "CalculiX"
    verification = "run in the target"
    parts = frozenset()
    laws = AbaqusTarget.laws - {"ogden_4"}  # OGDEN has N = 1 to 3
    fewest_foam_terms = 2  # no stress for N = 1: the condition on the order in rubber.f excludes it
    softening_forms = frozenset()
    part_remarks = {"viscoelastic": "it has no keyword *VISCOELASTIC", "softening": "it has no Mullins effect"}
    incompressible_bulk_ratio = 1e4
    hyperelastic_options = frozenset()
    readable_keywords = ("HYPERELASTIC", "HYPERFOAM", "DENSITY")

    def list_volumetric_values(self, material: Material, terms: int, units: UnitSystem) -> list[float]:
        """Return D_1 = 2/K and the values of the absent terms, in the units of the file.

        Raises:
            InputError: CalculiX would replace D_1 by a value of its choice.
        """
        values = super().list_volumetric_values(material, terms, units)
        if values[0] < _SMALLEST_D:
            K = self.compute_bulk_modulus(material)
            raise InputError(f"K must be at most {2.0 / _SMALLEST_D * units.stress:.3g} Pa in the unit system "
                             f"{units.name}, because CalculiX replaces a smaller D1 = 2/K; got {K:.4g} Pa. Use "
                             "mm-N-MPa", field="to")
        return values

    def replace_absent_volumetric_values(self, D: Sequence[float], mu0: float) -> Sequence[float]:
        """Return the numbers D_i with which CalculiX computes, in the units of the file."""
        if not mu0 > 0.0:
            return D  # a material without stiffness is refused later
        with np.errstate(over="ignore"):
            default = float(np.float64(0.1) / mu0)
            return [float(np.float64(default)**i) if abs(value) < _SMALLEST_D else value
                    for i, value in enumerate(D, start=1)]


CALCULIX = CalculixTarget()
