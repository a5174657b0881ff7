"""The forward model of a test: nominal stress as a function of the abscissa and the parameters of a law.

A homogeneous test has its closed form; a specimen that weighs is a column whose slices differ. Both answer the same
questions, so that the fit, its curves, residuals, jitter and stability range know no other difference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.campaign.campaign import Test
from tissue_sim.closed_form.column import Column
from tissue_sim.closed_form.homogeneous import UNIAXIAL, ClosedForm
from tissue_sim.laws import Law


@dataclass(frozen=True)
class Homogeneous:
    """Every point of the specimen has the stretch, or shear strain, of the abscissa.

    Attributes:
        closed_form: of its stress.
        plate: compressed by a plate, which feels nothing before it has arrived.
    """

    closed_form: ClosedForm
    plate: bool

    @property
    def abscissa(self) -> str:
        """What the abscissa is, for the head of a table or an axis."""
        return self.closed_form.label

    @property
    def weightless(self) -> Homogeneous:
        """The closed form of the same test."""
        return self

    def stress(self, law: Law, abscissa: np.ndarray, values) -> np.ndarray:
        """Nominal stress, Pa, shape of `abscissa`."""
        return self._touching(abscissa, self.closed_form.stress(law, abscissa, values))

    def slope(self, law: Law, abscissa: np.ndarray, values) -> np.ndarray:
        """d(stress)/d(abscissa), Pa, shape of `abscissa`."""
        return self._touching(abscissa, self.closed_form.slope(law, abscissa, values))

    def derivatives(self, law: Law, abscissa: np.ndarray, values) -> np.ndarray:
        """d(stress)/d(parameter), shape (*abscissa.shape, m)."""
        return self._touching(abscissa[..., None], self.closed_form.derivatives(law, abscissa, values))

    def reached(self, law: Law, abscissa: np.ndarray, values) -> tuple[str, float, float]:
        """Mode of `Stability.limits`, and the extreme principal stretches along the load, rest included."""
        low, high = float(abscissa.min()), float(abscissa.max())
        if not self.closed_form.rest:
            return self.closed_form.mode, *self.closed_form.extremes(low, high)
        return self.closed_form.mode, min(low, 1.0), 1.0 if self.plate else max(high, 1.0)

    def _touching(self, abscissa: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.where(abscissa > 1.0, 0.0, values) if self.plate else values


@dataclass(frozen=True)
class Weighing:
    """A specimen that settled under its own weight before a plate compressed it.

    The abscissa is 1 - displacement/height: the displacement counts from the settled state, the height is the stated
    one. It is not the stretch of any slice.

    Attributes:
        column: the specimen.
    """

    column: Column

    @property
    def abscissa(self) -> str:
        """What the abscissa is, for the head of a table or an axis."""
        return "1 - displacement/height [-]"

    @property
    def weightless(self) -> Homogeneous:
        """The closed form of the same test."""
        return Homogeneous(UNIAXIAL, plate=True)

    def stress(self, law: Law, abscissa: np.ndarray, values) -> np.ndarray:
        """Minus force over undeformed cross-section, Pa, NaN beyond what the law carries; shape of `abscissa`."""
        return self.column.nominal_stress(law, self._displacement(abscissa), values)

    def slope(self, law: Law, abscissa: np.ndarray, values) -> np.ndarray:
        """d(stress)/d(abscissa), Pa, shape of `abscissa`."""
        slope = self.column.nominal_stress_slope(law, self._displacement(abscissa), values)
        return -self.column.specimen.height * slope

    def derivatives(self, law: Law, abscissa: np.ndarray, values) -> np.ndarray:
        """d(stress)/d(parameter), shape (*abscissa.shape, m)."""
        return self.column.nominal_stress_derivatives(law, self._displacement(abscissa), values)

    def reached(self, law: Law, abscissa: np.ndarray, values) -> tuple[str, float, float]:
        """Mode of `Stability.limits`, and the stretches of the base at the deepest state and of the top at rest."""
        base = self.column.base_stretch(law, self._displacement(abscissa), values)
        return "uniaxial", float(np.nanmin(base)), 1.0

    def _displacement(self, abscissa: np.ndarray) -> np.ndarray:
        return (1.0 - abscissa) * self.column.specimen.height


def forward_model(test: Test) -> Homogeneous | Weighing:
    """The forward model of a test; equal tests have equal models."""
    if test.specimen is not None and test.specimen.specific_weight:
        return Weighing(Column(test.specimen))
    return Homogeneous(test.kind.require_closed_form(), not test.kind.gripped)
