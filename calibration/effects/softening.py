"""Tissue that is weaker below the largest load it has seen."""

from calibration.effects.candidates import require_tests
from calibration.effects.effect import Candidate, Effect, NotTestableError, Situation

#: Share of the stress that is tried first, and the largest that a refit may find.
_SHARE, _LARGEST = 0.1, 0.95
#: How much of the largest energy has to be given back until the tissue has softened: shapes of the return.
_SCALES = (0.15, 0.4, 1.0, 3.0)


class Softening(Effect):
    """Softening on first load (the Mullins effect)."""

    name = "softening"
    room = "tissue"
    title = "softening on first load (Mullins)"
    signature = "the return, and a second loading, are lower than the way in, the more the farther back, at every speed"
    separated_by = "unloading and loading again"

    def candidates(self, situation: Situation) -> list[Candidate]:
        if situation.campaign.fit.material.softening is not None:
            raise NotTestableError("the material that is fitted softens already")
        require_tests(situation.simulated(situation.returns),
                      "no tool comes back, and it leaves the first loading alone")
        loss, share = "softening.loss", "softening.share"
        return [Candidate(self, {loss: _SHARE}, shape={share: scale},
                          bounds={loss: (0.0, _LARGEST), share: (0.1 * _SCALES[0], 10.0 * _SCALES[-1])})
                for scale in _SCALES]
