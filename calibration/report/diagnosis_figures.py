"""Draw the figures of a diagnosis or a design: residuals, evidence by region, candidate effects, planned tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from calibration.diagnosis.diagnosis import CandidateResult, SegmentMisfit
from calibration.diagnosis.evidence import FitEvidence
from calibration.fit.curves import TestCurves
from calibration.fit.fit import RegionMisfitTest
from calibration.report.curve_figures import MISFIT, ResidualAxis, draw_view_panel, iterate_binned_residuals_of_runs
from calibration.report.drawing import (
    COLOURS,
    LAYOUT,
    add_figure_legend_above_panels,
    create_figure,
    create_figure_with_panel_rows,
    distribute_panels_over_rows,
)
from calibration.report.quantities import NORMAL_95, ReportUnits, format_criterion_difference, format_odds_number
from calibration.report.views import CurveTrace, have_times_and_several_segments, list_panels_of_test

#: Line style of the model without the added effects.
BEFORE: dict = {"color": MISFIT, "ls": (0, (5, 2))}
#: Line style of the model with the added effects.
AFTER: dict = {"color": COLOURS[0], "ls": "-"}


def build_fitted_curves_of_test(evidence: FitEvidence, name: str) -> TestCurves:
    """Return measured and fitted curves of the test `name`; fitted ones include contact offsets and force zeros.

    The prediction bands are NaN.
    """
    problem = evidence.problem
    number = next(i for i, test in enumerate(problem.tests) if test.name == name)
    test, force = problem.tests[number], evidence.evaluation.force
    fitted = tuple(force[rows] for rows, (t, _) in zip(problem.rows, problem.places, strict=True) if t == number)
    first = test.measured[0]
    unknown = np.full(first.force.size, np.nan)
    return TestCurves(first.test, test.measured, first.time, first.displacement, fitted[0], unknown, unknown, unknown,
                      fitted, test.area)


def draw_test_misfit(before: TestCurves, after: TestCurves | None, regions: Sequence[RegionMisfitTest],
                     gaps: Sequence[SegmentMisfit], label: str, units: ReportUnits):
    """Draw one test: the recordings, the model without and with the added effects, and the residuals.

    Args:
        before: curves of the test without the added effects.
        after: curves with the added effects; None if no effect was added.
        regions: regions of the test in the fit without the added effects.
        gaps: size of the residuals in each region, before and after.
        label: name of the added effects for the legend.
        units: display units.

    Returns:
        The matplotlib figure.
    """
    drawn = [(before, "model, nothing added", BEFORE)]
    if after is not None:
        drawn.insert(0, (after, f"model with {label}", AFTER))
    all_views = list_panels_of_test(before, units)
    timed = have_times_and_several_segments(before.measured)
    # Holds get separate panels: the relaxation in a hold is a small fraction of the whole force range.
    shown = [all_views[0], *(view for view in all_views[1:] if view.log)]
    figure, axes = create_figure_with_panel_rows([len(shown) + 1], LAYOUT.residual_row_height)
    for panel, view in zip(axes, shown, strict=False):
        draw_view_panel(panel, drawn, view)
        # Recordings differ by their offsets and zeros: each has a separate line.
        for curves, _, style in drawn:
            for m, fitted in zip(curves.measured[1:], curves.fitted[1:], strict=True):
                for along, force, _ in view.lines(replace(CurveTrace.from_recording(m), force=fitted)):
                    panel.plot(along, force, **style, lw=1.2, zorder=3)
    x = ResidualAxis(units.get_displacement_unit(before.test), units.get_load_unit(before.test), timed,
                     "time [s]" if timed else all_views[0].x)
    spans = [(region, span) for region in regions if not region.adequate
             for span in x.iterate_spans_of_one_region(region, before.measured)]
    for panel in axes[-1:] if timed else (axes[0], axes[-1]):
        for _, (start, end) in spans:
            panel.axvspan(start, end, fc=MISFIT, alpha=0.09, lw=0, zorder=0)
            for edge in (start, end):
                panel.axvline(edge, color=MISFIT, alpha=0.3, lw=0.8, zorder=0)
    _draw_residuals_before_and_after(axes[-1], drawn, x)
    _write_misfit_labels_before_and_after(axes[-1], spans, {gap.segment: gap for gap in gaps}, x)
    add_figure_legend_above_panels(figure)
    return figure


def draw_planned_test(curves: TestCurves, units: ReportUnits):
    """Draw the planned motion and the expected force of a test with the noise of the sensor; return the figure.

    Args:
        curves: noise-free recordings of the test.
        units: display units.
    """
    first = curves.measured[0]
    trace = replace(CurveTrace.from_recording(first), band=np.full(first.force.size, first.noise.deviation))
    views = list_panels_of_test(curves, units)
    rows = distribute_panels_over_rows(len(views) + (first.time is not None))
    figure, axes = create_figure_with_panel_rows(rows, LAYOUT.test_row_height)
    if first.time is not None:
        motion = units.get_displacement_unit(curves.test)
        axes[0].plot(first.time, first.displacement / motion.size, **AFTER)
        axes[0].set(title="Motion", xlabel="time [s]", ylabel=motion.format_axis_label("displacement"))
    for panel, view in zip(axes[-len(views):], views, strict=True):
        for x, y, band in view.lines(trace):
            panel.plot(x, y, **AFTER, label="expected")
            if band is not None:
                panel.fill_between(x, y - band, y + band, color="0.6", alpha=0.4, lw=0, label="± noise of a sample")
        panel.set(title=view.title, xlabel=view.x, ylabel=view.y)
        if view.log:
            panel.set_xscale("log")
            panel.xaxis.set_major_formatter("{x:g}")
    add_figure_legend_above_panels(figure)
    return figure


def _draw_residuals_before_and_after(axes, drawn, x: ResidualAxis) -> None:
    """Draw data minus model as bin means: thin lines per recording, thick for all; right axis in units of noise."""
    measured = drawn[0][0].measured
    noise = float(np.sqrt(np.mean([m.noise.deviation**2 for m in measured]))) / x.load.size
    axes.axhspan(-noise, noise, color="0.6", alpha=0.22, lw=0, label="± noise of a sample")
    edges = x.compute_bin_edges(measured)
    reach = 1.5 * noise
    for curves, _, style in drawn:
        by_run: dict[int, list[np.ndarray]] = {}
        for m, fitted in zip(curves.measured, curves.fitted, strict=True):
            for run, (means,
                      _) in enumerate(iterate_binned_residuals_of_runs(m, (m.force - fitted) / x.load.size, x, edges)):
                by_run.setdefault(run, []).append(means)
                axes.plot(*means, color=style["color"], lw=0.6, alpha=0.4, zorder=2)
                reach = max(reach, float(np.abs(means[1][np.isfinite(means[1])]).max(initial=0.0)))
        for means in by_run.values():
            whole = np.stack(means)
            known = np.isfinite(whole[:, 1]).any(axis=0)
            axes.plot(*np.nanmean(whole[:, :, known], axis=0), **style, lw=2.0, zorder=4)
    axes.axhline(0.0, color="0.3", lw=0.8)
    axes.set(ylim=(-1.15 * reach, 1.4 * reach), title="Data − model", xlabel=x.label,
             ylabel=x.load.format_axis_label("data − model"))
    right = axes.secondary_yaxis("right", functions=(lambda y: y / noise, lambda y: y * noise))
    right.set_ylabel("in units of the noise")
    right.spines["right"].set_visible(True)


def _write_misfit_labels_before_and_after(axes, spans, gaps: dict[str, SegmentMisfit], x: ResidualAxis) -> None:
    """Write the misfit without and with the added effects above each region that is wide enough for the text."""
    left, right = axes.get_xlim()
    for region, (start, end) in spans:
        gap = gaps.get(region.segment)
        if gap is None or end - start < LAYOUT.min_two_line_width * (right - left):
            continue
        sizes = [x.load.format_quantity(size, 2) for size in (gap.before_N, gap.after_N) if size is not None]
        axes.text((start + end) / 2, 0.975, f"{region.segment}\n" + "\n→ ".join(sizes),
                  transform=axes.get_xaxis_transform(), ha="center", va="top", fontsize=8, color="#8a3c00", zorder=6)


def draw_region_significance_in_deviations(regions: Sequence[SegmentMisfit], units: ReportUnits):
    """Draw the significance of the residuals of each region without and with the added effects; return the figure.

    The axis is the number of standard deviations of a normal distribution.
    """
    figure = create_figure(LAYOUT.width, LAYOUT.frame_height + LAYOUT.bar_height * len(regions))
    axes = figure.subplots()
    rows = -np.arange(len(regions), dtype=float)
    axes.axvspan(0, NORMAL_95, color="0.6", alpha=0.18, lw=0, label="chance")
    for row, region in zip(rows, regions, strict=True):
        if region.after_sigma is not None:
            axes.plot([region.before_sigma, region.after_sigma], [row, row], color="0.75", lw=2, zorder=1)
    axes.plot([region.before_sigma for region in regions], rows, "o", color=MISFIT, ms=8, ls="",
              label="nothing added", clip_on=False)
    if any(region.after_sigma is not None for region in regions):
        axes.plot([region.after_sigma for region in regions], rows, "D", color=COLOURS[0], ms=6.5, ls="",
                  label="with the added effects", clip_on=False)
    axes.set_xscale("symlog", linthresh=LAYOUT.linear_deviations, linscale=1.5)
    largest = max([*(region.before_sigma for region in regions),
                   *(region.after_sigma or 0.0 for region in regions), 6.0])
    ticks = [tick for tick in (0, 1, 2, 3, 4, 10, 20, 50, 100, 200, 500, 1000, 10000) if tick < 1.3 * largest]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.minorticks_off()
    axes.set(xlim=(0, 1.35 * largest), ylim=(rows[-1] - 0.7, 0.7),
             xlabel="standard deviations of a normal distribution "
             f"(linear up to {LAYOUT.linear_deviations:g}, then logarithmic)")
    axes.set_yticks(rows, [f"{region.test}, {_format_segment_and_speed(region)}" for region in regions])
    sizes = axes.secondary_yaxis("right")
    sizes.set_yticks(rows, [_format_misfits(region, units) for region in regions])
    for side in (axes.yaxis, sizes.yaxis):
        side.set_tick_params(length=0, pad=9)
    add_figure_legend_above_panels(figure)
    return figure


def _format_segment_and_speed(region: SegmentMisfit) -> str:
    """Return the segment of a region with its speed, such as ``ramp at 0.248 mm/s``."""
    return f"{region.segment} at {region.speed_mm_s:g} mm/s" if region.speed_mm_s else region.segment


def _format_misfits(region: SegmentMisfit, units: ReportUnits) -> str:
    """Return the misfits of a region without and with the added effects as text, such as ``0.2 N → 0.1 N``."""
    sizes = [units.force.format_quantity(size, 2) for size in (region.before_N, region.after_N) if size is not None]
    return " → ".join(sizes)


def draw_candidate_scores(candidates: Sequence[CandidateResult], names: Sequence[str], chosen: Sequence[str]):
    """Draw the score of each effect before a fit with the effect, and the gain of the fits with the likeliest effects.

    Args:
        candidates: testable effects, best first.
        names: display name of each candidate.
        chosen: names of the candidates that were added to the model.

    Returns:
        The matplotlib figure.
    """
    figure = create_figure(LAYOUT.width, LAYOUT.frame_height + LAYOUT.bar_height * len(candidates))
    score, gain = figure.subplots(1, 2, sharey=True, width_ratios=(1.25, 1))
    rows = -np.arange(len(candidates), dtype=float)
    colours = [COLOURS[0] if each.name in chosen else "#8fb8d6" if each.refitted else "0.75" for each in candidates]
    score.axvspan(-NORMAL_95, NORMAL_95, color="0.6", alpha=0.18, lw=0)
    score.barh(rows, [each.score or 0.0 for each in candidates], 0.62, color=colours)
    _set_signed_log_scale(score, [each.score or 0.0 for each in candidates], LAYOUT.linear_deviations)
    score.set(title="Score before a fit with the effect", xlabel="standard deviations (grey: within chance)")
    score.set_yticks(rows, names)
    score.set_ylim(rows[-1] - 0.7, 0.7)
    known = [each.delta_BIC for each in candidates if each.delta_BIC is not None]
    for row, each, colour in zip(rows, candidates, colours, strict=True):
        if each.delta_BIC is None:
            gain.annotate("not fitted", (0.0, row), (7, 0), textcoords="offset points", va="center", fontsize=8.5,
                          color="0.5", bbox={"fc": "white", "ec": "none", "pad": 0.8})
            continue
        gain.barh(row, each.delta_BIC, 0.62, color=colour)
        gain.text(max(each.delta_BIC, 0.0), row,
                  f"  {format_criterion_difference(each.delta_BIC)}{_format_odds_against_best(each)}",
                  va="center", fontsize=8.5)
    _set_signed_log_scale(gain, [*known, 0.0], 10.0, margin=12.0)
    gain.axvline(10.0, color="0.4", lw=0.9, ls=(0, (3, 2)))
    gain.set(title="Gain in BIC of a fit with the effect", xlabel="ΔBIC (dashed: minimum of 10 for an effect)")
    for axes in (score, gain):
        axes.axvline(0.0, color="0.3", lw=0.8)
        axes.tick_params(axis="y", length=0)
    return figure


def _format_odds_against_best(each: CandidateResult) -> str:
    """Return text with the odds against the best candidate, such as ``, 1 : 45``; empty for the best candidate."""
    ratio = each.evidence_ratio
    return "" if ratio is None or ratio <= 1.0 else f", 1 : {format_odds_number(ratio)}"


def _set_signed_log_scale(axes, values: Sequence[float], linear: float, margin: float = 1.5) -> None:
    """Set a horizontal scale that is linear within ±`linear` and logarithmic outside, with few ticks."""
    low, high = min([*values, 0.0]), max([*values, 1.2 * linear])
    axes.set_xscale("symlog", linthresh=linear)
    axes.set_xlim(1.5 * low if low < 0 else -0.06 * linear, margin * high)
    ends = [size for size in sorted({linear, 10.0, 100.0, 1e3, 1e4, 1e5, 1e6}) if size >= linear]
    ticks = [*(-size for size in ends if -size > 1.5 * low), 0.0, *(size for size in ends if size < margin * high)]
    axes.set_xticks(ticks, list(map(format_criterion_difference, ticks)))
    axes.minorticks_off()
