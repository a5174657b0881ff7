"""Drainage of pore fluid in the form of one relaxing term."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.material.viscoelasticity import PronyTerm
from tissue_sim.parameters import parameter


@dataclass(frozen=True)
class Poroelasticity:
    """Drainage of pore fluid as a reduced form: one relaxing term whose time grows with the contact size.

    Fluid leaves the loaded region by diffusion, so the time is tau = a^2 / D with the contact radius a of each test:
    the radius of the specimen under a plate, of a flat tool where it indents, and about that of the contact at the
    largest depth under a pointed one. Displacement and pressure fields are not
    solved for.

    Attributes:
        phi: share of the instantaneous stiffness that drainage takes away; 0 is absent.
        diffusivity: D, m^2/s.

    Source: scaling of Hu, Zhao, Vlassak and Suo, Appl. Phys. Lett. 96 (2010) 121904.
    """

    phi: float = parameter("phi", "1", key="phi", bounds=(1e-6, 0.99), absent=0.0)
    diffusivity: float = parameter("D", "m2/s", key="diffusivity_mm2_per_s", factor=1e-6, bounds=(1e-12, 1.0))

    def __post_init__(self):
        if not 0 <= self.phi < 1:
            raise InputError(f"{self.phi:g} is outside 0 to 1 (1 excluded); give the share of the stiffness that "
                             "drainage takes away", field="phi")
        if not 0 < self.diffusivity < np.inf:
            raise InputError(f"{self.diffusivity:g} m^2/s is not a positive diffusivity", field="diffusivity")

    def term(self, contact_radius: float | None) -> PronyTerm:
        """The relaxing term of a test with this contact radius, m; phi is above 0.

        Raises:
            InputError: no radius, or one that is not positive and finite.
        """
        if contact_radius is None:
            raise InputError("a material that drains needs the test's contact radius in m", field="contact_radius")
        if not 0 < contact_radius < np.inf:
            raise InputError(f"{contact_radius:g} m is not a positive contact radius", field="contact_radius")
        return PronyTerm(self.phi, contact_radius**2 / self.diffusivity)
