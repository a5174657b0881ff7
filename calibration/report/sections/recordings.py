"""Sections with the recordings: fitted curves, regions, offsets, segments, files."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from calibration.campaign.campaign import Test
from calibration.campaign.measured import MeasuredCurve
from calibration.output_folder import make_numbered_test_figure_name
from calibration.report.content import (
    LINE_BREAK,
    Block,
    Column,
    Details,
    Figure,
    Heading,
    Listing,
    Paragraph,
    Part,
    Span,
    Table,
    Text,
)
from calibration.report.curve_figures import describe_region, draw_test_figure, format_p_value_text
from calibration.report.drawing import LAYOUT, create_figure, format_count
from calibration.report.figures import draw_region_misfit_map
from calibration.report.fit_text import format_law_title
from calibration.report.quantities import ReportUnits, format_value_and_error
from calibration.report.section import CalibrationReport, DiagnosisReport, Section
from tissue_sim.recording.contact import Contact
from tissue_sim.recording.curve_units import CurveUnits

if TYPE_CHECKING:
    from tissue_sim.recording.segments import Segmentation

class RegionMisfits(Section):
    """Misfit of each law in each region of each test, and the statistical tests of the residuals."""

    name = "region_misfits"
    title = "Misfit by region"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield the figure and the table; nothing if the residuals were not tested."""
        if not any(fit.regions for fit in report.fits):
            return
        yield Figure("regions", partial(draw_region_misfit_map, report.fits, report.campaign.tests, report.units),
                     "Misfit of each law in each region of each test",
                     "Root mean square of the misfit in each region and its probability by chance, adjusted for the "
                     "number of regions (Holm); orange for p ≤ 0.05. Offsets, zeros and mesh error can compensate part "
                     "of the misfit; the numbers do not include this compensation.")
        table = _make_residual_test_table(report)
        yield Details("In numbers", [table]) if report.has_figures else table


def _make_residual_test_table(report: CalibrationReport) -> Table:
    """Return the table of the statistical tests of the residuals: one row per law and region of a test."""
    units = report.units
    rows: list[list[Text | None]] = []
    for fit in report.fits:
        last = None
        for r in fit.regions:
            test = report.tests[r.test]
            load, travel = units.get_load_unit(test), units.get_displacement_unit(test)
            at = travel.format_quantity(r.at * (1.0 if test.states_stress else 1e-3), 3)
            rows.append([None if last else format_law_title(fit.law), None if r.test == last else r.test,
                         describe_region(r, test, units), load.format_quantity(r.misfit_N, 2),
                         f"{load.format_quantity(r.largest_N, 2)} at {at}", f"{r.statistic:.3g} ({r.freedom})",
                         format_p_value_text(r.p), "as noise" if r.adequate else Span("misfit", "bad")])
            last = r.test
    return Table([Column("Law"), Column("Test", text=True), Column("Region", text=True), Column("Misfit (rms)"),
                  Column("Largest model − data"), Column("χ² (freedom)"), Column("p, adjusted"), Column("Residuals")],
                 rows)


class RecordingOffsets(Section):
    """Contact offset and force zero of each recording, for the best law."""

    name = "recording_offsets"

    def make_title(self, report: CalibrationReport) -> str:
        """Return the title with the best law."""
        return f"Contact offsets and zeros of {format_law_title(report.result.best.law)}"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield the table; nothing if offsets and zeros were not fitted."""
        test = ReportUnits.choose_first_specimen_test_or_first(report.campaign.tests)
        travel, load = report.units.get_displacement_unit(test), report.units.get_load_unit(test)

        def format_nuisance_in_column_unit(value: float, error: float | None, size: float) -> str:
            """Return a value with its standard error as text without unit, in the unit with this size."""
            return format_value_and_error(value / size, error and error / size)

        if report.result.best.nuisances:
            yield Table([Column("Recording"), Column(travel.format_axis_label("Contact offset")),
                         Column(load.format_axis_label("Zero")), Column("On its bound", text=True, optional=True)], [
                [n.replicate,
                 format_nuisance_in_column_unit(n.contact_offset_mm, n.contact_offset_error_mm, travel.size * 1e3),
                 format_nuisance_in_column_unit(n.zero_offset_N, n.zero_offset_error_N, load.size),
                 Span(", ".join(n.on_bound), "bad") if n.on_bound else ""]
                for n in report.result.best.nuisances], narrow=True)


#: Segment -> colour of its time span; other segments are grey.
SPANS = {"approach": "#56B4E9", "preload": "#CC79A7", "preconditioning": "#E69F00", "ramp": "#009E73",
         "load": "#009E73", "hold": "#7F3C8D", "unload": "#999999", "retract": "#999999", "reload": "#0072B2",
         "failure": "#D55E00"}


def draw_segment_figure(displacement: np.ndarray, force: np.ndarray, time: np.ndarray | None,
                        segmentation: Segmentation, used: np.ndarray | None = None):
    """Draw the segments of a recording over time, and a detail view of its contact.

    Args:
        displacement: displacement, m (strain for a recording of stress), shape (n,).
        force: force, N (stress, Pa), shape (n,).
        time: time, s, shape (n,); None: the sample number is used.
        segmentation: segments found in the recording.
        used: mask of the fitted samples, shape (n,); None: no marking.

    Returns:
        The matplotlib figure.
    """
    units = segmentation.units
    travel, load = units.motion_factor * displacement, units.load_factor * force
    words = units.motion_label, units.load_label
    # A table without time is drawn over the displacement.
    table = time is None and bool(np.all(np.diff(travel) >= 0))
    clock = travel if table else np.arange(force.size) if time is None else time
    contact = segmentation.contact
    has_detail = contact is not None and np.isfinite(contact.interval[1])
    figure = create_figure(LAYOUT.width, LAYOUT.segment_height)
    over_time, detail = figure.subplots(1, 2, width_ratios=(1.6, 1)) if has_detail else (figure.subplots(), None)
    _draw_segment_spans(over_time, clock, segmentation)
    line, = over_time.plot(clock, load, color="0.15", lw=1.1, label=words[1])
    if used is not None and not used.all():
        over_time.plot(np.where(used, clock, np.nan), load, color="#0072B2", lw=3.2, alpha=0.55,
                       label="fitted", zorder=1.9)
    _mark_failure(over_time, clock, load, segmentation)
    if not table:
        _draw_displacement_over_time(over_time.twinx(), clock, travel, words[0])
    over_time.set(xlabel=words[0] if table else "sample" if time is None else "time [s]", ylabel=words[1],
                  xlim=(clock[0], max(clock[-1], clock[0] + 1e-9)))
    over_time.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=6, fontsize=8.5, borderaxespad=0.2)
    line.set_zorder(3)
    if detail is not None and contact is not None:
        _draw_contact_detail(detail, travel, load, np.arange(force.size) if time is None else time, contact, words,
                             units)
    return figure


def _draw_displacement_over_time(axes, clock: np.ndarray, travel: np.ndarray, label: str) -> None:
    """Draw the displacement over time as a dashed line, with its label on the right axis."""
    axes.plot(clock, travel, color="0.45", lw=1.0, ls=(0, (4, 2)))
    axes.set_ylabel(f"{label} (dashed)", color="0.4")
    axes.grid(visible=False)
    axes.spines["right"].set_visible(True)


def _draw_segment_spans(axes, clock: np.ndarray, segmentation: Segmentation) -> None:
    """Shade the time span of each segment in the colour of its name."""
    named: set[str] = set()
    for name, first, end in segmentation.iterate_segment_names_and_bounds():
        last = min(end, clock.size - 1)
        axes.axvspan(clock[first], clock[last], color=SPANS.get(name, "0.8"), alpha=0.22, lw=0, zorder=0,
                     label=None if name in named else name)
        named.add(name)


def _mark_failure(axes, clock: np.ndarray, load: np.ndarray, segmentation: Segmentation) -> None:
    """Mark the sample of the failure by a triangle; draw nothing if there is no failure."""
    failure = segmentation.failure
    if failure is not None:
        axes.plot(clock[failure.index], load[failure.index], "v", color=SPANS["failure"], ms=9, zorder=4,
                  label=failure.mode)


def _draw_contact_detail(axes, travel: np.ndarray, load: np.ndarray, clock: np.ndarray, contact: Contact,
                         words: tuple[str, str], units: CurveUnits) -> None:
    """Draw load over displacement near first contact: zero and drift of the force, contact, and its 95 % interval."""
    scale, factor = units.motion_factor, units.load_factor
    position = scale * contact.displacement
    low, high = (scale * end for end in contact.interval)
    beyond = max(LAYOUT.fraction_after_contact * (travel.max() - position), 2 * (high - position))
    end = int(np.argmax(travel >= position + beyond)) or travel.size
    first = max(contact.index - LAYOUT.samples_before_contact, 0)
    shown = slice(first, end)
    axes.plot(travel[shown], load[shown], ".", ms=3.5, color="0.25", zorder=3)
    base = factor * (contact.force_zero + contact.drift * (clock[shown] - clock[0]))
    axes.plot(travel[shown], base, color=SPANS["approach"], lw=1.6, label="zero and drift")
    left = low if np.isfinite(low) else float(travel[shown].min())
    axes.axvspan(left, high, color=SPANS["failure"], alpha=0.2, lw=0, label="95 %")
    if contact.has_air_before_contact:
        axes.axvline(position, color=SPANS["failure"], lw=1.2, label="contact")
    titles = {"found": "contact", "before": "recording starts in contact", "unclear": "contact cannot be determined",
              "none": "no contact"}
    axes.set(xlabel=words[0], ylabel=words[1])
    axes.set_title(titles[contact.status], loc="left", fontsize=10, fontweight="bold")
    axes.legend(loc="upper left", fontsize=8.5)


def draw_segments_of_recording(curve: MeasuredCurve):
    """Draw the segments of the whole recording from which a curve was selected; return the matplotlib figure."""
    whole = curve.whole
    assert whole is not None
    return draw_segment_figure(whole.displacement + whole.shift, whole.recorded_force, whole.time, whole.segmentation,
                               whole.used)


class Segments(Section):
    """Segments and fitted samples of each recording, with one figure per test.

    The figure shows the first recording with a note, or the first recording if none has a note.
    """

    name = "segments"
    title = "Segments"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield a note, then a heading, a list and a figure for each test; nothing without segmented recordings."""
        known = {test: [curve for curve in curves if curve.whole is not None]
                 for test, curves in report.recordings.items()}
        if not any(known.values()):
            return
        yield Paragraph("Segments are the labels in the file. Without labels they are found from the motion, the first "
                        "rise of the force above its zero and drift (contact), and the first loss of force during "
                        "loading (failure).", quiet=True)
        for number, test in enumerate(each.name for each in report.campaign.tests):
            if not (curves := known.get(test)):
                continue
            yield Heading(test)
            yield Listing([_describe_recording(curve) for curve in curves])
            drawn = next((curve for curve in curves if curve.notes), curves[0])
            yield Figure(make_numbered_test_figure_name(report.campaign, number, "segments"),
                         partial(draw_segments_of_recording, drawn), f"Segments of {drawn.name}",
                         f"{drawn.name}: raw recording; the fitted samples are blue if only a part is fitted.")


def _describe_recording(curve: MeasuredCurve) -> Text:
    """Return a sentence on a recording: its segments, number of fitted samples, contact and notes."""
    whole = curve.whole
    assert whole is not None
    found = whole.segmentation
    runs = [name for name, _, _ in found.iterate_segment_names_and_bounds()]
    parts = [f"{'stated' if found.stated else 'found'}: {_format_segments_with_repeat_counts(runs)}",
             f"{int(whole.used.sum())} of {whole.used.size} samples fitted"]
    if found.contact is not None:
        parts.append(found.contact.in_words(found.units))
    if whole.shift:
        parts.append(f"displacement measured from {1e3 * whole.shift:.4g} mm")
    text: list[Part] = [Span(curve.name, "strong"), f": {'; '.join(parts)}"]
    for note in curve.notes.values():
        text += [LINE_BREAK, Span(note, "bad")]
    return text


def _format_segments_with_repeat_counts(runs: Sequence[str]) -> str:
    """Return the names of the segments as text, equal pairs counted: ``approach, ramp, 3 × (unload, reload)``."""
    parts: list[str] = []
    k = 0
    while k < len(runs):
        pair, count = list(runs[k:k + 2]), 1
        while len(pair) == 2 and list(runs[k + 2 * count:k + 2 * count + 2]) == pair:
            count += 1
        if count > 1:
            parts.append(f"{count} × ({', '.join(pair)})")
            k += 2 * count
        else:
            parts.append(runs[k])
            k += 1
    return ", ".join(parts)


class RecordingFiles(Section):
    """File name, SHA-256 and number of points of each recording."""

    name = "recording_files"
    title = "Recordings"
    reports = ("calibration", "diagnosis")

    def iterate_blocks(self, report: CalibrationReport | DiagnosisReport) -> Iterator[Block]:
        """Yield the list of the recordings."""
        yield Listing([(f"{curve.file.name} ", Span("SHA-256 ", "small"), Span(curve.sha256, "code"),
                        Span(f", {curve.force.size} points", "small"))
                       for curves in report.recordings.values() for curve in curves])


#: Explanation above the figures of the tests.
_NOTE = ("Displacement, strain, force and stress are positive under load. Tangents are slopes of straight lines "
         "fitted in short windows, the same for recordings and laws. Laws are drawn without contact offset and force "
         "zero. Exception: tangents and holds of tests with holds use the offset and zero of the first recording. Band "
         "and residuals (model − data) belong to the first law; other laws may leave the frame. Shaded: regions whose "
         "residuals exceed the noise.")


class RecordingsAndLaws(Section):
    """Recordings, laws, tangents, prediction band and residuals of each test."""

    name = "recordings_and_laws"
    title = "Recordings and laws"
    needs_figures = True

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield a note, then a heading and a figure for each test."""
        yield Paragraph(_NOTE, quiet=True)
        for i, test in enumerate(report.campaign.tests):
            of_test = {law: several[i] for law, several in report.curves.items()}
            count = len(next(iter(of_test.values())).measured)
            yield Heading((f"{test.name} ", Span(_format_test_description(test, count), "small")))
            yield Figure(make_numbered_test_figure_name(report.campaign, i),
                         partial(draw_test_figure, report.fits, of_test, report.units),
                         f"Recordings, curves, prediction band and residuals of {test.name}")


def _format_test_description(test: Test, count: int) -> str:
    """Describe a test: ``needle indentation of phantom, flat tool of radius 8 mm, face bonded; 3 recordings``."""
    words = test.kind.name.replace("_", " ")
    if test.specimen is not None:
        words += f" of {test.specimen.name}"
    if test.experiment is not None:
        tool, friction = test.experiment.tool, test.experiment.friction
        if tool.radius is not None:
            words += f", {tool.shape} tool of radius {tool.radius * 1e3:g} mm"
        words += f", face {friction}" if isinstance(friction, str) else f", face with friction {friction:g}"
    return f"{words}; {format_count(count, 'recording')}{'; held out: predicted, not fitted' if test.hold_out else ''}"
