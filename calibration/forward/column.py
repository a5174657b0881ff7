"""Lubricated compression of a specimen that settled under its own weight: a column whose slices differ."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from calibration.campaign.parameter_space import ParameterSpace
from calibration.forward.closed import ClosedAnswer, ClosedTest
from calibration.forward.contract import InfeasibleError, Reached
from tissue_sim.closed_form.column import Column
from tissue_sim.laws import find_law
from tissue_sim.specimen import Specimen


@dataclass(eq=False)
class ColumnTest(ClosedTest):
    """The displacement counts from the settled state, the height is the stated one.

    Attributes:
        specimen: that weighs. reserve: the curve is solved that much beyond the deepest sample, m: as far as a contact
            offset may move it, so that the curve is the same for all recordings and offsets.
    """

    specimen: Specimen = field(kw_only=True)
    reserve: float = 0.0

    proportional: ClassVar[bool] = False

    @property
    def weightless(self) -> ClosedTest:
        return ClosedTest(self.name, self.kind, self.height, self.area, self.measured)

    def _elastic(self, answer: ClosedAnswer, displacement: np.ndarray, contact: bool):
        column, law, values = Column(self.specimen), answer.law, answer.values
        deepest = max(float(curve.displacement.max()) for curve in self.measured) + self.reserve
        # The deepest point stays, so that the curve is sampled alike.
        moved = np.append(displacement, deepest)
        stress = column.nominal_stress(law, moved, values)[:-1]
        slope = -column.nominal_stress_slope(law, moved, values)[:-1] if contact else None
        derivatives = column.nominal_stress_derivatives(law, moved, values)[:-1]
        if not np.isfinite(stress).all():
            raise InfeasibleError(f"{self.name}: {law.name} does not carry the specimen so far")
        return self._as_force(answer, stress, derivatives, slope)

    def reached(self, space: ParameterSpace, theta: np.ndarray) -> Reached:
        """The base at the deepest state, and the top at rest."""
        law, values = find_law(space.law), space.of_law(space.values(theta), self.name)
        displacement = np.concatenate([curve.displacement for curve in self.measured])
        base = Column(self.specimen).base_stretch(law, displacement, law.as_array(values))
        low = float(np.nanmin(base))
        return Reached(self.closed_form.mode, low, 1.0, self.closed_form.extremes(low, 1.0))
