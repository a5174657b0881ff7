"""Stress softening below the largest previous load (Mullins effect)."""

from calibration.effects.candidates import require_tests
from calibration.effects.effect import Candidate, Effect, NotTestableError, Situation

#: Trial loss of stress, as a fraction of the stress.
_TRIAL_LOSS = 0.1
#: Largest loss of stress that a refit may find.
_MAX_LOSS = 0.95
#: Trial fractions of the largest strain energy that must be released until the tissue has softened; each gives another
#: shape of the unloading curve.
_TRIAL_ENERGY_FRACTIONS = (0.15, 0.4, 1.0, 3.0)


class Softening(Effect):
    """Loss of stress below the largest previous strain energy; one candidate per shape of the unloading curve."""

    name = "softening"
    category = "tissue"
    title = "softening on first load (Mullins)"
    signature = "unloading and reloading are below the first loading, more so at smaller displacement, at every speed"
    separated_by = "unloading and loading again"

    def candidates(self, situation: Situation) -> list[Candidate]:
        if situation.campaign.fit.material.softening is not None:
            raise NotTestableError("the fitted material has softening already")
        require_tests(situation.simulated_tests(situation.has_unloading),
                      "no recording has an unloading, and softening does not change the first loading")
        loss, energy = "softening.loss", "softening.share"
        limits = 0.1 * _TRIAL_ENERGY_FRACTIONS[0], 10.0 * _TRIAL_ENERGY_FRACTIONS[-1]
        return [Candidate(self, {loss: _TRIAL_LOSS}, shape={energy: fraction},
                          bounds={loss: (0.0, _MAX_LOSS), energy: limits})
                for fraction in _TRIAL_ENERGY_FRACTIONS]
