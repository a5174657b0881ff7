"""Ways to look at a test: what is drawn against what, of a recording and of a law alike."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.fit.curves import TestCurves
from calibration.report.units import Unit, Units

#: Places of a tangent, its least window as a share of the range, the fewest samples in it, and the share of the secant
#: that noise may make of it.
_PLACES, _WINDOW, _FEWEST, _NOISE = 60, 0.04, 5, 0.03
#: Largest window, as a share of the range.
_WIDEST = 0.2
#: How the labels of segments begin whose tangents are drawn.
_LOADING = ("ramp", "approach", "reload")


@dataclass(frozen=True, eq=False)
class Trace:
    """A course of a test, measured or computed. SI; see `TestCurves` for tests without a specimen.

    Attributes:
        time: s, shape (n,), or None. displacement, force: shape (n,). segment: labels, shape (n,), or None.
        band: half width of its prediction band, shape (n,), or None.
    """

    time: np.ndarray | None
    displacement: np.ndarray
    force: np.ndarray
    segment: np.ndarray | None
    band: np.ndarray | None = None

    @classmethod
    def of(cls, measured: MeasuredCurve) -> Trace:
        """That of a recording."""
        return cls(measured.time, measured.displacement, measured.force, measured.segment)

    def runs(self) -> Iterator[tuple[str, int, int]]:
        """Label, first and after the last sample of each segment, one after the other; all is one loading without."""
        if self.segment is None:
            yield "ramp", 0, self.force.size
            return
        edges = np.flatnonzero(self.segment[1:] != self.segment[:-1]) + 1
        for first, after in pairwise([0, *edges.tolist(), self.segment.size]):
            yield str(self.segment[first]), first, after


#: Abscissa, ordinate and half width of the band (or None) of each part of a trace that is one line.
Lines = Iterator[tuple[np.ndarray, np.ndarray, np.ndarray | None]]


@dataclass(frozen=True, eq=False)
class View:
    """A panel's content.

    Attributes:
        title: of the panel. x, y: labels of its axes. lines: of a trace, in their units.
        own: whether laws of timed tests have the offset and zero of the first recording. log: whether the abscissa is
            logarithmic. rates: whether single places may be far off, so that they do not set the scale.
    """

    title: str
    x: str
    y: str
    lines: Callable[[Trace], Lines]
    own: bool = False
    log: bool = False
    rates: bool = False


def views(best: TestCurves, units: Units) -> list[View]:
    """Those that a test has: load against displacement; nominal stress against strain where grips or plates hold the
    whole cross-section; its tangent; load against time and, where it holds, against the logarithm of the time since."""
    test, found = best.test, []
    x, load, area = units.travel(test), units.load(test), _area(best)
    curve, x_label, course = _Curve(x, load), x.label("displacement"), _Course(load)
    if test.specimen is not None:
        found.append(View("Force and displacement", x_label, load.label("force"), curve.lines))
    if area is not None:
        height = 1.0 if test.specimen is None else test.specimen.height
        curve = _Curve(Unit("", height), Unit(units.pressure.name, units.pressure.size * area))
        x_label = test.kind.strain_name
        found.append(View("Stress and strain", x_label, units.pressure.label("nominal stress"), curve.lines))
    tangent = replace(curve, window=_window(best.measured, curve))
    words, rate = ("tangent modulus", curve.y.name) if area is not None else \
        ("stiffness", f"{curve.y.name}/{curve.x.name}")
    found.append(View(words.capitalize(), x_label, f"{words} [{rate}]", tangent.tangents, own=True, rates=True))
    if is_timed(best.measured):
        name = load.label("nominal stress" if test.specimen is None else "force")
        found.append(View("Course in time", "time [s]", name, course.lines))
        if any(label.startswith("hold") for label, _, _ in Trace.of(best.measured[0]).runs()):
            found.append(View("Relaxation in holds", "time since the hold began [s]", name, course.holds, own=True,
                              log=True))
    return found


def _area(curves: TestCurves) -> float | None:
    """Cross-section that carries the load, m2 (1 of a stress); None under a tool that is smaller than the specimen, and
    of a specimen without one cross-section."""
    test = curves.test
    if test.specimen is None:
        return 1.0
    whole = test.kind.tool is None or test.kind.tool.shape == "plate"
    return test.specimen.area if whole and test.specimen.is_prism else curves.area


def is_timed(recordings: Sequence[MeasuredCurve]) -> bool:
    """Whether a test passes a displacement more than once, so that time tells its course."""
    return all(m.time is not None and m.segment is not None and np.unique(m.segment).size > 1 for m in recordings)


def trace_of_law(curves: TestCurves, own: bool = False) -> Trace | None:
    """The course of a law: along the model's path or, of a test that time tells, at the samples of its first recording
    (with that one's offset and zero if `own`, and then exact at each of them). None where these share no time."""
    first = curves.measured[0]
    if own and is_timed(curves.measured):
        return replace(Trace.of(first), force=curves.fitted[0])
    if not is_timed(curves.measured):
        return Trace(curves.time, curves.displacement, curves.force, None, curves.band)
    along = law_along(curves, first)
    return None if along is None else replace(Trace.of(first), force=along[:, 0], band=along[:, 1])


def law_along(curves: TestCurves, measured: MeasuredCurve) -> np.ndarray | None:
    """Force, both bands and standard error of a law at the samples of a recording, shape (n, 4); NaN beyond the model's
    path. None where the path passes a displacement twice and tells no time."""
    path, at = curves.displacement, measured.displacement
    if curves.time is not None and measured.time is not None:
        path, at = curves.time, measured.time
    if np.any(np.diff(path) < 0):
        return None
    found = np.stack([np.interp(at, path, values) for values in (
        curves.force, curves.band, curves.whole_band, curves.force_error)], 1)
    slack = 0.01 * np.ptp(path)
    found[(at < path[0] - slack) | (at > path[-1] + slack)] = np.nan
    return found


@dataclass(frozen=True)
class _Curve:
    """Load against displacement, or stress against strain. window: half width of a tangent's, in units of x."""

    x: Unit
    y: Unit
    window: float = 0.0

    def lines(self, trace: Trace) -> Lines:
        band = None if trace.band is None else trace.band / self.y.size
        yield trace.displacement / self.x.size, trace.force / self.y.size, band

    def tangents(self, trace: Trace) -> Lines:
        """Of each loading: slopes of straight lines through the samples in a window, the same for all traces."""
        (x, y, _), = self.lines(trace)
        for label, first, after in trace.runs():
            if label.startswith(_LOADING) and after - first >= _FEWEST:
                yield (*local_slopes(x[first:after], y[first:after], self.window), None)


@dataclass(frozen=True)
class _Course:
    """Load against time."""

    y: Unit

    def lines(self, trace: Trace) -> Lines:
        assert trace.time is not None
        yield trace.time, trace.force / self.y.size, None if trace.band is None else trace.band / self.y.size

    def holds(self, trace: Trace) -> Lines:
        """Each hold, from its own beginning on."""
        assert trace.time is not None
        for label, first, after in trace.runs():
            start = max(first - 1, 0)
            if label.startswith("hold") and after - first > 1:
                since = trace.time[start:after] - trace.time[start]
                # Stamps of a sampled clock are not told from the beginning nearer than a step.
                told = since > 0.5 * np.median(np.diff(since))
                yield since[told], trace.force[start:after][told] / self.y.size, None


def _window(recordings: Sequence[MeasuredCurve], curve: _Curve) -> float:
    """Half width at which noise is a small share of the tangent: a line through n samples over a width of 2 h has a
    slope whose standard deviation is that of a sample times sqrt(3 / n) / h."""
    first = recordings[0]
    (x, y, _), = curve.lines(Trace.of(first))
    reach, secant = np.ptp(x) or 1.0, np.ptp(y) or 1.0
    loading = sum(after - start for label, start, after in Trace.of(first).runs() if label.startswith(_LOADING))
    allowed = _NOISE * secant / reach
    noise, density = first.noise.deviation / curve.y.size, max(loading, 1) / reach
    window = (noise * np.sqrt(1.5 / density) / allowed)**(2 / 3)
    return float(np.clip(window, _WINDOW / 2 * reach, _WIDEST / 2 * reach))


def local_slopes(x: np.ndarray, y: np.ndarray, window: float) -> tuple[np.ndarray, np.ndarray]:
    """Places and slopes of straight lines fitted to the samples within `window` of each place, or to the nearest five
    where fewer lie there; shapes (k,)."""
    low, high = float(x.min()), float(x.max())
    inset = min(window, 0.25 * (high - low))
    places, slopes = [], []
    for centre in np.linspace(low + inset, high - inset, _PLACES):
        away = np.abs(x - centre)
        near = away <= max(window, np.partition(away, _FEWEST - 1)[_FEWEST - 1])
        deviation = x[near] - x[near].mean()
        spread = deviation @ deviation
        if spread > 0:
            places.append(float(x[near].mean()))
            slopes.append(float(deviation @ y[near] / spread))
    return np.array(places), np.array(slopes)
