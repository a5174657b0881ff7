"""Stress softening below the largest previous load (Mullins effect)."""

from calibration.effects.candidates import require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect, NotTestableError


class Softening(Effect):
    """Effect of a loss of stress below the largest previous strain energy; one candidate per trial energy fraction."""

    name = "softening"
    category = "tissue"
    title = "softening on first load (Mullins)"
    signature = "unloading and reloading are below the first loading, more so at smaller displacement, at every speed"
    separated_by = "unloading and loading again"
    #: Trial loss of stress, as a fraction of the stress.
    trial_loss = 0.1
    #: Largest loss of stress that a refit may find.
    max_loss = 0.95
    #: Trial fractions of the largest strain energy that must be released until the tissue has softened; each gives
    #: another shape of the unloading curve.
    trial_energy_fractions = (0.15, 0.4, 1.0, 3.0)

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate per trial fraction of the strain energy."""
        if situation.campaign.fit.placeholder_material_with_effects.softening is not None:
            raise NotTestableError("the fitted material includes softening already, so this effect is not tested")
        require_tests(situation.simulated_tests(situation.test_has_unloading),
                      "no recording has an unloading, and softening does not change the first loading")
        loss, energy = "softening.loss", "softening.share"
        limits = 0.1 * self.trial_energy_fractions[0], 10.0 * self.trial_energy_fractions[-1]
        return [Candidate(self, {loss: self.trial_loss}, shape={energy: fraction},
                          bounds={loss: (0.0, self.max_loss), energy: limits})
                for fraction in self.trial_energy_fractions]
