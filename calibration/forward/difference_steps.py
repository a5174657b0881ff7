"""Steps of the finite differences of forward models."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class RelativeFiniteDifferenceSteps:
    """Steps of finite differences: a smaller step increases rounding errors, a larger one truncation errors.

    Attributes:
        relative: step of closed forms and readouts, relative to the size of a parameter, to the height of the specimen
            for a contact offset, or to the largest true force for a readout.
        contact_offset: step of the contact offset of a simulated loading curve, as a fraction of the travel. Larger
            than `relative`, because the curve is a spline through few knots.
    """

    relative: float = 1e-6
    contact_offset: float = 1e-3


DIFFERENCES = RelativeFiniteDifferenceSteps()
