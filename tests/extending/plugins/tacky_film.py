"""A law of contact in one file: a film between tool and tissue that sticks a little and resists slip."""

from dataclasses import dataclass

import numpy as np

from tissue_sim.experiment.contact_law import ContactLaw, Traction
from tissue_sim.parameters import parameter


@dataclass(frozen=True)
class TackyFilm(ContactLaw):
    """The pull falls linearly to 0 at a thickness of the film; the drag is a friction that grows smoothly with
    the slip up to mu p, plus the elastic shear of the film.

    Attributes:
        tack: Pa, of the pull; thickness: m.
        friction: mu; slip: m, of the slope at rest.
        shear: Pa/m, drag of the film over its slip.
    """

    name = "tacky_film"
    title = "tacky film"

    tack: float = parameter("sigma_f", "Pa", key="tack_Pa", bounds=(0.0, 1e5), absent=0.0, default=0.0)
    thickness: float = parameter("h_f", "m", key="thickness_mm", factor=1e-3, bounds=(1e-6, 1e-2), default=1e-4)
    friction: float = parameter("mu_f", "1", key="friction", bounds=(0.0, 2.0), absent=0.0, default=0.0)
    slip: float = parameter("s_f", "m", key="slip_mm", factor=1e-3, bounds=(1e-6, 1e-2), default=2e-5)
    shear: float = parameter("k_f", "Pa/m", key="shear_Pa_per_m", bounds=(0.0, 1e12), absent=0.0, default=0.0)
    #: No parameter: whether Newton's iteration gets the rates.
    with_rates: bool = True

    @property
    def reach(self):
        return self.thickness

    def traction(self, gap, pressure, slip, face):
        pull = self.tack * (1.0 - np.maximum(gap, 0.0) / self.thickness)
        s, t = slip
        bend = np.tanh(s / self.slip)
        drag = self.shear * s + self.friction * pressure * bend
        rate = self.shear + self.friction * pressure * (1.0 - bend * bend) / self.slip
        rates = ((rate, 0.0), (0.0, rate)) if self.with_rates else ((0.0, 0.0), (0.0, 0.0))
        return Traction(pull, (drag, self.shear * t), drag_rates=rates)
