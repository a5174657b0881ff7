"""Strain stiffening beyond the fitted law."""

from calibration.effects.candidates import WIDER, find_lowest_missing_coefficient_and_power
from calibration.effects.effect import Candidate, DiagnosisData, Effect


class StrainStiffening(Effect):
    """Effect of a strain energy term in the lowest power of I1 - 3 that the fitted law lacks."""

    name = "strain_stiffening"
    category = "tissue"
    title = "strain stiffening"
    signature = "the force rises more steeply at the end of the ramp than the law allows, in all tests at every speed"
    separated_by = "any second test, or a deeper ramp"
    law = WIDER
    #: Trial contribution of the new term to the stress at the largest strain, as a fraction of the stress.
    trial_fraction = 0.2
    #: Largest coefficient that a refit may find, in units of the trial coefficient. The bound is wide because the term
    #: grows so steeply with strain that it is small in most of the tissue.
    max_trial_coefficients = 500.0

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidate with the lowest power of I1 - 3 that the fitted law lacks."""
        path, order = find_lowest_missing_coefficient_and_power(situation.law)
        largest = max((situation.largest_strain(test) for test in situation.simulated_tests()), default=0.1)
        # Ratio of the stresses of Cn0 (I1 - 3)^n and C10 (I1 - 3), with C10 = mu / 2 and I1 = 3 + 3 strain^2 to lowest
        # order.
        mu = situation.estimated_shear_modulus
        size = self.trial_fraction * 0.5 * mu / (order * (3.0 * largest**2) ** (order - 1))
        return [Candidate(self, {path: size}, absent={path: 0.0},
                          bounds={path: (0.0, self.max_trial_coefficients * size)}, law=WIDER)]
