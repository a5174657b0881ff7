"""Fluid that drains from the tissue."""

import numpy as np

from calibration.effects.candidates import require_tests
from calibration.effects.effect import Candidate, Effect, NotTestableError, Situation

#: Share of the stiffness that is tried first, and the largest that a refit may find.
_SHARE, _LARGEST = 0.1, 0.95
#: Diffusivities in a factor of ten, and as many as there are at most.
_PER_DECADE, _MOST = 2.0, 8


class Poroelasticity(Effect):
    """Drainage at each diffusivity that the recordings could resolve."""

    name = "poroelasticity"
    room = "tissue"
    title = "drainage of pore fluid"
    signature = "the force falls in holds, and the larger the contact the slower: in time with its size squared"
    separated_by = "a hold on two contact sizes"

    def candidates(self, situation: Situation) -> list[Candidate]:
        if situation.campaign.fit.material.poroelasticity is not None:
            raise NotTestableError("the material that is fitted drains already")
        radii = [situation.contact_radius(test) for test in require_tests(
            situation.simulated(), "no test has a tool, and so no size of a contact")]
        times = situation.relaxation_times()
        slow, fast = min(radii) ** 2 / times[-1], max(radii) ** 2 / times[0]
        phi, D = "poroelasticity.phi", "poroelasticity.diffusivity"
        count = min(_MOST, 1 + int(np.ceil(_PER_DECADE * np.log10(fast / slow))))
        return [Candidate(self, {phi: _SHARE}, shape={D: diffusivity},
                          bounds={phi: (0.0, _LARGEST), D: (0.1 * slow, 10.0 * fast)})
                for diffusivity in np.geomspace(slow, fast, count).tolist()]
