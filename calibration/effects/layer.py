"""Surface layer with another stiffness than the tissue below."""

import numpy as np

from calibration.effects.candidates import require_tests
from calibration.effects.effect import Candidate, DiagnosisData, Effect, NotTestableError, get_experiment


class Layer(Effect):
    """Effect of a top layer with its own modulus; one candidate per trial thickness."""

    name = "layer"
    category = "tissue"
    title = "layer or skin"
    signature = "the stiffness under the needle differs between first contact and larger depth, unlike under plates"
    separated_by = "a second tip radius"
    #: Trial ratio of the moduli of layer and tissue.
    trial_ratio = 1.2
    #: Largest ratio of the moduli, and largest inverse ratio, that a refit may find.
    max_ratio = 30.0
    #: Trial thicknesses in units of the smallest contact radius: the smallest tool responds to layers of about its
    #: radius.
    trial_thicknesses = (0.125, 0.25, 0.5, 1.0)
    #: Largest thickness as a fraction of the height of the specimen.
    max_thickness_fraction = 0.4

    def candidates(self, situation: DiagnosisData) -> list[Candidate]:
        """Return one candidate (ratio of moduli) per trial thickness of the layer; the tests must include a needle."""
        if situation.campaign.fit.placeholder_material_with_effects.layers:
            raise NotTestableError("the fitted material includes layers already, so this effect is not tested")
        needles = require_tests(situation.simulated_tests(lambda test: not get_experiment(test).tool.is_plate),
                                "no test has a needle, and plates show only the mean stiffness of all layers")
        height = min(get_experiment(test).specimen.height for test in situation.simulated_tests())
        radius = min(map(situation.contact_radius, needles))
        thickest = self.max_thickness_fraction * height
        thicknesses = np.minimum(radius * np.array(self.trial_thicknesses), thickest)
        ratio, thickness = "layers[0].ratio", "layers[0].thickness"
        return [Candidate(self, {ratio: self.trial_ratio}, shape={thickness: h},
                          bounds={ratio: (1.0 / self.max_ratio, self.max_ratio),
                                  thickness: (0.05 * radius, thickest)})
                for h in dict.fromkeys(thicknesses.tolist())]
