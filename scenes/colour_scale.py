"""Colour scales of printed pictures: the range of field values that the colours show."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from scenes.field_labels import LABELS
from tissue_sim.fem.elements.fields import FIELD_UNITS
from tissue_sim.fem.result_views import DrawableFields

#: A range of values below this fraction of their largest magnitude, or of mu0 for stresses, is rounding error.
_ROUNDING = 1e-6


class LabelledColourScale(NamedTuple):
    """Label and ends of a colour scale, in the unit of the label.

    Attributes:
        label: name and unit of the field; of a uniform field also its value.
        low: lower end.
        high: upper end.
        uniform: whether the field has the same value everywhere, up to rounding.
    """

    label: str
    low: float
    high: float
    uniform: bool

    @property
    def colour_bar_extension(self) -> str:
        """Argument `extend` of matplotlib's colour bar: "both" if values may lie beyond them, else "neither"."""
        return "neither" if self.uniform else "both"


def choose_colour_scale(fields: DrawableFields, name: str, sample: int = -1) -> LabelledColourScale:
    """Return the colour scale of a field: from its 1 % quantile to its 99 % quantile by volume.

    Stresses are singular at edges, so that the full range would show the edges only.

    Args:
        fields: fields of a simulation.
        name: field, a key of `LABELS`.
        sample: index of the sample.
    """
    label, factor = LABELS[name]
    low, high = compute_volume_weighted_quantiles(fields.at_points(name, sample) * factor, fields.weights)
    least = _ROUNDING * fields.material.mu0 * factor if FIELD_UNITS[name] == "Pa" else 0.0
    uniform = high - low <= max(_ROUNDING * max(abs(low), abs(high)), least)
    if uniform:
        # A scale from zero to twice the value hides the rounding errors of a uniform field.
        value = 0.5 * (low + high) if max(abs(low), abs(high)) > least else 0.0
        label = f"{label}, uniform {value:.5g}"
        low, high = sorted((0.0, 2.0 * value)) if value else (-1.0, 1.0)
    return LabelledColourScale(label, low, high, uniform)


def compute_volume_weighted_quantiles(values: np.ndarray, weights: np.ndarray,
                                      left_out: float = 0.01) -> tuple[float, float]:
    """Return the lower and the upper quantile of a field, weighted by volume.

    Args:
        values: field at the quadrature points, any shape.
        weights: volumes of the points, m3, of the same shape.
        left_out: fraction of the volume below the lower quantile, and above the upper quantile.

    Returns:
        Lower and upper end, in the unit of the values.
    """
    order = np.argsort(values, axis=None)
    volume = np.cumsum(np.ravel(weights)[order])
    low, high = np.interp(np.array([left_out, 1.0 - left_out]) * volume[-1], volume, np.ravel(values)[order])
    return float(low), float(high)
