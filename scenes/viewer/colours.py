"""Colours and levels of iso-bands, and the colour bar."""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from scenes.colour_scale import compute_volume_weighted_quantiles
from tissue_sim.errors import InputError
from tissue_sim.fem.elements.fields import FIELD_UNITS

if TYPE_CHECKING:
    from tissue_sim.fem.result_views import DrawableFields

#: RGB of each band, 0 to 255, dark to bright: matplotlib's viridis from 0.12 to 0.95, which colour-blind people can
#: read and which contrasts with white and with black pages.
PALETTE = (
    (71, 42, 122), (63, 71, 136), (52, 96, 141), (42, 119, 142), (33, 142, 141),
    (32, 163, 134), (56, 185, 119), (101, 203, 94), (160, 218, 57), (223, 227, 24),
)
#: Mantissas of the step between two levels, times powers of ten; a closer spacing leaves fewer bands unused.
ROUND = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0)


@dataclass(frozen=True)
class ColourLevelSettings:
    """Rules for the levels of the colours.

    Attributes:
        rounding: Range of a field relative to its largest magnitude below which the range is rounding error.
        stress_tolerance: Range of a stress relative to the shear modulus below which the range is solver residual.
        excluded_volume: Volume fraction outside the colour range at either end, so that singular edges do not set the
            range; smaller than in a printed section, because users can zoom in.
        widest: Previous levels are kept until they span this many times the range of new ones; larger values change
            the colours less often, smaller ones use more of them.
    """

    rounding: float = 1e-6
    stress_tolerance: float = 1e-4
    excluded_volume: float = 0.003
    widest: float = 2.0


#: Settings of the viewer.
SETTINGS = ColourLevelSettings()


def compute_field_quantile_range(values: np.ndarray, fields: DrawableFields, name: str,
                                 factor: float = 1.0) -> tuple[float, float]:
    """Return the smallest and largest value of a field for the colours, without rounding error of the solver.

    The values are two quantiles by volume, as `compute_volume_weighted_quantiles` defines them.

    Args:
        values: Field at the quadrature points in the unit of the colours, shape (elements, q).
        fields: Fields of the simulation.
        name: Name of the field.
        factor: Unit of the colours per SI unit.
    """
    low, high = compute_volume_weighted_quantiles(values, fields.weights, SETTINGS.excluded_volume)
    tolerance = SETTINGS.stress_tolerance * fields.material.mu0 * factor if FIELD_UNITS[name] == "Pa" else 0.0
    if max(abs(low), abs(high)) <= tolerance:
        return 0.0, 0.0
    if high - low <= tolerance:
        return 0.5 * (low + high), 0.5 * (low + high)
    return low, high


def choose_band_levels(low: float, high: float, bands: int = len(PALETTE)) -> np.ndarray:
    """Return levels with a round step that cover a range.

    A range of one value, up to rounding, gives levels that cover the value and zero, with the value well inside a band.
    A range of zero only gives levels from 0 to 1.

    Args:
        low: Smallest value.
        high: Largest value.
        bands: Number of bands.

    Returns:
        Ascending multiples of a round step, shape (bands + 1,).

    Raises:
        InputError: The range is not finite, `low` exceeds `high`, or there are fewer than two bands.
    """
    if bands < 2:
        raise InputError(f"must be at least 2; got {bands}", field="bands")
    if not (np.isfinite([low, high]).all() and low <= high):
        raise InputError(f"must have finite bounds, the first one not above the second; got {low:g} to {high:g}",
                         field="levels")
    largest = max(abs(low), abs(high))
    if high - low > SETTINGS.rounding * largest:
        return _choose_round_levels(low, high, bands)
    if largest < 1e-100:
        return _choose_round_levels(0.0, 1.0, bands)
    # With a level at the value, rounding errors would alternate between two colours.
    return _choose_round_levels(min(0.0, low), max(0.0, high), bands, apart_from=0.5 * (low + high))


def keep_or_choose_band_levels(previous: np.ndarray | None, low: float, high: float,
                               bands: int = len(PALETTE)) -> np.ndarray:
    """Return levels for a range that changes with time, and keep the previous levels while they are suitable.

    Args:
        previous: Levels of the last picture; None if there are none.
        low: Smallest value.
        high: Largest value.
        bands: Number of bands.

    Returns:
        `previous`, the same object, if these levels cover the range and span at most `ColourLevelSettings.widest` times
        the range of `choose_band_levels`; otherwise the levels of `choose_band_levels`.

    Raises:
        InputError: As `choose_band_levels`.
    """
    levels = choose_band_levels(low, high, bands)
    if previous is None or len(previous) != len(levels) or low < previous[0] or high > previous[-1]:
        return levels
    return previous if np.ptp(previous) <= SETTINGS.widest * np.ptp(levels) else levels


def colour_bar_html(levels: np.ndarray, colours: Sequence[tuple[int, int, int]], label: str) -> str:
    """Return the colour bar as HTML.

    The bar has one block per band and is pointed at both ends, because values beyond the levels have the colours of the
    end blocks. Each block carries its colour in ``data-colour`` and its range as a tooltip. Every second level is
    labelled.

    Args:
        levels: Ascending levels in the unit of the label, shape (bands + 1,).
        colours: RGB of each band, 0 to 255.
        label: Name and unit of the field.

    Raises:
        InputError: The number of colours differs from the number of bands.
    """
    bands = len(levels) - 1
    if len(colours) != bands:
        raise InputError(f"must be one per band; got {len(colours)} for {bands} bands", field="colours")
    numbers, power = _format_levels_and_power_of_ten(np.asarray(levels, dtype=float))
    points = {0: "polygon(0 50%,60% 0,100% 0,100% 100%,60% 100%)",
              bands - 1: "polygon(0 0,40% 0,100% 50%,40% 100%,0 100%)"}
    blocks = []
    for k, colour in enumerate(colours):
        name = "#{:02x}{:02x}{:02x}".format(*colour)
        shape = f";clip-path:{points[k]}" if k in points else ""
        blocks.append(f'<div data-colour="{name}" title="{_describe_band_range(numbers, k)}{power}" '
                      f'style="flex:1;background:{name}{shape}"></div>')
    every = 2 if bands % 2 == 0 else 1
    ticks = [f'<span style="position:absolute;left:{100 * k / bands:g}%;transform:translateX(-50%)">{numbers[k]}</span>'
             for k in range(0, bands + 1, every)]
    # The labels at both ends extend beyond the bar by half of their width.
    margin = 0.5 * max(len(numbers[0]), len(numbers[-1])) * 0.62
    return ('<div data-testid="colour-bar" style="padding:0.4em 0.75em;color:currentColor;font-size:0.85em">'
            f'<div style="margin-bottom:0.25em">{html.escape(label)}{power}</div>'
            f'<div style="margin:0 {max(margin, 0.5):.2f}em">'
            f'<div style="display:flex;height:1.1em">{"".join(blocks)}</div>'
            '<div style="position:relative;height:1.4em;white-space:nowrap;font-variant-numeric:tabular-nums">'
            f'{"".join(ticks)}</div></div></div>')


def _choose_round_levels(low: float, high: float, bands: int, apart_from: float | None = None) -> np.ndarray:
    """Return multiples of the smallest round step that cover a range, none of them near the value `apart_from`."""
    smallest = np.floor(np.log10((high - low) / bands))
    for step in (factor * 10.0**power for power in (smallest, smallest + 1, smallest + 2) for factor in ROUND):
        first = np.floor(low / step)
        if low < 0.0 == first:  # the processor has flushed a denormal number to zero
            first = -1.0
        if (first + bands) * step < high or (apart_from is not None and not 0.2 < apart_from / step % 1.0 < 0.8):
            continue
        # Round to decimal numbers, because binary multiples of a decimal step have rounding errors.
        levels = np.array([float(f"{(first + k) * step:.12g}") for k in range(bands + 1)])
        if levels[0] <= low and high <= levels[-1]:
            return levels
    raise InputError(f"must have a range wider than its rounding error; got {low:g} to {high:g}", field="levels")


def _format_levels_and_power_of_ten(levels: np.ndarray) -> tuple[list[str], str]:
    """Format levels as short numbers; also return the power of ten that multiplies them as text, empty for 1."""
    largest, step = np.abs(levels).max(), np.ptp(levels) / (len(levels) - 1)
    power = 0
    if not 1e-2 < largest < 1e5:
        power = 3 * int(np.floor(np.log10(largest) / 3))
    scaled, step = levels / 10.0**power, step / 10.0**power
    decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    if any(abs(level * 10**decimals - round(level * 10**decimals)) > 1e-6 for level in scaled.tolist()):
        decimals += 1
    # Use a minus sign as wide as a digit, and none before zero.
    numbers = [f"{level + 0.0:.{decimals}f}".replace("-", "−") for level in scaled.tolist()]
    superscript = str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return numbers, f" × 10{superscript}" if power else ""


def _describe_band_range(numbers: list[str], band: int) -> str:
    """Describe the range of a band, such as "1 to 2"."""
    if band == 0:
        return f"below {numbers[1]}"
    return f"above {numbers[band]}" if band == len(numbers) - 2 else f"{numbers[band]} to {numbers[band + 1]}"
