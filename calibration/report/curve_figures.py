"""The picture of one test: recordings and laws in each view, the prediction band, and what no law explains."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calibration.campaign.campaign import Test
from calibration.campaign.measured import MeasuredCurve
from calibration.fit.curves import TestCurves
from calibration.fit.fit import Fit, Region
from calibration.report.drawing import cloud, counted, in_rows, legend_above, line_styles, panels, thinned
from calibration.report.units import Unit, Units
from calibration.report.views import Trace, View, is_timed, law_along, trace_of_law, views
from tissue_sim.laws import find_law

_BINS = 60
#: Inches of a row of panels.
_ROW = 3.15
#: Room beyond the data, as a share of their range; the share of rates at either end that does not set their scale, and
#: how few of them do so all.
_ROOM, _OUTER, _FEW = 0.06, 0.02, 200
#: Points of all recordings from which on they are drawn smaller.
_DENSE = 400
#: Width of a region's label, as a share of its panel.
_LABEL = 0.11
#: Of a region that a test of its residuals finds wanting.
MISFIT = "#D55E00"
BAND = "95 % of new recordings"


def draw_test(fits: Sequence[Fit], curves: Mapping[str, TestCurves], units: Units):
    """One test: its views, then the recordings in the 95 % prediction band of the best law, and the residuals with
    each recording's offset and zero.

    Args:
        fits: best first; the first that is in `curves` gets band and residuals.
        curves: law -> this test as the law sees it.
    """
    drawn = [(curves[fit.law], fit, look) for fit, look in zip(fits, line_styles(), strict=False) if fit.law in curves]
    best, fit, look = drawn[0]
    seen = views(best, units)
    figure, axes = panels([*in_rows(len(seen)), 2], _ROW)
    band, residual = axes[-2:]
    titled = [(each, find_law(its.law).title, style) for each, its, style in drawn]
    for panel, view in zip(axes, seen, strict=False):
        draw_view(panel, titled, view)
    timed = is_timed(best.measured)
    x = Abscissa(units.travel(best.test), units.load(best.test), timed, "time [s]" if timed else seen[0].x)
    spans = [(r, span) for r in fit.regions if r.test == best.test.name and not r.adequate
             for span in x.spans(r, best.measured)]
    for _, (start, end) in spans:
        for panel in (band, residual):
            panel.axvspan(start, end, fc=MISFIT, alpha=0.09, lw=0, zorder=0)
            for edge in (start, end):
                panel.axvline(edge, color=MISFIT, alpha=0.35, lw=0.8, zorder=0)
    _draw_band(band, best, look["color"], x)
    _draw_residuals(residual, drawn, x)
    band.sharex(residual)
    _label(residual, spans, x.load)
    for panel in (band, residual):
        panel.set(xlabel=x.label, ylabel=x.load.label("model − data"))
    figure.align_labels()
    legend_above(figure)
    return figure


def draw_view(axes, drawn: Sequence[tuple[TestCurves, str, dict]], view: View) -> None:
    """Recordings and laws alike, so that what a view does to the one it does to the other.

    Args:
        drawn: curves, label and look of each law, best first; a band that is not a number is not drawn.
    """
    best = drawn[0][0]
    points = sum(m.force.size for m in best.measured)
    shown = []
    label = f"measured ({counted(len(best.measured), 'recording')})"
    for m in best.measured:
        for x, y, _ in view.lines(Trace.of(m)):
            thin = thinned(x.size)
            axes.plot(x[thin], y[thin], "o", ms=4 if points < _DENSE else 3, label=label, **cloud(points))
            shown.append(y)
    for rank, (curves, title, look) in enumerate(drawn):
        style = {**look, "lw": 1.8 if rank == 0 else 1.2, "zorder": 4 - rank / len(drawn)}
        trace = trace_of_law(curves, view.own)
        for x, y, band in () if trace is None else view.lines(trace):
            axes.plot(x, y, label=title, **style)
            if rank == 0:
                shown.append(y)
                if band is not None and np.isfinite(band).any():
                    axes.fill_between(x, y - band, y + band, color=look["color"], alpha=0.25, lw=0, zorder=2,
                                      label=BAND)
    _scale(axes, np.concatenate(shown), view.rates)
    axes.set(title=view.title, xlabel=view.x, ylabel=view.y)
    if view.log:
        axes.set_xscale("log")
        axes.xaxis.set_major_formatter("{x:g}")


def _scale(axes, shown: np.ndarray, rates: bool) -> None:
    """Limits by the recordings and the best law: another that is far off leaves the frame; so do single rates."""
    shown = shown[np.isfinite(shown)]
    if shown.size:
        outer = _OUTER if rates and shown.size > _FEW else 0.0
        low, high = np.quantile(shown, (outer, 1 - outer))
        room = (4 if outer else 1) * _ROOM * ((high - low) or abs(high) or 1.0)
        axes.set_ylim(low - room, high + room)


@dataclass(frozen=True)
class Abscissa:
    """What residuals are drawn against: time where a displacement is passed more than once, else displacement."""

    travel: Unit
    load: Unit
    timed: bool
    label: str

    def of(self, measured: MeasuredCurve) -> np.ndarray:
        return measured.clock if self.timed else measured.displacement / self.travel.size

    def spans(self, region: Region, recordings: Sequence[MeasuredCurve]) -> Iterator[tuple[float, float]]:
        """Where a region lies; a displacement that is passed in several cycles gives several."""
        measured = recordings[0]
        start, end = _ends(region, measured.test)
        if not self.timed:
            yield start / self.travel.size, end / self.travel.size
            return
        x = measured.displacement
        # Half a sample's way, so that the region's own ends count.
        slack = 1e-9 + 0.5 * float(np.median(np.abs(np.diff(x))))
        inside = (measured.segment == region.segment) & (x >= start - slack) & (x <= end + slack)
        edges = np.flatnonzero(np.diff(np.concatenate(([0], inside.astype(int), [0]))))
        for first, after in edges.reshape(-1, 2):
            if after - first > 1:
                yield float(measured.clock[first]), float(measured.clock[after - 1])


def _draw_band(axes, best: TestCurves, colour: str, x: Abscissa) -> None:
    """The law's curve as it stands minus the recordings, without their offsets and zeros, in its prediction band."""
    axes.set_title("Recordings as they came, in the prediction band")
    axes.axhline(0.0, color=colour, lw=1.6)
    y = 1 / x.load.size
    points = sum(m.force.size for m in best.measured)
    first = best.measured[0]
    along = [law_along(best, m) for m in best.measured]
    known = [values for values in along if values is not None]
    if len(known) < len(along):
        axes.text(0.5, 0.75, "no curve without a time that all recordings share", transform=axes.transAxes, ha="center",
                  color="0.4")
        return
    places = first.time if x.timed else best.displacement / x.travel.size
    band, whole, error = known[0][:, 1:].T if x.timed else (best.band, best.whole_band, best.force_error)
    axes.fill_between(places, -y * band, y * band, color=colour, alpha=0.2, lw=0,
                      label=BAND)
    for side in (-1, 1):
        axes.plot(places, side * y * whole, color=colour, lw=0.9, ls=(0, (4, 2)),
                  label="95 % of new recordings, wholly" if side > 0 else None)
    axes.fill_between(places, -2 * y * error, 2 * y * error, color=colour, alpha=0.35, lw=0,
                      label="± 2 standard errors of the model")
    for m, values in zip(best.measured, known, strict=True):
        thin = thinned(m.force.size)
        away = y * (values[:, 0] - m.force)
        axes.plot(x.of(m)[thin], away[thin], "o", ms=4 if points < _DENSE else 2.2, **cloud(points))


def _draw_residuals(axes, drawn, x: Abscissa) -> None:
    """Residuals, means of bins, of each recording and of all; those of the other laws thin."""
    best = drawn[0][0]
    y = 1 / x.load.size
    noise = y * float(np.sqrt(np.mean([m.noise.deviation**2 for m in best.measured])))
    axes.axhspan(-2 * noise, 2 * noise, color="0.6", alpha=0.22, lw=0, label="± 2 noise")
    edges = np.linspace(min(x.of(m).min() for m in best.measured), max(x.of(m).max() for m in best.measured), _BINS + 1)
    reach = [2.2 * noise]
    for rank, (curves, _, other) in enumerate(drawn):
        by_run: dict[int, list[np.ndarray]] = {}
        for m, fitted in zip(curves.measured, curves.fitted, strict=True):
            for run, (means, spread) in enumerate(binned(m, y * (fitted - m.force), x, edges)):
                by_run.setdefault(run, []).append(means)
                if rank == 0:
                    reach.append(np.abs(means[1][np.isfinite(means[1])]).max(initial=0.0))
                    axes.plot(*means, color="0.45", lw=0.9, zorder=2,
                              label="mean of a recording" if m is best.measured[0] and run == 0 else None)
                    if m is best.measured[0]:
                        axes.fill_between(means[0], -2 * y * spread, 2 * y * spread, color="0.5", alpha=0.28, lw=0,
                                          label="± 2 noise of a mean of one" if run == 0 else None)
        for means in by_run.values():
            whole = np.stack(means)
            seen = np.isfinite(whole[:, 1]).any(axis=0)
            axes.plot(*np.nanmean(whole[:, :, seen], axis=0), **other, lw=2.2 if rank == 0 else 1.1,
                      zorder=5 - rank / len(drawn), label=None)
    axes.axhline(0.0, color="0.3", lw=0.8)
    axes.set_ylim(-1.45 * max(reach), 1.45 * max(reach))
    own = ", own offset and zero taken out" if drawn[0][1].nuisances else ""
    axes.set_title(f"Residuals{own}, means of bins")


def binned(measured: MeasuredCurve, residual: np.ndarray, x: Abscissa, edges: np.ndarray):
    """Places and means, shape (2, bins), and the standard deviation that noise gives them, of each run: all samples, or
    those of each segment where a displacement may be passed more than once."""
    at, noise = x.of(measured), measured.noise
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
        yield means, noise.deviation * deviation_of_mean(count, step, noise.correlation_time)


def deviation_of_mean(count: np.ndarray, step: float, correlation_time: float) -> np.ndarray:
    """Standard deviation of the mean of `count` neighbouring samples of unit variance whose correlation is
    exp(-lag / time): the sum of all their covariances, a geometric series. NaN of none."""
    phi = min(np.exp(-step / correlation_time), 1 - 1e-6) if correlation_time > 0 else 0.0
    n = np.where(count > 0, count, np.nan)
    return np.sqrt(((1 + phi) / (1 - phi) - 2 * phi * (1 - phi**n) / (n * (1 - phi) ** 2)) / n)


def _label(axes, spans, load: Unit) -> None:
    """Size of each misfit over its region, where the region is wide enough for it."""
    left, right = axes.get_xlim()
    for region, (start, end) in spans:
        if end - start > _LABEL * (right - left):
            axes.text((start + end) / 2, 0.97, load.text(region.misfit_N, 2), transform=axes.get_xaxis_transform(),
                      ha="center", va="top", fontsize=8.5, color="#8a3c00", zorder=6,
                      bbox={"fc": "white", "ec": "none", "alpha": 0.75, "pad": 1.5})


def _ends(region: Region, test: Test) -> tuple[float, float]:
    """Displacements (strains of a test without specimen) between which a region lies, SI."""
    size = 1.0 if test.specimen is None else 1e-3
    return region.start * size, region.end * size


def place_of(region: Region, test: Test, units: Units) -> str:
    """``ramp from 3.3 to 6.7 mm``, ``hold at 10 mm``."""
    travel = units.travel(test)
    start, end = (f"{end / travel.size:.3g}" for end in _ends(region, test))
    span = f"{f'at {start}' if start == end else f'from {start} to {end}'} {travel.name}".rstrip()
    return f"{region.segment} {span}".strip()


def probability(p: float) -> str:
    """``p = 0.031``, ``p = 2e-5``, ``p < 1e-6``."""
    return "p < 1e-6" if p < 1e-6 else f"p = {p:.2g}".replace("e-0", "e-")
