"""Poroelasticity: drainage of fluid from the tissue."""

import numpy as np

from calibration.effects.candidates import require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect, NotTestableError


class Poroelasticity(Effect):
    """Effect of force relaxation by drainage; one candidate per diffusivity that the recordings can resolve."""

    name = "poroelasticity"
    category = "tissue"
    title = "drainage of pore fluid"
    signature = "the force falls in holds, over a time that grows with the square of the contact size"
    separated_by = "holds with two contact sizes"
    #: Trial fraction of the stiffness that drainage removes.
    trial_fraction = 0.1
    #: Largest fraction of the stiffness that a refit may find.
    max_fraction = 0.95
    #: Trial diffusivities per decade.
    diffusivities_per_decade = 2.0
    #: Largest number of trial diffusivities.
    max_diffusivities = 8

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate (relaxing fraction of the stiffness) per trial diffusivity, m2/s."""
        if situation.campaign.fit.placeholder_material_with_effects.poroelasticity is not None:
            raise NotTestableError("the fitted material includes poroelasticity already, so this effect is not tested")
        radii = [situation.contact_radius(test) for test in require_tests(
            situation.simulated_tests(), "no test has a tool, so no contact size is known")]
        times = situation.list_resolvable_relaxation_times()
        slow, fast = min(radii) ** 2 / times[-1], max(radii) ** 2 / times[0]
        phi, D = "poroelasticity.phi", "poroelasticity.diffusivity"
        count = min(self.max_diffusivities, 1 + int(np.ceil(self.diffusivities_per_decade * np.log10(fast / slow))))
        return [Candidate(self, {phi: self.trial_fraction}, shape={D: diffusivity},
                          bounds={phi: (0.0, self.max_fraction), D: (0.1 * slow, 10.0 * fast)})
                for diffusivity in np.geomspace(slow, fast, count).tolist()]
