"""Relaxation of the tissue."""

from calibration.effects.effect import Candidate, Effect, NotTestableError, Situation

#: Share of the stiffness that is tried first, and the largest that a refit may find.
_SHARE, _LARGEST = 0.1, 0.95


class Viscoelasticity(Effect):
    """One Prony term, at each time that the recordings could resolve."""

    name = "viscoelasticity"
    room = "tissue"
    title = "viscoelasticity"
    signature = "the force falls in holds, rises with the speed and returns lower than it came, alike in all tests"
    separated_by = "a hold, or a second speed"

    def candidates(self, situation: Situation) -> list[Candidate]:
        if situation.campaign.fit.material.viscoelastic is not None:
            raise NotTestableError("the material that is fitted relaxes already")
        g, tau = "viscoelastic.terms[0].g", "viscoelastic.terms[0].tau"
        step, longest = situation.times
        return [Candidate(self, {g: _SHARE}, shape={tau: time},
                          bounds={g: (0.0, _LARGEST), tau: (0.3 * step, 10.0 * longest)})
                for time in situation.relaxation_times()]
