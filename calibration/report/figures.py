"""Draw the figures of a whole calibration: misfit by region, prediction errors, convergence.

matplotlib is imported on use; every drawing function returns a figure.
"""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import shorten

from scipy import special

from calibration.campaign.campaign import Test
from calibration.fit.fit import Fit, Prediction
from calibration.report.curve_figures import describe_region, format_p_value_text
from calibration.report.drawing import (
    COLOURS,
    LAYOUT,
    add_figure_legend_above_panels,
    create_figure_with_panel_rows,
    distribute_panels_over_rows,
    iterate_line_styles,
)
from calibration.report.symbols import format_mathtext_symbol
from calibration.report.units import ReportUnits
from tissue_sim.laws import find_law

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
