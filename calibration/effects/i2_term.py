"""Dependence of the strain energy on the second invariant."""

from calibration.effects.candidates import WIDER, check_biderman_case_and_get_parameter_names
from calibration.effects.effect import Candidate, DiagnosisData, Effect, NotTestableError


class I2Term(Effect):
    """Effect of a strain energy term C01 (I2 - 3) that the fitted law lacks; the parameter is C01, Pa."""

    name = "i2_term"
    category = "tissue"
    title = "second invariant (tension/compression asymmetry)"
    signature = "the stiffness changes differently with depth under plates and under the needle, equally at every speed"
    separated_by = "tension, or a compression to 20 mm"
    law = WIDER
    #: Trial contribution of the term to the shear modulus, as a fraction of the modulus.
    trial_fraction = 0.05
    #: Largest value of C01 that a refit may find, as a fraction of the shear modulus.
    max_fraction = 2.0

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return the candidate that extends the fitted law to Biderman's law by C01."""
        if "C01" in check_biderman_case_and_get_parameter_names(situation.law):
            raise NotTestableError("the fitted law has a term in I2 - 3 already")
        # mu = 2 (C10 + C01).
        size = 0.5 * self.trial_fraction * situation.estimated_shear_modulus
        return [Candidate(self, {"C01": size}, absent={"C01": 0.0},
                          bounds={"C01": (0.0, self.max_fraction * situation.estimated_shear_modulus)}, law=WIDER)]
