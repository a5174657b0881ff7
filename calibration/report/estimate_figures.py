"""Draw the figures of the estimates: profile likelihoods, correlation, and differences between specimens."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import special
from scipy.interpolate import PchipInterpolator

from calibration.fit.fit import Fit, PopulationRecord
from calibration.report.curve_figures import MISFIT
from calibration.report.drawing import (
    COLOURS,
    LAYOUT,
    add_figure_legend_above_panels,
    create_figure,
    create_figure_with_panel_rows,
    distribute_panels_over_rows,
    iterate_line_styles,
)
from calibration.report.fit_text import list_parameters_with_standard_errors
from calibration.report.rounding import (
    NORMAL_95,
    format_error,
    format_interval,
    format_value_and_error,
    use_minus_signs,
)
from calibration.report.symbols import format_mathtext_symbol
from calibration.report.units import ReportUnits
from tissue_sim.laws import find_law

#: Relative standard error above which a combination of parameters is reported as undetermined.
UNDETERMINED = 1e3


def draw_profiles(fit: Fit, bounds: Mapping[str, tuple[float, float]], units: ReportUnits):
    """Draw the profile likelihood of each parameter together with the quadratic approximation.

    The profile is the increase of the sum of squares when one parameter is fixed and all others are fitted again.

    Args:
        fit: a fit with profiles.
        bounds: name -> (low, high), SI, of the parameters that have bounds.
        units: display units.

    Returns:
        The matplotlib figure.
    """
    names = list(fit.profiles)
    figure, grid = create_figure_with_panel_rows(distribute_panels_over_rows(len(names)), LAYOUT.profile_row_height)
    for axes, name in zip(grid, names, strict=True):
        _draw_parameter_profile(axes, fit, name, bounds.get(name), units)
    add_figure_legend_above_panels(figure, LAYOUT.profile_legend_columns)
    return figure


def _draw_parameter_profile(axes, fit: Fit, name: str, bounds: tuple[float, float] | None, units: ReportUnits) -> None:
    """Draw the profile likelihood of one parameter, its quadratic approximation, 95 % interval and bounds."""
    profile, unit = fit.profiles[name], units.choose_display_unit_of_si_unit(fit.units[name])
    values, rises = np.array(profile.values) / unit.size, np.array(profile.rises)
    estimate, error = fit.parameters[name] / unit.size, (fit.standard_errors[name] or 0.0) / unit.size
    ends = [end / unit.size for end in fit.intervals95.get(name) or ()]
    walls = [end / unit.size for end in bounds or ()]
    shown = np.array([values.min(), values.max(), *ends])
    reach = np.ptp(shown) or 6 * error or abs(estimate) or 1.0
    left, right = shown.min() - 0.06 * reach, shown.max() + 0.06 * reach

    # The signed root of the profile is nearly linear: interpolating the root needs few points for a smooth curve.
    distinct, kept = np.unique(values, return_index=True)
    if distinct.size > 1:
        dense = np.linspace(distinct[0], distinct[-1], 200)
        root = np.sign(values - estimate) * np.sqrt(np.maximum(rises, 0.0))
        axes.plot(dense, PchipInterpolator(distinct, root[kept])(dense) ** 2, color=COLOURS[0], lw=2.0, label="profile",
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
        # A distant bound is not drawn: the profile would become too narrow.
        if left - 0.1 * reach < wall < right + 0.1 * reach:
            far = wall + 0.14 * reach * outward
            left, right = min(left, far), max(right, far)
            axes.axvspan(*sorted((wall, far)), fc="none", ec="0.65", hatch="////", lw=0, label="beyond a bound")
            axes.axvline(wall, color="0.35", lw=1.4)
    ceiling = min(max(1.9 * profile.level, 1.05 * rises.max()), 4 * profile.level)
    words = f"\n95 %: {format_interval(ends[0], ends[1], error, estimate)}" if ends else ""
    symbol = format_mathtext_symbol(fit.symbols[name])
    axes.set(xlim=(left, right), ylim=(-0.02 * ceiling, ceiling), xlabel=unit.format_axis_label(symbol),
             ylabel="increase of sum of squares")
    axes.set_title(use_minus_signs(f"{symbol} = {format_value_and_error(estimate, error, unit.name)}{words}"),
                   fontweight="normal")
    axes.locator_params(axis="x", nbins=6)


def draw_unshared_parameters_or_none(fits: Sequence[Fit], units: ReportUnits):
    """Draw the parameters that differ between specimens (or tests, or recordings), one panel per parameter.

    Estimates are drawn with standard errors and 95 % intervals.

    Returns:
        The matplotlib figure; None if all parameters are shared.
    """
    owners_of: dict[str, dict[str, None]] = {}
    for fit in fits:
        for symbol in fit.symbols.values():
            root, _, owner = symbol.partition("@")
            if owner:
                owners_of.setdefault(root, {})[owner] = None
    owners_of = {root: owners for root, owners in owners_of.items() if len(owners) > 1}
    if not owners_of:
        return None
    rows = distribute_panels_over_rows(len(owners_of))
    width = max(rows) * (1.5 + LAYOUT.specimen_width * max(map(len, owners_of.values())))
    figure, grid = create_figure_with_panel_rows(rows, LAYOUT.profile_row_height,
                                                 float(np.clip(width, LAYOUT.width / 2, LAYOUT.width)))
    for axes, (root, owners) in zip(grid, owners_of.items(), strict=True):
        _draw_parameter_by_specimen(axes, fits, root, list(owners), units)
    add_figure_legend_above_panels(figure)
    return figure


def _draw_parameter_by_specimen(axes, fits: Sequence[Fit], root: str, owners: Sequence[str],
                                units: ReportUnits) -> None:
    """Draw one parameter of all specimens (tests, recordings) that own a value of the parameter."""
    having = [(fit, style) for fit, style in zip(fits, iterate_line_styles(), strict=False)
              if any(symbol.startswith(f"{root}@") for symbol in fit.symbols.values())]
    for rank, (fit, style) in enumerate(having):
        names = {symbol: name for name, symbol in fit.symbols.items()}
        unit = units.choose_display_unit_of_si_unit(fit.units[names[f"{root}@{owners[0]}"]])
        for i, owner in enumerate(owners):
            name = names.get(f"{root}@{owner}")
            if name is None:
                continue
            x = i + 0.5 * ((rank + 0.5) / len(having) - 0.5)
            value, error = fit.parameters[name] / unit.size, (fit.standard_errors[name] or 0.0) / unit.size
            ends = [end / unit.size for end in fit.intervals95.get(name) or ()]
            if ends:
                axes.plot([x, x], ends, color=style["color"], lw=1.2, label="95 % interval")
            axes.errorbar(x, value, error, fmt="o", color=style["color"], lw=4, ms=6, label=find_law(fit.law).title)
    crowded = sum(map(len, owners)) > LAYOUT.max_label_characters
    axes.set_xticks(range(len(owners)), owners, rotation=35 if crowded else 0, ha="right" if crowded else "center")
    axes.set(xlim=(-0.6, len(owners) - 0.4), ylabel=unit.format_axis_label(format_mathtext_symbol(root)))
    axes.grid(visible=False, axis="x")


def draw_growing_window_parameters_or_none(fit: Fit, units: ReportUnits):
    """Draw the parameters fitted to the first part of the strain of each test, over the size of this part.

    The estimates from all data are drawn as a band.

    Returns:
        The matplotlib figure; None if there are fewer than two windows or no free parameter.
    """
    names = [name for name in list_parameters_with_standard_errors(fit)
             if all(name in window.parameters for window in fit.windows)]
    if len(fit.windows) < 2 or not names:
        return None
    percentages = 100.0 * np.array([window.share for window in fit.windows])
    figure, grid = create_figure_with_panel_rows(distribute_panels_over_rows(len(names)), LAYOUT.window_row_height)
    for axes, name in zip(grid, names, strict=True):
        unit = units.choose_display_unit_of_si_unit(fit.units[name])
        value, error = fit.parameters[name] / unit.size, (fit.standard_errors[name] or 0.0) / unit.size
        axes.axhspan(value - error, value + error, color=COLOURS[0], alpha=0.2, lw=0,
                     label="all data, ± standard error")
        axes.plot(percentages, [window.parameters[name] / unit.size for window in fit.windows], "o-", color=COLOURS[0],
                  label="first part of the strain only")
        axes.set(xlabel="fitted part of the largest strain [%]",
                 ylabel=unit.format_axis_label(format_mathtext_symbol(fit.symbols[name])))
    add_figure_legend_above_panels(figure)
    return figure


def draw_parameter_correlation_or_none(fit: Fit, units: ReportUnits):
    """Draw the correlation matrix of the free parameters and how well the tests determine them jointly.

    For two parameters the second panel shows the joint confidence region, for more the poorly determined combinations.

    Returns:
        The matplotlib figure; None with fewer than two free parameters.
    """
    names = list_parameters_with_standard_errors(fit)
    if len(names) < 2:
        return None
    indices = [fit.covariance.order.index(name) for name in names]
    matrix = np.array(fit.correlation)[np.ix_(indices, indices)]
    symbols, alone = [format_mathtext_symbol(fit.symbols[name])
                      for name in names], len(names) > 2 and not fit.directions
    figure = create_figure(LAYOUT.width / (2 if alone else 1),
                           LAYOUT.correlation_height + 0.35 * max(0, len(names) - 4))
    left, *right = figure.subplots(1, 1 if alone else 2, squeeze=False, width_ratios=(1,) if alone else (1, 1.45)).flat
    _draw_correlation_matrix(figure, left, symbols, matrix)
    for axes in right:
        if len(names) == 2:
            _draw_two_parameter_confidence_regions(axes, fit, names, units)
        else:
            _draw_poorly_determined_combinations(axes, fit, names)
    add_figure_legend_above_panels(figure)
    return figure


def _draw_correlation_matrix(figure, axes, symbols: Sequence[str], matrix: np.ndarray) -> None:
    """Draw a correlation matrix as coloured cells with numbers, and its colour bar."""
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
    long = sum(map(len, symbols)) > LAYOUT.max_label_characters + 6 * len(symbols)
    axes.set_xticks(range(len(symbols)), symbols, rotation=35 if long else 0, ha="right" if long else "center")
    axes.set_yticks(range(len(symbols)), symbols)
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    axes.tick_params(length=0)
    figure.colorbar(image, ax=axes, shrink=0.85, label="correlation").outline.set_visible(False)


def _draw_two_parameter_confidence_regions(axes, fit: Fit, names: Sequence[str], units: ReportUnits) -> None:
    """Draw the joint 68 % and 95 % confidence regions of two parameters, and the 95 % interval of each."""
    scales = [units.choose_display_unit_of_si_unit(fit.units[name]) for name in names]
    indices = [fit.covariance.order.index(name) for name in names]
    sizes = np.array([unit.size for unit in scales])
    centre = np.array([fit.parameters[name] for name in names]) / sizes
    values, vectors = np.linalg.eigh(np.array(fit.covariance.matrix)[np.ix_(indices, indices)] / np.outer(sizes, sizes))
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    angle = np.linspace(0.0, 2 * np.pi, 200)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    for confidence, alpha in ((0.95, 0.16), (0.68, 0.3)):
        x, y = centre[:, None] + np.sqrt(special.chdtri(2, 1 - confidence)) * root @ circle
        axes.fill(x, y, color=COLOURS[0], alpha=alpha, lw=0, label=f"{confidence * 100:.0f} % joint region")
        axes.plot(x, y, color=COLOURS[0], lw=1.2)
    axes.plot(*centre, "D", color=COLOURS[0], ms=6)
    for name, size, line in zip(names, sizes, (axes.axvline, axes.axhline), strict=True):
        for end in fit.intervals95.get(name) or ():
            line(end / size, color=MISFIT, lw=1.2, ls=(0, (5, 3)))
    axes.plot([], [], color=MISFIT, lw=1.2, ls=(0, (5, 3)), label="95 % interval of each")
    labels = [unit.format_axis_label(format_mathtext_symbol(fit.symbols[name])) for name,
              unit in zip(names, scales, strict=True)]
    axes.set(xlabel=labels[0], ylabel=labels[1])
    axes.locator_params(nbins=7)


def _draw_poorly_determined_combinations(axes, fit: Fit, names: Sequence[str]) -> None:
    """Draw up to four parameter combinations with the largest relative errors as bars, one bar per parameter."""
    directions = fit.directions[:4]
    height = 0.8 / len(directions)
    for k, (direction, style) in enumerate(zip(directions, iterate_line_styles(), strict=False)):
        y = np.arange(len(names)) - 0.4 + (k + 0.5) * height
        error = direction.relative_error
        axes.barh(y, [direction.shares.get(name, 0.0) for name in names], 0.88 * height, color=style["color"],
                  label=f"known to ± {format_error(100 * error)} %" if error < UNDETERMINED else "undetermined")
    axes.axvline(0.0, color="0.3", lw=0.8)
    axes.set_yticks(range(len(names)), [format_mathtext_symbol(fit.symbols[name]) for name in names])
    axes.set(xlim=(-1.05, 1.05), xlabel="relative change of each parameter in the combination")
    axes.set_title("Least determined combinations")
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")


def draw_population_figure(fit: Fit, population: PopulationRecord, units: ReportUnits):
    """Draw each parameter of each specimen: separate estimate, shrinkage estimate and mean of the population."""
    specimens = len(population.specimens)
    rows = distribute_panels_over_rows(len(population.order))
    figure, grid = create_figure_with_panel_rows(rows, 1.5 + 0.3 * specimens)
    firsts = {sum(rows[:row]) for row in range(len(rows))}
    for k, axes in enumerate(grid):
        _draw_population_parameter(axes, fit, population, k, units)
        axes.set_yticks(range(specimens), population.specimens if k in firsts else [])
        axes.set_ylim(specimens - 0.5, -0.5)
    add_figure_legend_above_panels(figure)
    return figure


def _draw_population_parameter(axes, fit: Fit, population: PopulationRecord, k: int, units: ReportUnits) -> None:
    """Draw the parameter with index `k` of all specimens: estimates, population mean, range of further specimens."""
    name = f"{population.order[k]}@{population.specimens[0]}"
    unit = units.choose_display_unit_of_si_unit(fit.units[name])
    rows = np.arange(len(population.specimens))
    axes.axvspan(*(end / unit.size for end in population.next_specimen[k]), color="0.93", lw=0,
                 label="95 % of further specimens")
    axes.axvspan(*(end / unit.size for end in population.mean_intervals[k]), color=COLOURS[0], alpha=0.2, lw=0,
                 label="mean, 95 %")
    axes.axvline(population.mean[k] / unit.size, color=COLOURS[0], lw=1.4)
    values, errors = (np.array(getattr(population, key))[:, k] / unit.size for key in ("estimates", "errors"))
    axes.errorbar(values, rows, xerr=NORMAL_95 * errors, fmt="o", color=COLOURS[1], capsize=2.5, lw=1.2, ms=5,
                  label="specimen alone, 95 %")
    axes.plot(np.array(population.shrunken)[:, k] / unit.size, rows, "D", mfc="white", mec="0.2", ms=4, zorder=5,
              label="using the other specimens")
    axes.set_xlabel(unit.format_axis_label(format_mathtext_symbol(fit.symbols[name].partition("@")[0])))
