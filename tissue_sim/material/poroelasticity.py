"""Drainage of pore fluid as one relaxing term."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.material.viscoelasticity import PronyTerm
from tissue_sim.parameters import parameter
from tissue_sim.public_names import with_old_names


@with_old_names(term="make_prony_term")
@dataclass(frozen=True)
class Poroelasticity:
    """Drainage of pore fluid in reduced form: one relaxing term whose time grows with the size of the contact.

    Fluid leaves the loaded region by diffusion, with the time tau = a^2 / D and the contact radius a of each test: the
    radius of the specimen under a plate, the radius of a flat tool, and approximately the radius of the contact at the
    largest depth of a pointed tool. The pressure of the fluid is not computed.

    Attributes:
        phi: fraction of the instantaneous stiffness that is lost by drainage; 0 is absent.
        diffusivity: D, m^2/s.

    Source: scaling of Hu, Zhao, Vlassak and Suo, Appl. Phys. Lett. 96 (2010) 121904.
    """

    phi: float = parameter("phi", "1", key="phi", bounds=(1e-6, 0.99), absent=0.0)
    diffusivity: float = parameter("D", "m2/s", key="diffusivity_mm2_per_s", factor=1e-6, bounds=(1e-12, 1.0))

    def __post_init__(self):
        if not 0 <= self.phi < 1:
            raise InputError(f"must be a fraction of the stiffness from 0 to below 1; got {self.phi:g}.", field="phi")
        if not 0 < self.diffusivity < np.inf:
            raise InputError(f"must be positive and finite; got {self.diffusivity:g} m^2/s.", field="diffusivity")

    def make_prony_term(self, contact_radius: float | None) -> PronyTerm:
        """Return the relaxing term of a test with a contact radius, m; phi must be above 0.

        Raises:
            InputError: the radius is None, not positive or not finite.
        """
        if contact_radius is None:
            raise InputError("must be given, in m, for a material that drains.", field="contact_radius")
        if not 0 < contact_radius < np.inf:
            raise InputError(f"must be positive and finite; got {contact_radius:g} m.", field="contact_radius")
        return PronyTerm(self.phi, contact_radius**2 / self.diffusivity)
