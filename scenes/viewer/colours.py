"""Colours and levels of iso-bands, and the bar that explains them."""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from scenes.colour_scale import volume_range
from tissue_sim.errors import InputError
from tissue_sim.fem.fields import FIELD_UNITS

if TYPE_CHECKING:
    from tissue_sim.fem.axisymmetric.fields import Fields

#: Red, green, blue of each band, dark to bright: matplotlib's viridis from 0.12 to 0.95, which the colour-blind read as
#: well and which stands out from a white page as well as from a black one.
PALETTE = (
    (71, 42, 122), (63, 71, 136), (52, 96, 141), (42, 119, 142), (33, 142, 141),
    (32, 163, 134), (56, 185, 119), (101, 203, 94), (160, 218, 57), (223, 227, 24),
)
#: Steps between levels, in powers of ten; the ratio of two neighbours is the share of the bands that may stay unused.
ROUND = (1.0, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0)
#: A range narrower than this share of its values is rounding; of stresses, narrower than this share of the shear
#: modulus is what the solver leaves unbalanced.
NARROWEST, NARROWEST_STRESS = 1e-6, 1e-4
#: Share of the volume that colours leave out at either end: less than in a printed section, since one may go near.
LEFT_OUT = 0.003
#: Levels that were good are kept until they span this many times what is needed.
TOO_WIDE = 2.0


def field_range(values: np.ndarray, fields: Fields, name: str, factor: float = 1.0) -> tuple[float, float]:
    """Ends of a field's colours: its `volume_range`, without what is rounding.

    Args:
        values: of the field at the quadrature points, in the unit of the colours, shape (elements, q).
        fields: of the simulation.
        name: of the field.
        factor: from SI to the unit of the colours.
    """
    low, high = volume_range(values, fields.weights, LEFT_OUT)
    least = NARROWEST_STRESS * fields.material.mu0 * factor if FIELD_UNITS[name] == "Pa" else 0.0
    if max(abs(low), abs(high)) <= least:
        return 0.0, 0.0
    if high - low <= least:
        return 0.5 * (low + high), 0.5 * (low + high)
    return low, high


def band_levels(low: float, high: float, bands: int = len(PALETTE)) -> np.ndarray:
    """Levels in round steps that cover a range.

    Where there is one value only, up to rounding, they cover it and zero, with the value well inside a band; where that
    is zero, they go from 0 to 1.

    Args:
        low, high: ends of the range.
        bands: number of bands.

    Returns:
        Ascending multiples of a round step, shape (bands + 1,).

    Raises:
        InputError: the range is not finite or runs backwards, or there are not two bands.
    """
    if bands < 2:
        raise InputError(f"{bands} bands show no difference; give at least 2", field="bands")
    if not (np.isfinite([low, high]).all() and low <= high):
        raise InputError(f"{low:g} to {high:g} is not a range of values; give two finite numbers in order",
                         field="levels")
    largest = max(abs(low), abs(high))
    if high - low > NARROWEST * largest:
        return _covering(low, high, bands)
    if largest < 1e-100:
        return _covering(0.0, 1.0, bands)
    # A level at the value would turn rounding into a pattern.
    return _covering(min(0.0, low), max(0.0, high), bands, apart_from=0.5 * (low + high))


def steady_levels(previous: np.ndarray | None, low: float, high: float, bands: int = len(PALETTE)) -> np.ndarray:
    """Levels for a range that moves: `previous`, the same object, as long as they cover it and are not more than
    `TOO_WIDE` times as wide as `band_levels` would be; else those.

    Args:
        previous: levels of the last picture; None: there are none.
        low, high: ends of the range.
        bands: number of bands.

    Raises:
        InputError: what `band_levels` refuses.
    """
    levels = band_levels(low, high, bands)
    if previous is None or len(previous) != len(levels) or low < previous[0] or high > previous[-1]:
        return levels
    return previous if np.ptp(previous) <= TOO_WIDE * np.ptp(levels) else levels


def colour_bar_html(levels: np.ndarray, colours: Sequence[tuple[int, int, int]], label: str) -> str:
    """A bar with a block for every band, pointed at both ends, as what lies beyond has the colours of the ends.

    Every block has its colour in ``data-colour``, and its range as a tooltip. Numbers stand at every second level.

    Args:
        levels: ascending, in the unit of the label, shape (bands + 1,).
        colours: red, green, blue of each band, 0 to 255.
        label: name and unit of the field.

    Raises:
        InputError: not one colour for each band.
    """
    bands = len(levels) - 1
    if len(colours) != bands:
        raise InputError(f"{len(colours)} colours for {bands} bands; give one for each", field="colours")
    numbers, power = _numbers(np.asarray(levels, dtype=float))
    points = {0: "polygon(0 50%,60% 0,100% 0,100% 100%,60% 100%)",
              bands - 1: "polygon(0 0,40% 0,100% 50%,40% 100%,0 100%)"}
    blocks = []
    for k, colour in enumerate(colours):
        name = "#{:02x}{:02x}{:02x}".format(*colour)
        shape = f";clip-path:{points[k]}" if k in points else ""
        blocks.append(f'<div data-colour="{name}" title="{_words(numbers, k)}{power}" '
                      f'style="flex:1;background:{name}{shape}"></div>')
    every = 2 if bands % 2 == 0 else 1
    ticks = [f'<span style="position:absolute;left:{100 * k / bands:g}%;transform:translateX(-50%)">{numbers[k]}</span>'
             for k in range(0, bands + 1, every)]
    # The numbers at the ends reach beyond the bar by half their width.
    margin = 0.5 * max(len(numbers[0]), len(numbers[-1])) * 0.62
    return ('<div data-testid="colour-bar" style="padding:0.4em 0.75em;color:currentColor;font-size:0.85em">'
            f'<div style="margin-bottom:0.25em">{html.escape(label)}{power}</div>'
            f'<div style="margin:0 {max(margin, 0.5):.2f}em">'
            f'<div style="display:flex;height:1.1em">{"".join(blocks)}</div>'
            '<div style="position:relative;height:1.4em;white-space:nowrap;font-variant-numeric:tabular-nums">'
            f'{"".join(ticks)}</div></div></div>')


def _covering(low: float, high: float, bands: int, apart_from: float | None = None) -> np.ndarray:
    """Multiples of the smallest round step that cover a range, none of them near `apart_from`."""
    smallest = np.floor(np.log10((high - low) / bands))
    for step in (factor * 10.0**power for power in (smallest, smallest + 1, smallest + 2) for factor in ROUND):
        first = np.floor(low / step)
        if low < 0.0 == first:  # where the processor rounds the smallest numbers to zero
            first = -1.0
        if (first + bands) * step < high or (apart_from is not None and not 0.2 < apart_from / step % 1.0 < 0.8):
            continue
        # The decimal numbers that are meant, not their multiples in binary.
        levels = np.array([float(f"{(first + k) * step:.12g}") for k in range(bands + 1)])
        if levels[0] <= low and high <= levels[-1]:
            return levels
    raise InputError(f"no round levels cover {low:g} to {high:g}; give a range that is not narrower than its rounding",
                     field="levels")


def _numbers(levels: np.ndarray) -> tuple[list[str], str]:
    """Levels as short numbers, and the power of ten that they are to be multiplied by, empty for 1."""
    largest, step = np.abs(levels).max(), np.ptp(levels) / (len(levels) - 1)
    power = 0
    if not 1e-2 < largest < 1e5:
        power = 3 * int(np.floor(np.log10(largest) / 3))
    scaled, step = levels / 10.0**power, step / 10.0**power
    decimals = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    if any(abs(level * 10**decimals - round(level * 10**decimals)) > 1e-6 for level in scaled.tolist()):
        decimals += 1
    # A minus as wide as a digit; no minus before zero.
    numbers = [f"{level + 0.0:.{decimals}f}".replace("-", "−") for level in scaled.tolist()]
    superscript = str(power).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return numbers, f" × 10{superscript}" if power else ""


def _words(numbers: list[str], band: int) -> str:
    """Range of a band."""
    if band == 0:
        return f"below {numbers[1]}"
    return f"above {numbers[band]}" if band == len(numbers) - 2 else f"{numbers[band]} to {numbers[band + 1]}"
