"""Define the views of a test: pairs of plotted quantities, computed in the same way for recordings and laws."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Literal

import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.fit.curves import TestCurves
from calibration.report.quantities import DisplayUnit, ReportUnits


@dataclass(frozen=True)
class LocalSlopeSettings:
    """Settings of the local slopes (tangents) of a curve.

    Attributes:
        positions: number of positions at which a slope is computed.
        min_window: smallest width of the window, as a fraction of the range of the abscissa.
        max_window: largest width of the window, as a fraction of the range of the abscissa.
        min_samples: minimum number of samples in a window.
        max_noise: allowed standard deviation of a slope due to noise, as a fraction of the secant; a smaller value
            makes wider windows.
    """

    positions: int = 60
    min_window: float = 0.04
    max_window: float = 0.2
    min_samples: int = 5
    max_noise: float = 0.03


#: Settings of the tangents in the reports.
TANGENTS = LocalSlopeSettings()
#: Prefixes of the labels of segments whose tangents are drawn.
_LOADING = ("ramp", "approach", "reload")


@dataclass(frozen=True, eq=False)
class CurveTrace:
    """Measured or computed curve of a test in SI units; see `TestCurves` for tests without a specimen.

    Attributes:
        time: time, s, shape (n,), or None.
        displacement: displacement, m, shape (n,).
        force: force, N, shape (n,).
        segment: label of the segment of each sample, shape (n,), or None.
        band: half width of the prediction band, N, shape (n,), or None.
    """

    time: np.ndarray | None
    displacement: np.ndarray
    force: np.ndarray
    segment: np.ndarray | None
    band: np.ndarray | None = None

    @classmethod
    def from_recording(cls, measured: MeasuredCurve) -> CurveTrace:
        """Return the trace of the measured force and displacement of a recording, without a band."""
        return cls(measured.time, measured.displacement, measured.force, measured.segment)

    def iterate_segment_names_and_bounds(self) -> Iterator[tuple[str, int, int]]:
        """Yield (label, first index, index after the last) of each segment; without labels one segment ``ramp``."""
        if self.segment is None:
            yield "ramp", 0, self.force.size
            return
        edges = np.flatnonzero(self.segment[1:] != self.segment[:-1]) + 1
        for first, after in pairwise([0, *edges.tolist(), self.segment.size]):
            yield str(self.segment[first]), first, after


#: Abscissa, ordinate and half width of the band (or None) of each connected line of a trace.
Lines = Iterator[tuple[np.ndarray, np.ndarray, np.ndarray | None]]


@dataclass(frozen=True, eq=False)
class PanelLabelsAndLineFunction:
    """Panel of a figure: labels of the axes, and the function that converts a curve to lines in the panel.

    Attributes:
        title: title of the panel.
        x: label of the horizontal axis.
        y: label of the vertical axis.
        lines: returns the lines of a trace in the units of the axes.
        own: whether laws are drawn with the contact offset and force zero of the first recording (timed tests only).
        log: whether the horizontal axis is logarithmic.
        has_log_load_axis: whether the vertical axis is logarithmic.
        rates: whether outliers are expected, which are then ignored for the scale.
        shows_displacement_response: whether laws are drawn by their displacement at the measured force of the first
            recording.
    """

    title: str
    x: str
    y: str
    lines: Callable[[CurveTrace], Lines]
    own: bool = False
    log: bool = False
    rates: bool = False
    has_log_load_axis: bool = False
    shows_displacement_response: bool = False


def list_panels_of_test(best: TestCurves, units: ReportUnits) -> list[PanelLabelsAndLineFunction]:
    """Return the panels in which the curves of a test are drawn.

    - Force against displacement, for tests with a specimen.
    - Nominal stress against strain, if grips or plates load the entire cross-section.
    - Slope (stiffness or tangent modulus) of one of these.
    - Load against time, and load in holds against the logarithm of time, for timed tests. Under force control the
      displacement replaces the load.
    - For a table of moduli only the modulus against frequency, both logarithmic.
    """
    if best.test.modulus:
        return [PanelLabelsAndLineFunction(
            best.test.modulus.capitalize(), "frequency [Hz]", units.pressure.format_axis_label(best.test.modulus),
            partial(_iterate_modulus_lines, units.pressure), log=True, has_log_load_axis=True)]
    test, found = best.test, []
    x, load, area = units.get_displacement_unit(test), units.get_load_unit(test), _find_loaded_area_or_none(best)
    curve, x_label = _LoadDisplacementLines(x, load), x.format_axis_label("displacement")
    history = _ChannelTimeLines(load)
    if not test.states_stress:
        found.append(PanelLabelsAndLineFunction("Force and displacement", x_label, load.format_axis_label("force"),
                                                curve.iterate_lines))
    if area is not None:
        height = test.reference_height
        curve = _LoadDisplacementLines(DisplayUnit("", height),
                                       DisplayUnit(units.pressure.name, units.pressure.size * area))
        x_label = test.kind.strain_name
        found.append(PanelLabelsAndLineFunction("Stress and strain", x_label,
                                                units.pressure.format_axis_label("nominal stress"),
                                                curve.iterate_lines))
    tangent = replace(curve, window=_choose_tangent_half_width_in_axis_unit(best.measured, curve))
    words, rate = ("tangent modulus", curve.y.name) if area is not None else \
        ("stiffness", f"{curve.y.name}/{curve.x.name}")
    found.append(PanelLabelsAndLineFunction(words.capitalize(), x_label, f"{words} [{rate}]", tangent.iterate_tangents,
                                            own=True, rates=True))
    if have_times_and_several_segments(best.measured):
        creeps = best.measured[0].force_control is not None
        name = load.format_axis_label("nominal stress" if test.states_stress else "force")
        if creeps:
            name = test.kind.strain_name if test.states_stress else x.format_axis_label("displacement")
            history = _ChannelTimeLines(x, "displacement")
        found.append(PanelLabelsAndLineFunction("Displacement over time" if creeps else "Load over time", "time [s]",
                                                name, history.iterate_lines, shows_displacement_response=creeps))
        if any(label.startswith("hold") for label, _,
               _ in CurveTrace.from_recording(best.measured[0]).iterate_segment_names_and_bounds()):
            found.append(PanelLabelsAndLineFunction("Creep in holds" if creeps else "Relaxation in holds",
                                                    "time since the start of the hold [s]", name,
                                                    history.iterate_holds, own=True, log=True,
                                                    shows_displacement_response=creeps))
    return found


def _iterate_modulus_lines(pressure: DisplayUnit, trace: CurveTrace) -> Lines:
    """Yield one line: frequency, Hz, modulus and band (or None), in display units, from the log of the modulus."""
    modulus = np.exp(trace.force) / pressure.size
    yield trace.displacement, modulus, None if trace.band is None else modulus * trace.band


def _find_loaded_area_or_none(curves: TestCurves) -> float | None:
    """Return the loaded cross-section, m2; 1 for recordings of stress.

    Returns:
        The area; None if the tool is smaller than the specimen or the specimen has no constant cross-section.
    """
    test = curves.test
    if test.specimen is None or test.states_stress:
        return 1.0
    whole = test.kind.tool is None or test.kind.tool.shape == "plate"
    return test.specimen.area if whole and test.specimen.is_prism else curves.area


def have_times_and_several_segments(recordings: Sequence[MeasuredCurve]) -> bool:
    """Return whether a test has several segments and time, so that it must be drawn over time."""
    return all(m.time is not None and m.segment is not None and np.unique(m.segment).size > 1 for m in recordings)


def get_law_trace_or_none(curves: TestCurves, own: bool = False,
                          shows_displacement_response: bool = False) -> CurveTrace | None:
    """Return the fitted curve of a law for drawing; None if the recording and the model have no common time.

    For a timed test the curve is evaluated at the samples of the first recording, otherwise along the model's motion.

    Args:
        curves: recorded and fitted curves of a test.
        own: whether a timed test uses the contact offset and force zero of the first recording.
        shows_displacement_response: whether the curve is the displacement at the measured force of the first recording.

    Returns:
        The curve; None if model and recording have no common time.
    """
    first = curves.measured[0]
    if shows_displacement_response:
        displacement = next(iter(curves.displacements), None)
        return None if displacement is None else replace(CurveTrace.from_recording(first), displacement=displacement)
    if own and have_times_and_several_segments(curves.measured):
        return replace(CurveTrace.from_recording(first), force=curves.fitted[0])
    if not have_times_and_several_segments(curves.measured):
        return CurveTrace(curves.time, curves.displacement, curves.force, None, curves.band)
    values = interpolate_force_and_bands_or_none(curves, first)
    return None if values is None else replace(CurveTrace.from_recording(first), force=values[:, 0], band=values[:, 1])


#: Largest difference of two stretches in equal motions, as a fraction of their range.
_EQUAL_MOTIONS = 0.05


def _has_motions_of_first_recording(curves: TestCurves, measured: MeasuredCurve) -> bool:
    """Return whether a recording has the motions of the first one, along which the model is drawn."""
    first = curves.measured[0]
    if measured is first or measured.motions is None or first.motions is None:
        return True
    order = np.argsort(first.displacement, kind="stable")
    expected = np.stack([np.interp(measured.displacement, first.displacement[order], column[order])
                         for column in first.motions.T], axis=-1)
    return float(np.abs(measured.motions - expected).max()) <= _EQUAL_MOTIONS * float(np.ptp(first.motions))


def interpolate_force_and_bands_or_none(curves: TestCurves, measured: MeasuredCurve) -> np.ndarray | None:
    """Interpolate a law to the samples of a recording, over time if both have time, otherwise over displacement.

    Returns:
        Force, half width of the sample band, half width of the curve band, and standard error of the force, N, shape
        (n, 4); NaN outside the model's motion. None if the abscissa of the model is not monotonic, or if the recording
        has other motions than the first one.
    """
    model, samples = curves.displacement, measured.displacement
    if curves.time is not None and measured.time is not None:
        model, samples = curves.time, measured.time
    if np.any(np.diff(model) < 0) or not _has_motions_of_first_recording(curves, measured):
        return None
    found = np.stack([np.interp(samples, model, values) for values in (
        curves.force, curves.band, curves.whole_band, curves.force_error)], 1)
    slack = 0.01 * np.ptp(model)
    found[(samples < model[0] - slack) | (samples > model[-1] + slack)] = np.nan
    return found


@dataclass(frozen=True)
class _LoadDisplacementLines:
    """Conversion of traces to lines of load against displacement, or of stress against strain, in display units.

    Attributes:
        x: unit of the abscissa.
        y: unit of the ordinate.
        window: half width of the window of a tangent, in units of x.
    """

    x: DisplayUnit
    y: DisplayUnit
    window: float = 0.0

    def iterate_lines(self, trace: CurveTrace) -> Lines:
        """Yield one line: displacement, load and band (or None), in display units."""
        band = None if trace.band is None else trace.band / self.y.size
        yield trace.displacement / self.x.size, trace.force / self.y.size, band

    def iterate_tangents(self, trace: CurveTrace) -> Lines:
        """Yield the local slopes of each loading segment; the window is the same for all traces."""
        (x, y, _), = self.iterate_lines(trace)
        for label, first, after in trace.iterate_segment_names_and_bounds():
            if label.startswith(_LOADING) and after - first >= TANGENTS.min_samples:
                yield (*compute_positions_and_local_slopes(x[first:after], y[first:after], self.window), None)


@dataclass(frozen=True)
class _ChannelTimeLines:
    """Conversion of traces to lines of load or displacement against time, in display units.

    Attributes:
        y: unit of the ordinate.
        channel: ``"force"`` or ``"displacement"``.
    """

    y: DisplayUnit
    channel: Literal["force", "displacement"] = "force"

    def iterate_lines(self, trace: CurveTrace) -> Lines:
        """Yield one line: time (s), load or displacement in its display unit, and band of the load (or None)."""
        assert trace.time is not None
        band = None if trace.band is None or self.channel != "force" else trace.band / self.y.size
        yield trace.time, getattr(trace, self.channel) / self.y.size, band

    def iterate_holds(self, trace: CurveTrace) -> Lines:
        """Yield load or displacement in each hold against the time since the start of the hold."""
        assert trace.time is not None
        for label, first, after in trace.iterate_segment_names_and_bounds():
            start = max(first - 1, 0)
            if label.startswith("hold") and after - first > 1:
                since = trace.time[start:after] - trace.time[start]
                # Times below half a sampling interval are within the resolution of the clock.
                resolved = since > 0.5 * np.median(np.diff(since))
                yield since[resolved], getattr(trace, self.channel)[start:after][resolved] / self.y.size, None


def _choose_tangent_half_width_in_axis_unit(recordings: Sequence[MeasuredCurve],
                                            curve: _LoadDisplacementLines) -> float:
    """Return the half width h of the tangent window, in the unit of the x axis, for the allowed noise of a slope.

    The slope of a line through n samples over a width of 2 h has the standard deviation s sqrt(3 / n) / h, where s is
    the noise of a sample.
    """
    first = recordings[0]
    (x, y, _), = curve.iterate_lines(CurveTrace.from_recording(first))
    reach, secant = np.ptp(x) or 1.0, np.ptp(y) or 1.0
    loading = sum(after - start for label, start,
                  after in CurveTrace.from_recording(first).iterate_segment_names_and_bounds()
                  if label.startswith(_LOADING))
    allowed = TANGENTS.max_noise * secant / reach
    noise, density = first.noise.deviation / curve.y.size, max(loading, 1) / reach
    window = (noise * np.sqrt(1.5 / density) / allowed)**(2 / 3)
    return float(np.clip(window, TANGENTS.min_window / 2 * reach, TANGENTS.max_window / 2 * reach))


def compute_positions_and_local_slopes(x: np.ndarray, y: np.ndarray, window: float) -> tuple[np.ndarray, np.ndarray]:
    """Fit straight lines to the samples in windows along a curve; return their mean positions and slopes.

    Args:
        x: abscissa, shape (n,).
        y: ordinate, shape (n,).
        window: half width of a window; a window with fewer than five samples is widened to the nearest five.

    Returns:
        Positions and slopes, each of shape (k,).
    """
    low, high = float(x.min()), float(x.max())
    inset = min(window, 0.25 * (high - low))
    nearest = TANGENTS.min_samples - 1
    positions, slopes = [], []
    for centre in np.linspace(low + inset, high - inset, TANGENTS.positions):
        distance = np.abs(x - centre)
        near = distance <= max(window, np.partition(distance, nearest)[nearest])
        deviation = x[near] - x[near].mean()
        spread = deviation @ deviation
        if spread > 0:
            positions.append(float(x[near].mean()))
            slopes.append(float(deviation @ y[near] / spread))
    return np.array(positions), np.array(slopes)
