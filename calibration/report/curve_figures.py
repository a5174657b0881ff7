"""Draw the figure of one test: recordings and fitted laws in each view, prediction band and residuals."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calibration.campaign.campaign import Test
from calibration.campaign.measured import MeasuredCurve
from calibration.fit.curves import TestCurves
from calibration.fit.fit import Fit, RegionMisfitTest
from calibration.report.drawing import (
    LAYOUT,
    add_figure_legend_above_panels,
    choose_marker_style,
    create_figure_with_panel_rows,
    distribute_panels_over_rows,
    format_count,
    iterate_line_styles,
    make_thinning_slice,
)
from calibration.report.quantities import DisplayUnit, ReportUnits
from calibration.report.views import (
    CurveTrace,
    PanelLabelsAndLineFunction,
    get_law_trace_or_none,
    have_times_and_several_segments,
    interpolate_force_and_bands_or_none,
    list_panels_of_test,
)
from tissue_sim.laws import find_law

#: Colour of a region whose residuals exceed the noise.
MISFIT = "#D55E00"
#: Legend entry of the prediction band.
BAND = "95 % of new recordings"


def draw_test_figure(fits: Sequence[Fit], curves: Mapping[str, TestCurves], units: ReportUnits):
    """Draw one test: its views, the recordings in the 95 % prediction band of the best law, and the residuals.

    The residuals have the contact offset and force zero of each recording removed.

    Args:
        fits: fits of all laws, best first; the first law in `curves` gets band and residuals.
        curves: law -> recorded and fitted curves of this test.
        units: display units.

    Returns:
        The matplotlib figure.
    """
    drawn = [(curves[fit.law], fit, style) for fit, style in zip(fits, iterate_line_styles(), strict=False)
             if fit.law in curves]
    best, fit, best_style = drawn[0]
    shown_views = list_panels_of_test(best, units)
    figure, axes = create_figure_with_panel_rows([*distribute_panels_over_rows(len(shown_views)), 2],
                                                 LAYOUT.test_row_height)
    band, residual = axes[-2:]
    titled = [(each, find_law(law_fit.law).title, style) for each, law_fit, style in drawn]
    for panel, view in zip(axes, shown_views, strict=False):
        draw_view_panel(panel, titled, view)
    timed = have_times_and_several_segments(best.measured)
    x = ResidualAxis(units.get_displacement_unit(best.test), units.get_load_unit(best.test), timed,
                     "time [s]" if timed else shown_views[0].x, not timed and shown_views[0].log)
    spans = [(r, span) for r in fit.regions if r.test == best.test.name and not r.adequate
             for span in x.iterate_spans_of_one_region(r, best.measured)]
    for _, (start, end) in spans:
        for panel in (band, residual):
            panel.axvspan(start, end, fc=MISFIT, alpha=0.09, lw=0, zorder=0)
            for edge in (start, end):
                panel.axvline(edge, color=MISFIT, alpha=0.35, lw=0.8, zorder=0)
    _draw_raw_residuals_in_prediction_band(band, best, best_style["color"], x)
    _draw_binned_mean_residuals(residual, drawn, x)
    band.sharex(residual)
    _write_misfit_force_labels(residual, spans, x.load)
    for panel in (band, residual):
        panel.set(xlabel=x.label, ylabel=x.load.format_axis_label("model − data"))
        if x.log:
            panel.set_xscale("log")
    figure.align_labels()
    add_figure_legend_above_panels(figure)
    return figure


def draw_view_panel(axes, drawn: Sequence[tuple[TestCurves, str, dict]], view: PanelLabelsAndLineFunction) -> None:
    """Draw the recordings and the laws in one view; the view transforms both in the same way.

    Args:
        axes: matplotlib axes.
        drawn: (curves, label, line style) of each law, best first; a band of NaN is not drawn.
        view: the quantities on the axes.
    """
    best = drawn[0][0]
    points = sum(m.force.size for m in best.measured)
    shown = []
    label = f"measured ({format_count(len(best.measured), 'recording')})"
    for m in best.measured:
        for x, y, _ in view.lines(CurveTrace.from_recording(m)):
            thin = make_thinning_slice(x.size)
            axes.plot(x[thin], y[thin], "o", ms=4 if points < LAYOUT.dense_points else 3, label=label,
                      **choose_marker_style(points))
            shown.append(y)
    for rank, (curves, title, style) in enumerate(drawn):
        line = {**style, "lw": 1.8 if rank == 0 else 1.2, "zorder": 4 - rank / len(drawn)}
        trace = get_law_trace_or_none(curves, view.own, view.shows_displacement_response)
        for x, y, band in () if trace is None else view.lines(trace):
            axes.plot(x, y, label=title, **line)
            if rank == 0:
                shown.append(y)
                if band is not None and np.isfinite(band).any():
                    axes.fill_between(x, y - band, y + band, color=style["color"], alpha=0.25, lw=0, zorder=2,
                                      label=BAND)
    _set_y_limits(axes, np.concatenate(shown), view.rates)
    axes.set(title=view.title, xlabel=view.x, ylabel=view.y)
    if view.log:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")
    if view.has_log_load_axis:
        axes.set_yscale("log")
        axes.autoscale(axis="y")


def _set_y_limits(axes, shown: np.ndarray, rates: bool) -> None:
    """Set the y limits from the recordings and the best law.

    Other laws may leave the frame, so that a poor law does not flatten the curves. Outlying rates may leave it too.
    """
    shown = shown[np.isfinite(shown)]
    if shown.size:
        outer = LAYOUT.ignored_rates if rates and shown.size > LAYOUT.few_rates else 0.0
        low, high = np.quantile(shown, (outer, 1 - outer))
        margin = (4 if outer else 1) * LAYOUT.margin * ((high - low) or abs(high) or 1.0)
        axes.set_ylim(low - margin, high + margin)


@dataclass(frozen=True)
class ResidualAxis:
    """Horizontal axis of residuals: time if a displacement occurs more than once, otherwise displacement.

    Attributes:
        travel: unit of displacement.
        load: unit of force.
        timed: whether the axis is time.
        label: label of the axis.
        log: whether the axis is logarithmic.
    """

    travel: DisplayUnit
    load: DisplayUnit
    timed: bool
    label: str
    log: bool = False

    def compute_sample_positions(self, measured: MeasuredCurve) -> np.ndarray:
        """Return the coordinate of each sample on this axis, in the unit of the axis, shape (n,)."""
        return measured.sample_times if self.timed else measured.displacement / self.travel.size

    def compute_bin_edges(self, recordings: Sequence[MeasuredCurve]) -> np.ndarray:
        """Return the edges of equal bins over all recordings, in the unit of the axis, shape (bins + 1,)."""
        positions = [self.compute_sample_positions(measured) for measured in recordings]
        low, high = min(each.min() for each in positions), max(each.max() for each in positions)
        return (np.geomspace if self.log else np.linspace)(low, high, LAYOUT.residual_bins + 1)

    def iterate_spans_of_one_region(self, region: RegionMisfitTest,
                                    recordings: Sequence[MeasuredCurve]) -> Iterator[tuple[float, float]]:
        """Yield (start, end) of one region in the unit of this axis; on a time axis one pair for each cycle."""
        measured = recordings[0]
        start, end = _get_region_end_displacements(region, measured.test)
        if not self.timed:
            yield start / self.travel.size, end / self.travel.size
            return
        x = measured.displacement
        # Half the distance of two samples, so that the end samples of the region are included.
        slack = 1e-9 + 0.5 * float(np.median(np.abs(np.diff(x))))
        inside = (measured.segment == region.segment) & (x >= start - slack) & (x <= end + slack)
        edges = np.flatnonzero(np.diff(np.concatenate(([0], inside.astype(int), [0]))))
        for first, after in edges.reshape(-1, 2):
            if after - first > 1:
                yield float(measured.sample_times[first]), float(measured.sample_times[after - 1])


def _draw_raw_residuals_in_prediction_band(axes, best: TestCurves, colour: str, x: ResidualAxis) -> None:
    """Draw the law minus each recording, and the prediction band; contact offsets and force zeros are not removed."""
    axes.set_title("Raw recordings in the prediction band")
    axes.axhline(0.0, color=colour, lw=1.6)
    y = 1 / x.load.size
    points = sum(m.force.size for m in best.measured)
    first = best.measured[0]
    law_values = [interpolate_force_and_bands_or_none(best, m) for m in best.measured]
    known = [values for values in law_values if values is not None]
    if len(known) < len(law_values):
        axes.text(0.5, 0.75, "no curve: the recordings have no common time", transform=axes.transAxes, ha="center",
                  color="0.4")
        return
    positions = first.time if x.timed else best.displacement / x.travel.size
    band, whole, error = known[0][:, 1:].T if x.timed else (best.band, best.whole_band, best.force_error)
    axes.fill_between(positions, -y * band, y * band, color=colour, alpha=0.2, lw=0,
                      label=BAND)
    for side in (-1, 1):
        axes.plot(positions, side * y * whole, color=colour, lw=0.9, ls=(0, (4, 2)),
                  label="95 % of new recordings, entire curve" if side > 0 else None)
    axes.fill_between(positions, -2 * y * error, 2 * y * error, color=colour, alpha=0.35, lw=0,
                      label="± 2 standard errors of the model")
    for m, values in zip(best.measured, known, strict=True):
        thin = make_thinning_slice(m.force.size)
        difference = y * (values[:, 0] - m.force)
        axes.plot(x.compute_sample_positions(m)[thin], difference[thin], "o",
                  ms=4 if points < LAYOUT.dense_points else 2.2, **choose_marker_style(points))


def _draw_binned_mean_residuals(axes, drawn, x: ResidualAxis) -> None:
    """Draw the binned mean residuals of each recording and of all recordings; other laws as thin lines."""
    best = drawn[0][0]
    y = 1 / x.load.size
    noise = y * float(np.sqrt(np.mean([m.noise.deviation**2 for m in best.measured])))
    axes.axhspan(-2 * noise, 2 * noise, color="0.6", alpha=0.22, lw=0, label="± 2 noise")
    edges = x.compute_bin_edges(best.measured)
    reach = [2.2 * noise]
    for rank, (curves, _, other) in enumerate(drawn):
        by_run: dict[int, list[np.ndarray]] = {}
        for m, fitted in zip(curves.measured, curves.fitted, strict=True):
            for run, (means,
                      spread) in enumerate(iterate_binned_residuals_of_runs(m, y * (fitted - m.force), x, edges)):
                by_run.setdefault(run, []).append(means)
                if rank == 0:
                    reach.append(np.abs(means[1][np.isfinite(means[1])]).max(initial=0.0))
                    axes.plot(*means, color="0.45", lw=0.9, zorder=2,
                              label="each recording" if m is best.measured[0] and run == 0 else None)
                    if m is best.measured[0]:
                        axes.fill_between(means[0], -2 * y * spread, 2 * y * spread, color="0.5", alpha=0.28, lw=0,
                                          label="± 2 noise of a bin mean" if run == 0 else None)
        for means in by_run.values():
            whole = np.stack(means)
            filled = np.isfinite(whole[:, 1]).any(axis=0)
            axes.plot(*np.nanmean(whole[:, :, filled], axis=0), **other, lw=2.2 if rank == 0 else 1.1,
                      zorder=5 - rank / len(drawn), label=None)
    axes.axhline(0.0, color="0.3", lw=0.8)
    axes.set_ylim(-1.45 * max(reach), 1.45 * max(reach))
    removed = ", offset and zero removed" if drawn[0][1].nuisances else ""
    axes.set_title(f"Residuals{removed}, bin means")


def iterate_binned_residuals_of_runs(measured: MeasuredCurve, residual: np.ndarray, x: ResidualAxis, edges: np.ndarray):
    """Yield the bin means of residuals, and their standard deviation due to noise, for each run.

    A run is the whole recording. On a displacement axis a run is one segment, because a displacement may occur in
    several segments.

    Args:
        measured: the recording.
        residual: residual of each sample, shape (n,).
        x: the horizontal axis.
        edges: edges of the bins on that axis, shape (bins + 1,).

    Yields:
        Mean position and mean residual, shape (2, bins), NaN in empty bins; and the standard deviation, shape (bins,).
    """
    at, noise = x.compute_sample_positions(measured), measured.noise
    step = 1.0 if measured.time is None else float(np.median(np.diff(measured.time)))
    ends = [0, at.size]
    if not x.timed and measured.segment is not None:
        ends = [0, *np.flatnonzero(measured.segment[1:] != measured.segment[:-1]) + 1, at.size]
    for first, after in pairwise(ends):
        part = slice(first, after)
        bins = np.clip(np.searchsorted(edges, at[part], side="right") - 1, 0, edges.size - 2)
        count = np.bincount(bins, minlength=edges.size - 1)
        sums = np.stack([np.bincount(bins, values[part], edges.size - 1) for values in (at, residual)])
        with np.errstate(invalid="ignore"):
            means = sums / count
        yield means, noise.deviation * compute_standard_errors_at_unit_variance(count, step, noise.correlation_time)


def compute_standard_errors_at_unit_variance(count: np.ndarray, step: float, correlation_time: float) -> np.ndarray:
    """Return the standard deviations of means of correlated samples of unit variance, shape of `count`.

    The samples have the autocorrelation exp(-lag / correlation_time). The variance of the mean of n samples is
    [(1 + phi) / (1 - phi) - 2 phi (1 - phi^n) / (n (1 - phi)^2)] / n with phi = exp(-step / correlation_time).

    Args:
        count: number of neighbouring samples in each mean.
        step: time between samples, s.
        correlation_time: s; 0 for white noise.

    Returns:
        Standard deviations, NaN where `count` is 0.
    """
    phi = min(np.exp(-step / correlation_time), 1 - 1e-6) if correlation_time > 0 else 0.0
    n = np.where(count > 0, count, np.nan)
    return np.sqrt(((1 + phi) / (1 - phi) - 2 * phi * (1 - phi**n) / (n * (1 - phi) ** 2)) / n)


def _write_misfit_force_labels(axes, spans, load: DisplayUnit) -> None:
    """Write the misfit, in the unit of force, above each region that is wide enough for the text."""
    left, right = axes.get_xlim()
    for region, (start, end) in spans:
        if end - start > LAYOUT.min_labelled_width * (right - left):
            axes.text((start + end) / 2, 0.97, load.format_quantity(region.misfit_N, 2),
                      transform=axes.get_xaxis_transform(),
                      ha="center", va="top", fontsize=8.5, color="#8a3c00", zorder=6,
                      bbox={"fc": "white", "ec": "none", "alpha": 0.75, "pad": 1.5})


def _get_region_end_displacements(region: RegionMisfitTest, test: Test) -> tuple[float, float]:
    """Return the displacements (strains for a test without specimen) at both ends of a region, SI."""
    size = 1.0 if test.states_stress else 1e-3
    return region.start * size, region.end * size


def describe_region(region: RegionMisfitTest, test: Test, units: ReportUnits) -> str:
    """Return a region in words, such as ``ramp from 3.3 to 6.7 mm`` or ``hold at 10 mm``."""
    travel = units.get_displacement_unit(test)
    start, end = (f"{end / travel.size:.3g}" for end in _get_region_end_displacements(region, test))
    span = f"{f'at {start}' if start == end else f'from {start} to {end}'} {travel.name}".rstrip()
    return f"{region.segment} {span}".strip()


def format_p_value_text(p: float) -> str:
    """Return a probability as text, such as ``p = 0.031``, ``p = 2e-5`` or ``p < 1e-6``."""
    return "p < 1e-6" if p < 1e-6 else f"p = {p:.2g}".replace("e-0", "e-")
