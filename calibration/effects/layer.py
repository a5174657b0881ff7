"""A skin that is stiffer or softer than what is below it."""

import numpy as np

from calibration.effects.candidates import require_tests
from calibration.effects.effect import Candidate, Effect, NotTestableError, Situation, experiment_of

#: Ratio of the moduli that is tried first, and the largest that a refit may find.
_RATIO, _LARGEST = 1.2, 30.0
#: Thicknesses that are tried, in radii of the smallest contact; none more than this share of the specimen.
_THICKNESSES, _THICKEST = (0.125, 0.25, 0.5, 1.0), 0.4


class Layer(Effect):
    """A layer on top, at thicknesses that the smallest tool could feel."""

    name = "layer"
    room = "tissue"
    title = "layer or skin"
    signature = "the needle feels another stiffness at its first touch than deeper, and plates do not"
    separated_by = "a second tip radius"

    def candidates(self, situation: Situation) -> list[Candidate]:
        if situation.campaign.fit.material.layers:
            raise NotTestableError("the material that is fitted has layers already")
        needles = require_tests(situation.simulated(lambda test: not experiment_of(test).tool.is_plate),
                                "no test has a needle, and plates feel the mean of all layers")
        height = min(experiment_of(test).specimen.height for test in situation.simulated())
        size = min(map(situation.contact_radius, needles))
        thicknesses = np.minimum(size * np.array(_THICKNESSES), _THICKEST * height)
        ratio, thickness = "layers[0].ratio", "layers[0].thickness"
        return [Candidate(self, {ratio: _RATIO}, shape={thickness: h},
                          bounds={ratio: (1.0 / _LARGEST, _LARGEST), thickness: (0.05 * size, _THICKEST * height)})
                for h in dict.fromkeys(thicknesses.tolist())]
