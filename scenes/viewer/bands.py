"""Iso-bands of a field: levels, colours, colour bar, and the cutting of triangles and lines where it crosses a level.

Each piece between two levels has one colour. The colours of surfaces are chosen so that the tone mapping of the browser
gives the colours of the bands. The tone curve is `ACESFilmicToneMapping` of three.js at an exposure of 1, a fit by
Stephen Hill to the ACES reference rendering (https://github.com/TheRealMJP/BakingLab, ACES.hlsl).
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
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


#: Matrix from linear sRGB to the colour space of the curve.
_IN = np.array([[0.59719, 0.35458, 0.04823], [0.07600, 0.90834, 0.01566], [0.02840, 0.13383, 0.83777]])
#: Matrix from the colour space of the curve to linear sRGB.
_OUT = np.array([[1.60475, -0.53108, -0.07367], [-0.10208, 1.10813, -0.00605], [-0.00327, -0.07276, 1.07602]])
#: Factor that three.js applies to linear colours before the curve.
_EXPOSURE = 1.0 / 0.6


@dataclass(frozen=True)
class ToneCurveCoefficients:
    """Coefficients of the rational tone curve (v (v + a) - b) / (v (c v + d) + e), from ACES.hlsl.

    Attributes:
        a, b, c, d, e: The coefficients.
    """

    a: float = 0.0245786
    b: float = 0.000090537
    c: float = 0.983729
    d: float = 0.4329510
    e: float = 0.238081


_CURVE = ToneCurveCoefficients()


def compute_displayed_srgb(surface: tuple[int, int, int]) -> tuple[int, int, int]:
    """Return the colour on the screen of a surface in full light, sRGB, 0 to 255.

    Args:
        surface: Colour of the surface, sRGB, 0 to 255.
    """
    v = _IN @ (_decode_srgb_bytes(surface) * _EXPOSURE)
    curve = (v * (v + _CURVE.a) - _CURVE.b) / (v * (_CURVE.c * v + _CURVE.d) + _CURVE.e)
    return _encode_srgb_bytes(_OUT @ curve)


def find_surface_srgb(seen: tuple[int, int, int]) -> tuple[int, int, int]:
    """Return the surface colour whose colour on the screen is nearest to a given one, sRGB, 0 to 255.

    Args:
        seen: Desired colour on the screen, sRGB, 0 to 255.
    """
    y = np.linalg.solve(_OUT, _decode_srgb_bytes(seen))
    a, b, c = 1.0 - _CURVE.c * y, _CURVE.a - _CURVE.d * y, -_CURVE.b - _CURVE.e * y
    v = (-b + np.sqrt(np.maximum(b * b - 4.0 * a * c, 0.0))) / (2.0 * a)
    rounded = _encode_srgb_bytes(np.linalg.solve(_IN, v) / _EXPOSURE)
    # The channels are coupled: near black, rounding one channel of the surface changes another one on the screen by
    # several steps. Therefore all neighbours of the rounded colour are compared.
    reds, greens, blues = (range(max(part - 1, 0), min(part + 1, 255) + 1) for part in rounded)
    neighbours = ((red, green, blue) for red in reds for green in greens for blue in blues)
    return min(neighbours, key=lambda surface: float(np.sum(np.subtract(compute_displayed_srgb(surface), seen) ** 2)))


def _decode_srgb_bytes(colour: tuple[int, int, int]) -> np.ndarray:
    """Convert sRGB, 0 to 255, to linear RGB, 0 to 1 (IEC 61966-2-1)."""
    encoded = np.asarray(colour) / 255.0
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _encode_srgb_bytes(linear: np.ndarray) -> tuple[int, int, int]:
    """Convert linear RGB, clipped to 0 to 1, to rounded sRGB, 0 to 255 (IEC 61966-2-1)."""
    linear = np.clip(linear, 0.0, 1.0)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return tuple(round(255.0 * part) for part in encoded.tolist())


@dataclass(frozen=True, eq=False)
class TrianglesSortedByBand:
    """Triangles that result from cutting a triangulation at the levels; each triangle lies in one band.

    Attributes:
        points: Original points, then the points where edges cross levels, shape (m, 2) or (m, 3).
        triangles: Point numbers with the original orientation, sorted by band, shape (k, 3).
        band: Band of each triangle, ascending, shape (k,).
    """

    points: np.ndarray
    triangles: np.ndarray
    band: np.ndarray


@dataclass(frozen=True, eq=False)
class TriangleConnectivity:
    """Fixed connectivity of triangles whose points and nodal values change from frame to frame.

    Attributes:
        triangles: Point numbers, shape (t, 3).
    """

    triangles: np.ndarray

    @cached_property
    def _edges_and_triangle_edge_numbers(self) -> tuple[np.ndarray, np.ndarray]:
        """Edges of the triangles, each edge listed once.

        Returns:
            End points of each edge, shape (e, 2), and edge numbers of each triangle in the order of its corners 0-1,
            1-2, 2-0, shape (t, 3).
        """
        ends = np.sort(self.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1).astype(np.int64)
        points = int(ends.max(initial=0)) + 1
        keys, number = np.unique(ends[:, 0] * points + ends[:, 1], return_inverse=True)
        return np.stack([keys // points, keys % points], axis=-1), number.reshape(-1, 3)

    def cut_at_levels(self, points: np.ndarray, values: np.ndarray, levels: np.ndarray) -> TrianglesSortedByBand:
        """Cut the triangles where the linear interpolant of the values crosses the levels.

        Args:
            points: Coordinates, shape (n, 2) or (n, 3).
            values: Values at the points, shape (n,).
            levels: Ascending levels, shape (bands + 1,). Values below the first level belong to the first band, values
                above the last level to the last band.
        """
        inner = np.asarray(levels, dtype=float)[1:-1]
        edges, edges_of = self._edges_and_triangle_edge_numbers
        at_ends = values[edges]
        # For each point: the number of levels < value, and the number of levels <= value.
        below, reached = np.searchsorted(inner, values, "left"), np.searchsorted(inner, values, "right")
        first = reached[edges].min(axis=1)
        count = np.maximum(below[edges].max(axis=1) - first, 0)
        crossed = np.repeat(np.arange(len(edges)), count)
        start = np.cumsum(count) - count
        level = inner[first[crossed] + np.arange(crossed.size) - start[crossed]]
        fraction = (level - at_ends[crossed, 0]) / (at_ends[crossed, 1] - at_ends[crossed, 0])
        first_end, second_end = points[edges[crossed, 0]], points[edges[crossed, 1]]
        all_points = np.concatenate([points, first_end + fraction[:, None] * (second_end - first_end)])
        # The crossing of edge e with level l is point number `of_edge[e] + l`.
        of_edge = len(points) + start - first

        reached_at = reached[self.triangles]
        lowest = reached_at.min(axis=1)
        highest = np.maximum(below[self.triangles].max(axis=1), lowest)
        whole = lowest == highest
        split = np.flatnonzero(~whole)
        pieces, band = self._cut_triangles_into_band_pieces(split, values, below, reached, of_edge, edges_of,
                                                            lowest[split],
                                                            highest[split])
        triangles = np.concatenate([self.triangles[whole], pieces])
        band = np.concatenate([lowest[whole], band])
        order = np.argsort(band, kind="stable")
        return TrianglesSortedByBand(all_points, triangles[order], band[order])

    def _cut_triangles_into_band_pieces(self, split, values, below, reached, of_edge, edges_of, lowest, highest):
        """Cut the triangles numbered `split` into pieces.

        The long edge of a triangle connects the corners with the lowest and the highest value; the two short edges
        meet at the middle corner. The part of a triangle inside a band is a polygon with these corners: the crossing of
        the long edge with the lower level, the crossing of a short edge with the lower level, the middle corner if its
        value lies in the band, the crossing of a short edge with the upper level, and the crossing of the long edge
        with the upper level.

        Returns:
            Point numbers of the pieces, shape (k, 3), and their bands, shape (k,).
        """
        corners = self.triangles[split]
        order = np.argsort(values[corners], axis=1, kind="stable")
        rows = np.arange(split.size)[:, None]
        low, middle, high = corners[rows, order].T
        odd = (order[:, 1] - order[:, 0]) % 3 == 2
        # Edge (k + 1) % 3 lies opposite to corner k.
        short_high, long, short_low = edges_of[split][rows, (order + 1) % 3].T

        repeats = highest - lowest + 1
        of = np.repeat(np.arange(split.size), repeats)
        band = lowest[of] + np.arange(of.size) - np.repeat(np.cumsum(repeats) - repeats, repeats)
        low, middle, high, odd = low[of], middle[of], high[of], odd[of]
        on_long, on_low, on_high = of_edge[long[of]], of_edge[short_low[of]], of_edge[short_high[of]]
        under, reach = below[middle], reached[middle]

        def find_level_crossings_on_short_edges(level):
            """Return point numbers: the crossing of a short edge, or the middle corner if it is on the level."""
            return np.where(level < under, on_low + level, np.where(level >= reach, on_high + level, middle))

        bottom, top = band == lowest[of], band == highest[of]
        long_below, long_above = np.where(bottom, low, on_long + band - 1), np.where(top, high, on_long + band)
        short_below = np.where(bottom, low, find_level_crossings_on_short_edges(band - 1))
        short_above = np.where(top, high, find_level_crossings_on_short_edges(band))
        inside = (bottom | (band - 1 < under)) & (top | (band >= reach))
        between = np.where(inside, middle, short_below)
        pieces = np.stack([np.stack([long_below, short_below, between], axis=-1),
                           np.stack([long_below, between, short_above], axis=-1),
                           np.stack([long_below, short_above, long_above], axis=-1)], axis=1)
        pieces[odd] = pieces[odd][..., ::-1]
        a, b, c = np.moveaxis(pieces, -1, 0)
        real = (a != b) & (b != c) & (c != a)
        return pieces[real], np.repeat(band, 3).reshape(-1, 3)[real]


def renumber_triangles_for_band_meshes(triangles: np.ndarray, band: np.ndarray, points: int,
                                       bands: int) -> tuple[np.ndarray, np.ndarray, list]:
    """Split triangles into one mesh per band, each with its own point numbers.

    Args:
        triangles: Point numbers, sorted by band, shape (k, 3).
        band: Band of each triangle, ascending, shape (k,).
        points: Number of points.
        bands: Number of bands.

    Returns:
        Original numbers of the points of all meshes, mesh after mesh; the triangles in point numbers that start at 0 in
        each mesh, shape (k, 3); and for each mesh the slice of its points and the slice of its triangles.
    """
    shifted = triangles + (band * points)[:, None]
    used = np.zeros(bands * points, dtype=bool)
    used[shifted] = True
    kept = np.flatnonzero(used)
    new = np.cumsum(used) - 1
    first_point = np.searchsorted(kept, np.arange(bands + 1) * points)
    first_triangle = np.searchsorted(band, np.arange(bands + 1))
    slices = [(slice(first_point[k], first_point[k + 1]), slice(first_triangle[k], first_triangle[k + 1]))
              for k in range(bands)]
    return kept % points, new[shifted] - first_point[band][:, None], slices


def insert_polyline_points_at_levels(points: np.ndarray, values: np.ndarray,
                                     levels: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Insert points into a polyline where its values, interpolated linearly along each line, cross a level.

    Args:
        points: Coordinates, shape (n, 2).
        values: Values at the points, shape (n,).
        levels: Ascending levels, shape (bands + 1,). Values below the first level belong to the first band, values
            above the last level to the last band.

    Returns:
        The points in order, shape (m, 2), and the band of each line between two neighbours, shape (m - 1,).
    """
    inner = np.asarray(levels, dtype=float)[1:-1]
    low, high = np.minimum(values[:-1], values[1:]), np.maximum(values[:-1], values[1:])
    first = np.searchsorted(inner, low, "right")
    count = np.maximum(np.searchsorted(inner, high, "left") - first, 0)
    line = np.repeat(np.arange(count.size), count)
    step = np.arange(line.size) - np.repeat(np.cumsum(count) - count, count)
    falls = values[1:] < values[:-1]
    crossed = first[line] + np.where(falls[line], count[line] - 1 - step, step)
    fraction = (inner[crossed] - values[line]) / (values[line + 1] - values[line])
    crossings = points[line] + fraction[:, None] * (points[line + 1] - points[line])
    all_points = np.insert(points, line + 1, crossings, axis=0)
    all_values = np.insert(values, line + 1, inner[crossed])
    return all_points, np.searchsorted(inner, np.minimum(all_values[:-1], all_values[1:]), "right")
