"""Pictures of the estimates of an inverse calibration: profile likelihoods and correlation, as PNG."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats
from scipy.interpolate import PchipInterpolator

from calibration.fit.fit import Fit, Profile
from calibration.report.curve_figures import MISFIT
from calibration.report.drawing import COLOURS, STYLE, line_styles, new_figure, to_png
from calibration.report.figures import WIDTH
from calibration.report.page import free_parameters
from calibration.report.pressure import pressure_unit

_PANELS = 3
#: Pressures are drawn in Pa, as campaigns state them, up to here.
_MOST_PA = 1e5
#: Relative standard error from which on a combination is not told at all.
NOT_TOLD = 1e3


def draw_profiles(fit: Fit, bounds: Mapping[str, tuple[float, float]]) -> bytes:
    """Rise of the sum of squares along each parameter, all others fitted again; beside it the quadratic one.

    Args:
        fit: with profiles. bounds: name -> (low, high), SI, where the parameter has them.
    """
    import matplotlib

    names = list(fit.profiles)
    columns = min(_PANELS, max(2, len(names)))
    rows = -(-len(names) // columns)
    with matplotlib.rc_context(STYLE):
        figure = new_figure(WIDTH, 3.5 * rows)
        grid = figure.subplots(rows, columns, squeeze=False)
        for axes, name in zip(grid.flat, names, strict=False):
            _draw_profile(axes, fit, name, bounds.get(name))
        for axes in grid.flat[len(names):]:
            axes.set_visible(False)
        for axes in grid[:, 0]:
            axes.set_ylabel("rise of the sum of squares")
        return to_png(figure)


def _draw_profile(axes, fit: Fit, name: str, bounds: tuple[float, float] | None) -> None:
    profile: Profile = fit.profiles[name]
    symbol, (unit, size) = fit.symbols[name], unit_of(fit, name)
    values, rises = np.array(profile.values) / size, np.array(profile.rises)
    estimate, error = fit.parameters[name] / size, fit.standard_errors[name]
    ends = [end / size for end in fit.intervals95.get(name) or ()]
    walls = [end / size for end in bounds or ()]
    shown = np.array([values.min(), values.max(), *ends])
    reach = np.ptp(shown) or 6 * (error or 0.0) / size or abs(estimate) or 1.0
    left, right = shown.min() - 0.06 * reach, shown.max() + 0.06 * reach

    # The signed root is nearly straight: through it, few points make a smooth curve.
    places, kept = np.unique(values, return_index=True)
    if places.size > 1:
        along = np.linspace(places[0], places[-1], 200)
        root = np.sign(values - estimate) * np.sqrt(np.maximum(rises, 0.0))
        axes.plot(along, PchipInterpolator(places, root[kept])(along) ** 2, color=COLOURS[0], lw=2.0, label="profile",
                  zorder=3)
    axes.plot(values, rises, "o", color=COLOURS[0], ms=3.5, zorder=3)
    axes.plot([estimate], [0.0], "D", color=COLOURS[0], ms=7, zorder=5, clip_on=False)
    if error:
        x = np.linspace(left, right, 200)
        axes.plot(x, ((x - estimate) * size / error) ** 2, "--", color="0.4", lw=1.4, label="quadratic", zorder=4)
    axes.axhline(profile.level, color="0.3", lw=0.9, ls=":", label="95 % level")
    if ends:
        axes.plot(ends, [profile.level] * 2, "|-", color=MISFIT, lw=3, ms=13, mew=2, zorder=4, label="95 % interval")
    for end, outward in zip(ends, (-1, 1), strict=False):
        if not any(np.isclose(end, wall) for wall in walls):
            axes.annotate(f"{end:.4g}", (end, profile.level), (6 * outward, 6), textcoords="offset points", fontsize=9,
                          ha="left" if outward > 0 else "right", color="#8a3c00", zorder=6,
                          bbox={"fc": "white", "ec": "none", "pad": 0.8, "alpha": 0.85})
    for wall, outward in zip(walls, (-1, 1), strict=False):
        # A bound far away would squeeze the profile.
        if left - 0.1 * reach < wall < right + 0.1 * reach:
            far = wall + 0.14 * reach * outward
            left, right = min(left, far), max(right, far)
            axes.axvspan(*sorted((wall, far)), fc="none", ec="0.65", hatch="////", lw=0)
            axes.axvline(wall, color="0.35", lw=1.4)
            axes.annotate(f"bound {wall:.4g}", (wall, 0.97), (4 * outward, 0), xycoords=axes.get_xaxis_transform(),
                          textcoords="offset points", rotation=90, va="top", fontsize=8.5, color="0.25",
                          ha="left" if outward > 0 else "right", bbox={"fc": "white", "ec": "none", "pad": 1.0})
    ceiling = min(max(1.9 * profile.level, 1.05 * rises.max()), 4 * profile.level)
    axes.set(xlim=(left, right), ylim=(-0.02 * ceiling, ceiling), xlabel=f"{symbol} [{unit}]" if unit else symbol)
    axes.legend(loc="upper center", fontsize=8, framealpha=0.9, frameon=True, edgecolor="none")


def unit_of(fit: Fit, name: str) -> tuple[str, float]:
    """Unit in which a parameter is read and drawn, and its size in SI."""
    unit = fit.unit(name)
    large = unit == "Pa" and abs(fit.parameters[name]) >= _MOST_PA
    return pressure_unit(fit.parameters[name]) if large else (unit, 1.0)


def draw_correlation(fit: Fit) -> bytes | None:
    """Correlation of the free parameters in numbers and, of two, their joint region; of more, the directions that the
    tests tell poorly. None with fewer than two free parameters."""
    import matplotlib

    names = free_parameters(fit)
    if len(names) < 2:
        return None
    place = [fit.covariance.order.index(name) for name in names]
    matrix = np.array(fit.correlation)[np.ix_(place, place)]
    with matplotlib.rc_context(STYLE):
        figure = new_figure(WIDTH, 4.2 + 0.35 * max(0, len(names) - 4))
        left, right = figure.subplots(1, 2, width_ratios=(1, 1.45))
        _draw_matrix(figure, left, [fit.symbols[name] for name in names], matrix)
        if len(names) == 2:
            _draw_ellipse(right, fit, names)
        else:
            _draw_directions(right, fit, names)
        return to_png(figure)


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
    long = max(map(len, symbols)) > 8
    axes.set_xticks(range(len(symbols)), symbols, rotation=35 if long else 0, ha="right" if long else "center")
    axes.set_yticks(range(len(symbols)), symbols)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    figure.colorbar(image, ax=axes, shrink=0.85, label="correlation").outline.set_visible(False)


def _draw_ellipse(axes, fit: Fit, names: Sequence[str]) -> None:
    scales = [unit_of(fit, name) for name in names]
    place = [fit.covariance.order.index(name) for name in names]
    sizes = np.array([size for _, size in scales])
    centre = np.array([fit.parameters[name] for name in names]) / sizes
    values, vectors = np.linalg.eigh(np.array(fit.covariance.matrix)[np.ix_(place, place)] / np.outer(sizes, sizes))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    turn = np.linspace(0.0, 2 * np.pi, 200)
    circle = np.stack([np.cos(turn), np.sin(turn)])
    for share, alpha in ((0.95, 0.16), (0.68, 0.3)):
        x, y = centre[:, None] + np.sqrt(stats.chi2.ppf(share, 2)) * root @ circle
        axes.fill(x, y, color=COLOURS[0], alpha=alpha, lw=0, label=f"{share * 100:.0f} % of both together")
        axes.plot(x, y, color=COLOURS[0], lw=1.2)
    axes.plot(*centre, "D", color=COLOURS[0], ms=6)
    for name, size, line in zip(names, sizes, (axes.axvline, axes.axhline), strict=True):
        for end in fit.intervals95.get(name) or ():
            line(end / size, color=MISFIT, lw=1.2, ls=(0, (5, 3)))
    axes.plot([], [], color=MISFIT, lw=1.2, ls=(0, (5, 3)), label="95 % interval of each")
    symbols = [fit.symbols[name] for name in names]
    labels = [f"{symbol} [{unit}]" if unit else symbol for symbol, (unit, _) in zip(symbols, scales, strict=True)]
    axes.set(xlabel=labels[0], ylabel=labels[1])
    axes.locator_params(nbins=7)
    axes.legend(loc="best", fontsize=9, frameon=True, framealpha=0.92, edgecolor="none")


def _draw_directions(axes, fit: Fit, names: Sequence[str]) -> None:
    directions = fit.directions[:4]
    if not directions:
        axes.axis("off")
        axes.text(0.5, 0.5, "no combination of the parameters\nis told poorly", ha="center", va="center", color="0.35",
                  fontsize=11)
        return
    height = 0.8 / len(directions)
    for k, (direction, look) in enumerate(zip(directions, line_styles(), strict=False)):
        y = np.arange(len(names)) - 0.4 + (k + 0.5) * height
        error = direction.relative_error
        axes.barh(y, [direction.shares.get(name, 0.0) for name in names], 0.88 * height, color=look["color"],
                  label=f"± {100 * error:.3g} %" if error < NOT_TOLD else "not told at all")
    axes.axvline(0.0, color="0.3", lw=0.8)
    axes.set_yticks(range(len(names)), [fit.symbols[name] for name in names])
    axes.set(xlim=(-1.05, 1.05), xlabel="share of each parameter's relative change")
    axes.set_title("combinations told most poorly", loc="left", fontsize=10, fontweight="bold")
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.legend(loc="best", fontsize=9)
