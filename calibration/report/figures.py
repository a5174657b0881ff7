"""Draw the figures of a calibration: misfit by region, predictions, convergence, profile likelihoods, specimens.

matplotlib is imported on use; every drawing function returns a figure.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import shorten

import numpy as np
from scipy import special
from scipy.interpolate import PchipInterpolator

from calibration.campaign.campaign import Test
from calibration.fit.fit import Fit, PopulationRecord, Prediction
from calibration.report.curve_figures import MISFIT, describe_region, format_p_value_text
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
from calibration.report.quantities import (
    NORMAL_95,
    ReportUnits,
    format_error,
    format_interval,
    format_mathtext_symbol,
    format_value_and_error,
    use_minus_signs,
)
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


#: Standard errors above which a misfit is significant (two-sided 5 %).
_SIGNIFICANT = float(-special.ndtri(0.025))
#: Tick marks of ratios that are all positive.
_POSITIVE_TICKS = (1e-3, 0.01, 0.1, 0.2, 0.5, 1, 2, 5, 10, 100, 1e3)
#: Tick marks of ratios of both signs.
_SIGNED_TICKS = (-1e3, -100, -10, -1, 0, 1, 10, 100, 1e3)


def draw_region_misfit_map(fits: Sequence[Fit], tests: Sequence[Test], units: ReportUnits):
    """Draw the smooth misfit in each region of each test as a cell, coloured by its significance in standard errors.

    Args:
        fits: fits of all laws; each fit with regions gets one row per test, in this order.
        tests: tests in the order of the figure.
        units: display units.

    Returns:
        The matplotlib figure.
    """
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    limit = _SIGNIFICANT / LAYOUT.darkest_misfit
    shades = LinearSegmentedColormap.from_list("misfit", [
        (0.0, "#f4f8fb"), (limit - 1e-6, "#bcd7ea"), (limit, "#fbd3ae"), (0.7, "#e07b39"), (1.0, "#9c3a00")])
    norm = Normalize(0.0, LAYOUT.darkest_misfit)
    fits = [fit for fit in fits if fit.regions]
    tests = [test for test in tests if any(r.test == test.name for fit in fits for r in fit.regions)]
    blocks = len(tests) * (0.62 + 0.4 * len(fits))
    figure, (axes,) = create_figure_with_panel_rows([1], max(blocks + 0.3, 2.2))
    axes.grid(visible=False)
    top, ticks, names = 0.0, [], []
    for test in tests:
        rows = [[r for r in fit.regions if r.test == test.name] for fit in fits]
        named = max(rows, key=len)
        font, gap = 9.0 * min(1.0, 9 / len(named)), "  " if len(named) < LAYOUT.two_line_regions else "\n"
        axes.text(-0.008, top - 0.34, test.name, fontweight="bold", va="center", ha="right")
        for j, region in enumerate(named):
            where = describe_region(region, test, units).replace(" from ", f"{gap[:1]}from ")
            axes.text((j + 0.5) / len(named), top - 0.34, where,
                      va="center", ha="center", fontsize=font, color="0.3")
        for fit, row in zip(fits, rows, strict=True):
            for j, region in enumerate(row):
                deviate = min(float(-special.ndtri(region.p / 2)), LAYOUT.darkest_misfit)
                low, high = top - 0.95, top - 0.55
                axes.fill_between([j / len(row), (j + 1) / len(row)], low, high, color=shades(norm(deviate)),
                                  ec="white", lw=2)
                axes.text((j + 0.5) / len(row), (low + high) / 2,
                          f"{units.get_load_unit(test).format_quantity(region.misfit_N, 2)},{gap}"
                          f"{format_p_value_text(region.p)}",
                          ha="center", va="center", fontsize=font, color="white" if deviate > 4.2 else "0.1",
                          fontweight="normal" if region.adequate else "bold")
            ticks.append(top - 0.75)
            names.append(find_law(fit.law).title)
            top -= 0.4
        top -= 0.62
    axes.set(xlim=(0, 1), ylim=(top - 0.05, 0.0), xticks=[], yticks=ticks, yticklabels=names)
    axes.tick_params(length=0)
    axes.spines[:].set_visible(False)
    bar = figure.colorbar(ScalarMappable(norm, shades), ax=axes, pad=0.01, fraction=0.022, aspect=18)
    bar.set_label("standard errors")
    bar.set_ticks([0, _SIGNIFICANT, 4, LAYOUT.darkest_misfit], labels=["0", "2", "4", f"{LAYOUT.darkest_misfit:g} +"])
    bar.outline.set_visible(False)
    return figure


def draw_prediction_errors(predictions: Sequence[Prediction], tests: Sequence[Test], units: ReportUnits):
    """Draw the prediction error of each law in each test that it was not fitted to, compared with chance.

    Args:
        predictions: predictions, laws in the order of the figure.
        tests: tests of the campaign.
        units: display units.

    Returns:
        The matplotlib figure.
    """
    from matplotlib.patches import Patch

    laws = list(dict.fromkeys(p.law for p in predictions))
    several = {p.test: len(p.mean_of) for p in predictions if p.mean_of}
    cases = list(dict.fromkeys((p.test, tuple(p.fitted)) for p in predictions))
    by_name = {test.name: test for test in tests}
    height, style_of = 0.8 / len(laws), dict(zip(laws, iterate_line_styles(), strict=False))
    figure, (axes,) = create_figure_with_panel_rows([1], 1.1 + max(0.3 * len(laws) + 0.25, 0.7) * len(cases))
    known = [p.percent for p in predictions if p.percent is not None] or [1.0]
    # A very poor law is cut off: its bar would make all others too short.
    limit = min(max(known), 6 * max((p.percent for p in predictions if p.percent is not None and p.law == laws[0]),
                                    default=max(known)))
    expected = None
    for p in predictions:
        y = cases.index((p.test, tuple(p.fitted))) - 0.4 + (laws.index(p.law) + 0.5) * height
        if p.percent is None:
            axes.text(0.004 * limit, y, shorten(f"{find_law(p.law).title}: none ({p.note})", LAYOUT.note_characters),
                      va="center", fontsize=9, color="0.35")
            continue
        length = min(p.percent, 1.02 * limit)
        axes.barh(y, length, 0.86 * height, color=style_of[p.law]["color"], alpha=0.85, lw=0)
        force = units.force.format_quantity(p.RMSE_N, 2) if p.RMSE_N is not None else \
            "" if p.RMSE_Pa is None else units.pressure.format_quantity(p.RMSE_Pa, 2)
        end = length
        if p.expected_N is not None and p.RMSE_N:
            chance = min(p.percent * p.expected_N / p.RMSE_N, limit)
            # Keep the mark clear of the number.
            end = chance if length < chance < length + 0.1 * limit else length
            expected, = axes.plot([chance, chance], [y - 0.46 * height, y + 0.46 * height], color="0.1", lw=2.4)
        axes.text(end + 0.008 * limit, y,
                  f"{'▸ ' if p.percent > length else ''}{format_percentage_value(p.percent)}   {force}",
                  va="center", fontsize=9)
    axes.set(xlim=(0, 1.16 * limit), ylim=(-0.5, len(cases) - 0.5), yticks=range(len(cases)),
             xlabel="root mean square error, % of the largest measured force (or stress)",
             yticklabels=[_format_test_and_fitted_data_label(by_name[test], fitted, several.get(test, 0))
                          for test, fitted in cases])
    axes.invert_yaxis()
    axes.set_axisbelow(True)
    axes.grid(visible=False, axis="y")
    axes.tick_params(axis="y", length=0)
    axes.spines["left"].set_visible(False)
    handles = [Patch(color=style_of[law]["color"], alpha=0.85, label=find_law(law).title) for law in laws]
    if expected is not None:
        expected.set_label(f"expected from noise, jitter{', specimens' if several else ''} and parameter errors")
        handles.append(expected)
    figure.legend(handles=handles, loc="outside upper left", ncols=LAYOUT.legend_columns, fontsize=9.5)
    return figure


def format_percentage_value(value: float) -> str:
    """Return a number that is in percent as text, such as ``1.7 %`` for 1.7."""
    return f"{value:.2g}\u00a0%" if value < 99.5 else f"{value:.0f}\u00a0%"


def _format_test_and_fitted_data_label(test: Test, fitted: Sequence[str], of_mean: int) -> str:
    """Return the label of a prediction: name of the test, and the tests or specimens from which it is predicted."""
    if of_mean:
        return f"{test.name}\n{'held' if test.hold_out else 'left'} out, mean of {of_mean}"
    others = f"{len(fitted)} others" if len(fitted) >= 3 else ", ".join(fitted)
    return f"{test.name}\n{'held out' if test.hold_out else f'from {others}'}"


def draw_descent_history(fits: Sequence[Fit]):
    """Draw the convergence of all starts: error above, parameters relative to the estimate below, a column per law."""
    fits = [fit for fit in fits if fit.history]
    counts = [count for count in distribute_panels_over_rows(len(fits)) for _ in ("error", "parameters")]
    figure, axes = create_figure_with_panel_rows(counts, LAYOUT.history_row_height)
    remaining = iter(fits)
    for count in counts[::2]:
        for above, below in zip(axes[:count], axes[count:2 * count], strict=True):
            _draw_law_convergence(above, below, next(remaining))
        axes = axes[2 * count:]
    figure.align_labels()
    add_figure_legend_above_panels(figure)
    return figure


def find_best_start_preferring_corrected(fit: Fit) -> int:
    """Return the number of the start with the lowest final error; starts on the accurate mesh are preferred."""
    last = {step.start: step for step in sorted(fit.history, key=lambda step: step.run)}
    return min(last, key=lambda start: (not last[start].corrected, last[start].error))


def _draw_law_convergence(above, below, fit: Fit) -> None:
    """Draw the sum of squares (axes `above`) and the parameters (axes `below`) of all starts over the FEM solves."""
    from matplotlib.ticker import FixedLocator, MaxNLocator, NullLocator

    starts: dict[int, list] = {}
    for step in sorted(fit.history, key=lambda step: step.run):
        starts.setdefault(step.start, []).append(step)
    chosen = find_best_start_preferring_corrected(fit)
    names = list(starts[chosen][0].parameters)
    scale = {name: fit.parameters[name] or max(abs(step.parameters[name]) for step in fit.history) or 1.0
             for name in names}
    for start in sorted(starts, key=lambda start: start == chosen):
        steps, bold = starts[start], start == chosen
        run, error = [s.run for s in steps], [s.error for s in steps]
        above.plot(run, error, color=COLOURS[0] if bold else "0.6", lw=2.4 if bold else 0.8, zorder=4 if bold else 2)
        if bold:
            fine = [s for s in steps if s.corrected]
            above.plot(run, error, "o", color=COLOURS[0], ms=5, mfc="white", zorder=5, label="chosen start")
            if fine:
                above.plot([s.run for s in fine], [s.error for s in fine], "o", color=COLOURS[0], ms=5, zorder=6,
                           label="corrected to the accurate mesh")
        for name, style in zip(names, iterate_line_styles(), strict=False):
            symbol = format_mathtext_symbol(fit.symbols[name])
            label = symbol if fit.parameters[name] else f"{symbol} (of {scale[name]:.4g})"
            below.plot(run, [s.parameters[name] / scale[name] for s in steps], color=style["color"],
                       lw=2.4 if bold else 0.7, alpha=1.0 if bold else 0.4, zorder=4 if bold else 2,
                       gid=label if bold else None)
    if len(starts) > 1:
        above.plot([], [], color="0.6", lw=0.8, label="other starts")
    above.set_yscale("log")
    above.set_title(find_law(fit.law).title)
    above.set_ylabel("sum of squares, whitened")
    ratios = [step.parameters[name] / scale[name] for step in fit.history for name in names]
    if min(ratios) > 0:
        below.set_yscale("linear" if max(ratios) < LAYOUT.max_linear_ratio * min(ratios) else "log")
    elif max(map(abs, ratios)) > 3:
        below.set_yscale("symlog", linthresh=1.0)
    if below.get_yscale() != "linear":
        marks = _POSITIVE_TICKS if min(ratios) > 0 else _SIGNED_TICKS
        below.yaxis.set_major_locator(FixedLocator([r for r in marks if min(ratios) / 2 <= r < 2 * max(ratios)]))
        below.yaxis.set_major_formatter("{x:g}")
        below.yaxis.set_minor_locator(NullLocator())
    below.set(xlabel="FEM solve", ylabel="parameter / estimate")
    below.axhline(1.0, color="0.3", lw=0.8)
    for axes in (above, below):
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    named = {line.get_gid(): line for line in below.lines if line.get_gid()}
    below.legend(named.values(), named, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=6, fontsize=8.5,
                 borderaxespad=0.1, handlelength=1.2, columnspacing=1.0)
