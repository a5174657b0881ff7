"""Which values the colours of a printed picture stand for."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from scenes.field_labels import LABELS
from tissue_sim.fem.fields import FIELD_UNITS


class ColourScale(NamedTuple):
    """Ends of a scale, in the unit of its label.

    Attributes:
        label: name and unit; of a uniform field its value, too.
        low, high: ends.
        uniform: whether the field has one value only, up to rounding.
    """

    label: str
    low: float
    high: float
    uniform: bool

    @property
    def extend(self) -> str:
        """Whether values lie beyond the ends, in matplotlib's words."""
        return "neither" if self.uniform else "both"


def colour_scale(fields: Any, name: str, sample: int = -1) -> ColourScale:
    """The scale of a field: without 1 % of the volume at either end, where edges are singular.

    Args:
        fields: of a simulation; see `tissue_sim.fem.solver.Fields`, with ``weights`` of the points.
        name: in `LABELS`.
        sample: of the simulation.
    """
    label, factor = LABELS[name]
    low, high = volume_range(fields.at_points(name, sample) * factor, fields.weights)
    least = 1e-6 * fields.material.mu0 * factor if FIELD_UNITS[name] == "Pa" else 0.0
    uniform = high - low <= max(1e-6 * max(abs(low), abs(high)), least)
    if uniform:
        # Rounding, not a pattern: a scale that starts at zero.
        value = 0.5 * (low + high) if max(abs(low), abs(high)) > least else 0.0
        label = f"{label}, uniform {value:.5g}"
        low, high = sorted((0.0, 2.0 * value)) if value else (-1.0, 1.0)
    return ColourScale(label, low, high, uniform)


def volume_range(values: np.ndarray, weights: np.ndarray, left_out: float = 0.01) -> tuple[float, float]:
    """Range of a field without a share of the volume at either end, since edges are singular.

    Args:
        values: at the quadrature points, any shape.
        weights: volumes of the points, m3, of the same shape.
        left_out: share of the volume.
    """
    order = np.argsort(values, axis=None)
    share = np.cumsum(np.ravel(weights)[order])
    low, high = np.interp(np.array([left_out, 1.0 - left_out]) * share[-1], share, np.ravel(values)[order])
    return float(low), float(high)
