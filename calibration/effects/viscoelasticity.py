"""Relaxation of the tissue."""

from calibration.effects.effect import Candidate, Effect, NotTestableError, Situation

#: Share of the stiffness that is tried first, and the largest that a refit may find.
_SHARE, _LARGEST = 0.1, 0.95


class Viscoelasticity(Effect):
    """One more Prony term, at each time that the recordings could resolve; up to three where one is not enough."""

    name = "viscoelasticity"
    room = "tissue"
    title = "viscoelasticity"
    signature = "the force falls in holds, rises with the speed and returns lower than it came, alike in all tests"
    separated_by = "a hold, or a second speed"
    times = 3

    def candidates(self, situation: Situation) -> list[Candidate]:
        series = situation.campaign.fit.material.viscoelastic
        number = 0 if series is None else len(series.terms)
        if number >= self.times:
            raise NotTestableError(f"the material that is fitted relaxes already, with {number} terms")
        g, tau = (f"viscoelastic.terms[{number}].{name}" for name in ("g", "tau"))
        step, longest = situation.times
        return [Candidate(self, {g: _SHARE}, shape={tau: time},
                          bounds={g: (0.0, _LARGEST), tau: (0.3 * step, 10.0 * longest)})
                for time in situation.relaxation_times()]
