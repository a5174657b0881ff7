"""Closed form of lubricated compression with self-weight: a column whose stretch varies with height."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from calibration.campaign.parameter_space import ParameterSpace
from calibration.forward.closed import ClosedFormParameters, ClosedFormTest
from calibration.forward.contract import InfeasibleError, StretchRange
from tissue_sim.closed_form.column import Column
from tissue_sim.laws import find_law
from tissue_sim.specimen import Specimen


@dataclass(eq=False)
class ColumnTest(ClosedFormTest):
    """Forward model of the lubricated compression of a column that has settled under its own weight.

    The displacement counts from the settled state; the height is the stated height.

    Attributes:
        specimen: specimen with density and gravity.
        reserve: displacement beyond the deepest sample up to which the curve is solved, m. It equals the largest
            contact offset, so that all recordings and offsets use the same curve.
    """

    specimen: Specimen = field(kw_only=True)
    reserve: float = 0.0

    is_force_proportional_to_moduli: ClassVar[bool] = False

    @property
    def counterpart_without_self_weight(self) -> ClosedFormTest:
        """Closed form of the same test without self-weight."""
        return ClosedFormTest(self.name, self.kind, self.height, self.area, self.measured)

    def _evaluate_elastic_force_and_derivatives(self, answer: ClosedFormParameters, displacement: np.ndarray,
                                                contact: bool):
        """Return the same quantities as in `ClosedFormTest`, for a column that has settled under its weight."""
        column, law, values = Column(self.specimen), answer.law, answer.values
        deepest = max(float(curve.displacement.max()) for curve in self.measured) + self.reserve
        # With the deepest point appended, the column is solved at the same states for every offset.
        moved = np.append(displacement, deepest)
        stress = column.nominal_stress(law, moved, values)[:-1]
        slope = -column.stress_displacement_slope(law, moved, values)[:-1] if contact else None
        derivatives = column.nominal_stress_parameter_derivatives(law, moved, values)[:-1]
        if not np.isfinite(stress).all():
            raise InfeasibleError(f"{self.name}: {law.name} has no equilibrium of the specimen under its weight at the "
                                  "largest displacement")
        return self._convert_to_force(answer, stress, derivatives, slope)

    def compute_stretch_range(self, space: ParameterSpace, theta: np.ndarray) -> StretchRange:
        """Return the range of stretches, from that of the base in the deepest state to 1 at the unloaded top."""
        law, values = find_law(space.law), space.select_law_parameter_values(space.get_values_by_name(theta), self.name)
        displacement = np.concatenate([curve.displacement for curve in self.measured])
        base = Column(self.specimen).base_stretch_at_displacement(law, displacement,
                                                                  law.convert_parameters_to_array(values))
        low = float(np.nanmin(base))
        return StretchRange(self.closed_form.mode, low, 1.0, self.closed_form.find_extreme_stretches(low, 1.0))
