"""An effect of the tissue in reduced form: seepage at a wet surface reduces the force while the tool stays in."""

import math
from dataclasses import dataclass

import tissue_sim as ts


@dataclass(frozen=True)
class Seepage(ts.ForceScalingEffect):
    """The force relaxes exponentially by a fraction of itself."""

    name = "seepage"
    title = "seepage at the surface"
    is_time_dependent = True
    under_plates = False
    share_lost: float = ts.parameter("s", "1", key="share_lost", bounds=(0.0, 0.9), absent=0.0)
    time: float = ts.parameter("tau_s", "s", key="time_s", bounds=(1e-3, 1e4))

    def __post_init__(self):
        if not 0 <= self.share_lost < 1:
            raise ts.InputError(f"{self.share_lost:g} is outside 0 to 1", field="share_lost")
        if not self.time > 0:
            raise ts.InputError(f"{self.time:g} s is not a positive time", field="time")

    def compute_force_factor(self, history):
        return 1.0 - self.share_lost * -math.expm1(-history.time / self.time)
