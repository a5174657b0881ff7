"""Pictures of the estimates: profile likelihoods, correlation, and what differs between specimens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import special
from scipy.interpolate import PchipInterpolator

from calibration.fit.fit import Fit
from calibration.report.curve_figures import MISFIT
from calibration.report.drawing import COLOURS, WIDTH, in_rows, legend_above, line_styles, new_figure, panels
from calibration.report.page import free_parameters, with_minus
from calibration.report.rounding import error_text, interval_text, value_and_error
from calibration.report.symbols import math_symbol
from calibration.report.units import Units
from tissue_sim.laws import find_law

#: Inches of a specimen in a panel.
_PLACE = 0.9
#: Letters of the names below an axis from which on they are turned.
_CROWDED = 40
#: Relative standard error from which on a combination is not told at all.
NOT_TOLD = 1e3


def draw_profiles(fit: Fit, bounds: Mapping[str, tuple[float, float]], units: Units):
    """Rise of the sum of squares along each parameter, all others fitted again; beside it the quadratic one.

    Args:
        fit: with profiles. bounds: name -> (low, high), SI, where the parameter has them.
    """
    names = list(fit.profiles)
    figure, grid = panels(in_rows(len(names)), 3.1)
    for axes, name in zip(grid, names, strict=True):
        _draw_profile(axes, fit, name, bounds.get(name), units)
    legend_above(figure, 6)
    return figure


def _draw_profile(axes, fit: Fit, name: str, bounds: tuple[float, float] | None, units: Units) -> None:
    profile, unit = fit.profiles[name], units.of_parameter(fit.units[name])
    values, rises = np.array(profile.values) / unit.size, np.array(profile.rises)
    estimate, error = fit.parameters[name] / unit.size, (fit.standard_errors[name] or 0.0) / unit.size
    ends = [end / unit.size for end in fit.intervals95.get(name) or ()]
    walls = [end / unit.size for end in bounds or ()]
    shown = np.array([values.min(), values.max(), *ends])
    reach = np.ptp(shown) or 6 * error or abs(estimate) or 1.0
    left, right = shown.min() - 0.06 * reach, shown.max() + 0.06 * reach

    # The signed root is nearly straight: through it, few points make a smooth curve.
    places, kept = np.unique(values, return_index=True)
    if places.size > 1:
        along = np.linspace(places[0], places[-1], 200)
        root = np.sign(values - estimate) * np.sqrt(np.maximum(rises, 0.0))
        axes.plot(along, PchipInterpolator(places, root[kept])(along) ** 2, color=COLOURS[0], lw=2.0, label="profile",
                  zorder=3)
    axes.plot(values, rises, "o", color=COLOURS[0], ms=3.5, zorder=3)
    axes.plot([estimate], [0.0], "D", color=COLOURS[0], ms=7, zorder=5, clip_on=False, label="estimate")
    if error:
        x = np.linspace(left, right, 200)
        axes.plot(x, ((x - estimate) / error) ** 2, "--", color="0.4", lw=1.4, label="quadratic", zorder=4)
    axes.axhline(profile.level, color="0.3", lw=0.9, ls=":", label="95 % level")
    if ends:
        axes.plot(ends, [profile.level] * 2, "|-", color=MISFIT, lw=3, ms=13, mew=2, zorder=4, label="95 % interval")
    for wall, outward in zip(walls, (-1, 1), strict=False):
        # A bound far away would squeeze the profile.
        if left - 0.1 * reach < wall < right + 0.1 * reach:
            far = wall + 0.14 * reach * outward
            left, right = min(left, far), max(right, far)
            axes.axvspan(*sorted((wall, far)), fc="none", ec="0.65", hatch="////", lw=0, label="beyond a bound")
            axes.axvline(wall, color="0.35", lw=1.4)
    ceiling = min(max(1.9 * profile.level, 1.05 * rises.max()), 4 * profile.level)
    words = f"\n95 %: {interval_text(ends[0], ends[1], error, estimate)}" if ends else ""
    symbol = math_symbol(fit.symbols[name])
    axes.set(xlim=(left, right), ylim=(-0.02 * ceiling, ceiling), xlabel=unit.label(symbol),
             ylabel="rise of sum of squares")
    axes.set_title(with_minus(f"{symbol} = {value_and_error(estimate, error, unit.name)}{words}"), fontweight="normal")
    axes.locator_params(axis="x", nbins=6)


def draw_specimens(fits: Sequence[Fit], units: Units):
    """What differs between specimens (or tests, or recordings): estimates with standard errors and 95 % intervals, a
    panel a parameter. None where all is shared."""
    several: dict[str, dict[str, None]] = {}
    for fit in fits:
        for symbol in fit.symbols.values():
            root, _, place = symbol.partition("@")
            if place:
                several.setdefault(root, {})[place] = None
    several = {root: places for root, places in several.items() if len(places) > 1}
    if not several:
        return None
    rows = in_rows(len(several))
    width = max(rows) * (1.5 + _PLACE * max(map(len, several.values())))
    figure, grid = panels(rows, 3.1, float(np.clip(width, WIDTH / 2, WIDTH)))
    for axes, (root, places) in zip(grid, several.items(), strict=True):
        _draw_places(axes, fits, root, list(places), units)
    legend_above(figure)
    return figure


def _draw_places(axes, fits: Sequence[Fit], root: str, places: Sequence[str], units: Units) -> None:
    having = [(fit, look) for fit, look in zip(fits, line_styles(), strict=False)
              if any(symbol.startswith(f"{root}@") for symbol in fit.symbols.values())]
    for rank, (fit, look) in enumerate(having):
        names = {symbol: name for name, symbol in fit.symbols.items()}
        unit = units.of_parameter(fit.units[names[f"{root}@{places[0]}"]])
        for i, place in enumerate(places):
            name = names.get(f"{root}@{place}")
            if name is None:
                continue
            x = i + 0.5 * ((rank + 0.5) / len(having) - 0.5)
            value, error = fit.parameters[name] / unit.size, (fit.standard_errors[name] or 0.0) / unit.size
            ends = [end / unit.size for end in fit.intervals95.get(name) or ()]
            if ends:
                axes.plot([x, x], ends, color=look["color"], lw=1.2, label="95 % interval")
            axes.errorbar(x, value, error, fmt="o", color=look["color"], lw=4, ms=6, label=find_law(fit.law).title)
    crowded = sum(map(len, places)) > _CROWDED
    axes.set_xticks(range(len(places)), places, rotation=35 if crowded else 0, ha="right" if crowded else "center")
    axes.set(xlim=(-0.6, len(places) - 0.4), ylabel=unit.label(math_symbol(root)))
    axes.grid(visible=False, axis="x")


def draw_windows(fit: Fit, units: Units):
    """Parameters from the first parts of the strain of each test, beside those of all of it; None without any."""
    names = [name for name in free_parameters(fit) if all(name in window.parameters for window in fit.windows)]
    if len(fit.windows) < 2 or not names:
        return None
    shares = 100.0 * np.array([window.share for window in fit.windows])
    figure, grid = panels(in_rows(len(names)), 2.6)
    for axes, name in zip(grid, names, strict=True):
        unit = units.of_parameter(fit.units[name])
        value, error = fit.parameters[name] / unit.size, (fit.standard_errors[name] or 0.0) / unit.size
        axes.axhspan(value - error, value + error, color=COLOURS[0], alpha=0.2, lw=0,
                     label="all data, ± standard error")
        axes.plot(shares, [window.parameters[name] / unit.size for window in fit.windows], "o-", color=COLOURS[0],
                  label="from a part of the strain")
        axes.set(xlabel="part of the largest strain [%]", ylabel=unit.label(math_symbol(fit.symbols[name])))
    legend_above(figure)
    return figure


def draw_correlation(fit: Fit, units: Units):
    """Correlation of the free parameters in numbers and, of two, their joint region; of more, the directions that the
    tests tell poorly. None with fewer than two free parameters."""
    names = free_parameters(fit)
    if len(names) < 2:
        return None
    place = [fit.covariance.order.index(name) for name in names]
    matrix = np.array(fit.correlation)[np.ix_(place, place)]
    symbols, alone = [math_symbol(fit.symbols[name]) for name in names], len(names) > 2 and not fit.directions
    figure = new_figure(WIDTH / 2 if alone else WIDTH, 4.2 + 0.35 * max(0, len(names) - 4))
    left, *right = figure.subplots(1, 1 if alone else 2, squeeze=False, width_ratios=(1,) if alone else (1, 1.45)).flat
    _draw_matrix(figure, left, symbols, matrix)
    for axes in right:
        if len(names) == 2:
            _draw_ellipse(axes, fit, names, units)
        else:
            _draw_directions(axes, fit, names)
    legend_above(figure)
    return figure


def _draw_matrix(figure, axes, symbols: Sequence[str], matrix: np.ndarray) -> None:
    from matplotlib.colors import LinearSegmentedColormap

    shades = LinearSegmentedColormap.from_list("signed", [
        "#D55E00", "#f6c9a4", "#fafafa", "#a5cbe4", "#0072B2"]).with_extremes(bad="#e8eaed")
    image = axes.imshow(np.where(np.eye(len(symbols), dtype=bool), np.nan, matrix), cmap=shades, vmin=-1, vmax=1)
    for (i, j), value in np.ndenumerate(matrix):
        digits = 4 if abs(value) >= 0.995 and i != j else 2
        words = f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "−")
        axes.text(j, i, "1" if i == j else words, ha="center", va="center",
                  color="white" if abs(value) > 0.75 and i != j else "0.15", fontsize=13 if len(symbols) < 5 else 8,
                  fontweight="bold" if i != j and abs(value) > 0.9 else "normal")
    for edge in np.arange(len(symbols) - 1) + 0.5:
        axes.axvline(edge, color="white", lw=2)
        axes.axhline(edge, color="white", lw=2)
    long = sum(map(len, symbols)) > _CROWDED + 6 * len(symbols)
    axes.set_xticks(range(len(symbols)), symbols, rotation=35 if long else 0, ha="right" if long else "center")
    axes.set_yticks(range(len(symbols)), symbols)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    figure.colorbar(image, ax=axes, shrink=0.85, label="correlation").outline.set_visible(False)


def _draw_ellipse(axes, fit: Fit, names: Sequence[str], units: Units) -> None:
    scales = [units.of_parameter(fit.units[name]) for name in names]
    place = [fit.covariance.order.index(name) for name in names]
    sizes = np.array([unit.size for unit in scales])
    centre = np.array([fit.parameters[name] for name in names]) / sizes
    values, vectors = np.linalg.eigh(np.array(fit.covariance.matrix)[np.ix_(place, place)] / np.outer(sizes, sizes))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    turn = np.linspace(0.0, 2 * np.pi, 200)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    for share, alpha in ((0.95, 0.16), (0.68, 0.3)):
        x, y = centre[:, None] + np.sqrt(special.chdtri(2, 1 - share)) * root @ circle
        axes.fill(x, y, color=COLOURS[0], alpha=alpha, lw=0, label=f"{share * 100:.0f} % of both together")
        axes.plot(x, y, color=COLOURS[0], lw=1.2)
    axes.plot(*centre, "D", color=COLOURS[0], ms=6)
    for name, size, line in zip(names, sizes, (axes.axvline, axes.axhline), strict=True):
        for end in fit.intervals95.get(name) or ():
            line(end / size, color=MISFIT, lw=1.2, ls=(0, (5, 3)))
    axes.plot([], [], color=MISFIT, lw=1.2, ls=(0, (5, 3)), label="95 % interval of each")
    labels = [unit.label(math_symbol(fit.symbols[name])) for name, unit in zip(names, scales, strict=True)]
    axes.set(xlabel=labels[0], ylabel=labels[1])
    axes.locator_params(nbins=7)


def _draw_directions(axes, fit: Fit, names: Sequence[str]) -> None:
    directions = fit.directions[:4]
    height = 0.8 / len(directions)
    for k, (direction, look) in enumerate(zip(directions, line_styles(), strict=False)):
        y = np.arange(len(names)) - 0.4 + (k + 0.5) * height
        error = direction.relative_error
        axes.barh(y, [direction.shares.get(name, 0.0) for name in names], 0.88 * height, color=look["color"],
                  label=f"known to ± {error_text(100 * error)} %" if error < NOT_TOLD else "not told at all")
    axes.axvline(0.0, color="0.3", lw=0.8)
    axes.set_yticks(range(len(names)), [math_symbol(fit.symbols[name]) for name in names])
    axes.set(xlim=(-1.05, 1.05), xlabel="share of each parameter's relative change")
    axes.set_title("Combinations told most poorly")
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
