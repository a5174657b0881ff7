"""The picture of one test: recordings and laws, recordings in the prediction band, and what no law explains."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from calibration.campaign.campaign import Test
from calibration.campaign.measured import MeasuredCurve
from calibration.fit.curves import TestCurves
from calibration.fit.fit import Fit, Region
from calibration.report.drawing import STYLE, cloud, counted, line_styles, new_figure, thinned, to_png
from calibration.report.pressure import pressure_unit
from tissue_sim.laws import find_law

_BINS = 60
#: Of a panel; room for a line of legend below it.
_TITLE = {"loc": "left", "fontsize": 10, "fontweight": "bold", "pad": 19}
#: Of a region that a test of its residuals finds wanting.
MISFIT = "#D55E00"


def draw_test(fits: Sequence[Fit], curves: Mapping[str, TestCurves]) -> bytes:
    """One test: left force against displacement (and time, where the recordings hold or return), right the recordings
    in the 95 % prediction band of the best law, and below the residuals with each recording's offset and zero.

    Args:
        fits: best first; the first that is in `curves` gets band and residuals.
        curves: law -> this test as the law sees it.

    Returns:
        A PNG.
    """
    import matplotlib

    drawn = [(curves[fit.law], fit, look) for fit, look in zip(fits, line_styles(), strict=False) if fit.law in curves]
    best, fit, look = drawn[0]
    scale = scale_of(best.test, max(float(np.abs(m.force).max()) for m in best.measured))
    timed = _is_timed(best.measured)
    with matplotlib.rc_context(STYLE):
        figure = new_figure(12.0, 6.0)
        if timed:
            axes = figure.subplot_mosaic([["force", "band"], ["time", "residual"]])
            _draw_force(axes["time"], drawn, scale, by_time=True)
            axes["time"].set_xlabel("time [s]")
        else:
            axes = figure.subplot_mosaic([["force", "band"], ["force", "residual"]])
        _draw_force(axes["force"], drawn, scale, by_time=False)
        axes["force"].set_xlabel(scale.x_label)
        axes["force"].set_title("Recordings and laws", **_TITLE)
        axes["force"].legend(loc="upper left", fontsize=9)
        x = _Abscissa(scale, timed)
        spans = [(r, span) for r in fit.regions if r.test == best.test.name and not r.adequate
                 for span in x.spans(r, best.measured)]
        for _, (start, end) in spans:
            for name in ("band", "residual") if timed else axes:
                axes[name].axvspan(start, end, fc=MISFIT, alpha=0.09, lw=0, zorder=0)
                for edge in (start, end):
                    axes[name].axvline(edge, color=MISFIT, alpha=0.35, lw=0.8, zorder=0)
        _draw_band(axes["band"], best, look["color"], x)
        _draw_residuals(axes["residual"], drawn, x)
        _label(axes["residual"], spans, best.test)
        axes["band"].sharex(axes["residual"])
        axes["band"].tick_params(labelbottom=False)
        axes["residual"].set_xlabel("time [s]" if timed else scale.x_label)
        figure.align_ylabels((axes["band"], axes["residual"]))
        return to_png(figure)


@dataclass(frozen=True)
class Scale:
    """From SI to what is plotted: factors and labels."""

    x: float
    y: float
    x_label: str
    y_unit: str
    y_name: str


def scale_of(test: Test, largest: float) -> Scale:
    """mm and N; where the test has no specimen, strain and the pressure unit that suits the largest stress, Pa."""
    if test.specimen is not None:
        return Scale(1e3, 1.0, "displacement [mm]", "N", "force")
    unit, size = pressure_unit(largest)
    return Scale(1.0, 1 / size, test.kind.strain_name, unit,
                 "nominal stress")


@dataclass(frozen=True)
class _Abscissa:
    """What residuals are drawn against: time where a displacement is passed more than once, else displacement."""

    scale: Scale
    timed: bool

    def of(self, measured: MeasuredCurve) -> np.ndarray:
        return measured.clock if self.timed else self.scale.x * measured.displacement

    def spans(self, region: Region, recordings: Sequence[MeasuredCurve]) -> Iterator[tuple[float, float]]:
        """Where a region lies; a displacement that is passed in several cycles gives several."""
        measured = recordings[0]
        if not self.timed:
            yield region.start, region.end
            return
        x = self.scale.x * measured.displacement
        # Half a sample's way, so that the region's own ends count.
        slack = 1e-6 + 0.5 * float(np.median(np.abs(np.diff(x))))
        inside = (measured.segment == region.segment) & (x >= region.start - slack) & (x <= region.end + slack)
        edges = np.flatnonzero(np.diff(np.concatenate(([0], inside.astype(int), [0]))))
        for first, after in edges.reshape(-1, 2):
            if after - first > 1:
                yield float(measured.clock[first]), float(measured.clock[after - 1])


def _is_timed(recordings: Sequence[MeasuredCurve]) -> bool:
    return all(m.time is not None and m.segment is not None and np.unique(m.segment).size > 1 for m in recordings)


def _draw_force(axes, drawn, scale: Scale, by_time: bool) -> None:
    best = drawn[0][0]
    points = sum(m.force.size for m in best.measured)
    for i, m in enumerate(best.measured):
        thin = thinned(m.force.size)
        x = m.time if by_time else scale.x * m.displacement
        axes.plot(x[thin], scale.y * m.force[thin], "o", ms=4, **cloud(points),
                  label=f"measured ({counted(len(best.measured), 'recording')})" if i == 0 else None)
    for rank, (curves, fit, look) in enumerate(drawn):
        style = {**look, "lw": 1.8 if rank == 0 else 1.2, "zorder": 4 - rank / len(drawn)}
        x, force, band = scale.x * curves.displacement, curves.force, curves.band
        if by_time:
            along = _along(curves, curves.measured[0])
            if along is None:
                continue
            x, force, band = curves.measured[0].time, along[:, 0], along[:, 1]
        if rank == 0:
            axes.fill_between(x, scale.y * (force - band), scale.y * (force + band), color=look["color"], alpha=0.25,
                              lw=0, zorder=2, label="95 % of new recordings")
        axes.plot(x, scale.y * force, label=find_law(fit.law).title, **style)
    axes.set_ylabel(f"{scale.y_name} [{scale.y_unit}]")


def _draw_band(axes, best: TestCurves, colour: str, x: _Abscissa) -> None:
    """The law's curve as it stands minus the recordings, without their offsets and zeros, in its prediction band."""
    y = x.scale.y
    axes.set_ylabel(f"model − data [{x.scale.y_unit}]")
    axes.axhline(0.0, color=colour, lw=1.6)
    first = best.measured[0]
    along = [_along(best, m) for m in best.measured]
    known = [values for values in along if values is not None]
    if len(known) < len(along):
        axes.text(0.5, 0.75, "no curve without a time that all recordings share", transform=axes.transAxes, ha="center",
                  color="0.4")
        return
    places = first.time if x.timed else x.scale.x * best.displacement
    band, error = known[0][:, 1:].T if x.timed else (best.band, best.force_error)
    axes.fill_between(places, -y * band, y * band, color=colour, alpha=0.2, lw=0,
                      label="95 % of new recordings")
    axes.fill_between(places, -2 * y * error, 2 * y * error, color=colour, alpha=0.35, lw=0,
                      label="± 2 standard errors of the model")
    for i, (m, values) in enumerate(zip(best.measured, known, strict=True)):
        thin = thinned(m.force.size)
        away = y * (values[:, 0] - m.force)
        axes.plot(x.of(m)[thin], away[thin], "o", ms=2.2, mew=0, color="0.35", alpha=0.4,
                  label="recordings" if i == 0 else None)
    _head(axes, "Recordings as they came, against the prediction band")


def _along(curves: TestCurves, measured: MeasuredCurve) -> np.ndarray | None:
    """Force, band and standard error of the model at the samples of a recording, shape (n, 3); NaN beyond the model's
    path. None where the path passes a displacement twice and tells no time."""
    path, at = curves.displacement, measured.displacement
    if curves.time is not None and measured.time is not None:
        path, at = curves.time, measured.time
    if np.any(np.diff(path) < 0):
        return None
    found = np.stack([np.interp(at, path, values) for values in (curves.force, curves.band, curves.force_error)], 1)
    slack = 0.01 * np.ptp(path)
    found[(at < path[0] - slack) | (at > path[-1] + slack)] = np.nan
    return found


def _draw_residuals(axes, drawn, x: _Abscissa) -> None:
    """Residuals, means of bins, of each recording and of all; those of the other laws thin."""
    best = drawn[0][0]
    y = x.scale.y
    noise = y * float(np.sqrt(np.mean([m.noise.deviation**2 for m in best.measured])))
    axes.axhspan(-2 * noise, 2 * noise, color="0.6", alpha=0.22, lw=0, label="± 2 noise")
    edges = np.linspace(min(x.of(m).min() for m in best.measured), max(x.of(m).max() for m in best.measured), _BINS + 1)
    reach = [2.2 * noise]
    for rank, (curves, _, other) in enumerate(drawn):
        by_run: dict[int, list[np.ndarray]] = {}
        for m, fitted in zip(curves.measured, curves.fitted, strict=True):
            for run, (means, spread) in enumerate(_binned(m, y * (fitted - m.force), x, edges)):
                by_run.setdefault(run, []).append(means)
                if rank == 0:
                    reach.append(np.abs(means[1][np.isfinite(means[1])]).max(initial=0.0))
                    axes.plot(*means, color="0.45", lw=0.9, zorder=2,
                              label="each recording" if m is best.measured[0] and run == 0 else None)
                    if m is best.measured[0]:
                        axes.fill_between(means[0], -2 * y * spread, 2 * y * spread, color="0.5", alpha=0.28, lw=0,
                                          label="± 2 noise of a mean of one" if run == 0 else None)
        for run, means in by_run.items():
            whole = np.stack(means)
            seen = np.isfinite(whole[:, 1]).any(axis=0)
            axes.plot(*np.nanmean(whole[:, :, seen], axis=0), **other, lw=2.2 if rank == 0 else 1.1,
                      zorder=5 - rank / len(drawn), label="all" if rank == 0 and run == 0 else None)
    axes.axhline(0.0, color="0.3", lw=0.8)
    axes.set_ylim(-1.45 * max(reach), 1.45 * max(reach))
    axes.set_ylabel(f"model − data [{x.scale.y_unit}]")
    _head(axes, "Residuals, own offset and zero taken out (means of bins)")


def _binned(measured: MeasuredCurve, residual: np.ndarray, x: _Abscissa, edges: np.ndarray):
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


def _label(axes, spans, test: Test) -> None:
    """Size of each misfit over its region, on two levels so that neighbours do not overlap."""
    for i, (region, (start, end)) in enumerate(spans):
        name = f"{region.segment}: " if region.segment else ""
        words = f"{name}misfit {size_of(region.misfit_N, test)}\n{probability(region.p)}"
        axes.text((start + end) / 2, 0.97 if i % 2 == 0 else 0.06, words, transform=axes.get_xaxis_transform(),
                  ha="center", va="top" if i % 2 == 0 else "bottom", fontsize=8, color="#8a3c00", zorder=6,
                  bbox={"fc": "white", "ec": "none", "alpha": 0.75, "pad": 1.5})


def size_of(force: float, test: Test) -> str:
    """A force in N, or a stress where the test has no specimen: two digits."""
    unit, size = pressure_unit(force) if test.specimen is None else ("N", 1.0)
    return f"{float(f'{force / size:.2g}'):g} {unit}"


def place_of(region: Region, test: Test) -> str:
    """``ramp, 3.3 to 6.7 mm``."""
    start, end = f"{region.start:.3g}", f"{region.end:.3g}"
    span = f"{start if start == end else f'{start} to {end}'}{' mm' if test.specimen is not None else ''}"
    return f"{region.segment}, {span}" if region.segment else span


def probability(p: float) -> str:
    """``p = 0.031``, ``p < 1e-6``."""
    return "p < 1e-6" if p < 1e-6 else f"p = {p:.2g}"


def _head(axes, title: str) -> None:
    """Title and legend above a panel, where no data are."""
    axes.set_title(title, **_TITLE)
    axes.legend(loc="lower left", bbox_to_anchor=(-0.01, 1.0), ncols=4, fontsize=8, borderaxespad=0.1,
                handlelength=1.3, columnspacing=1.1, handletextpad=0.5)
