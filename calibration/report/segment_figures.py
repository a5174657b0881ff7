"""Draw the segments of recordings and write the report section about segments."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from html import escape
from typing import TYPE_CHECKING

import numpy as np

from calibration.output_folder import make_numbered_test_figure_name
from calibration.report.drawing import FigureEmbedder, create_figure
from calibration.report.layout import LAYOUT
from calibration.report.page import make_html_list
from tissue_sim.recording.contact import Contact

if TYPE_CHECKING:
    from calibration.campaign.campaign import Campaign
    from calibration.campaign.measured import MeasuredCurve
    from tissue_sim.recording.segments import Segmentation

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
    stressed = segmentation.stressed
    travel, load = (displacement, 1e-3 * force) if stressed else (1e3 * displacement, force)
    words = ("strain", "stress [kPa]") if stressed else ("displacement [mm]", "force [N]")
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
                             stressed)
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
                         words: tuple[str, str], stressed: bool) -> None:
    """Draw load over displacement near first contact: zero and drift of the force, contact, and its 95 % interval."""
    scale, factor = (1.0, 1e-3) if stressed else (1e3, 1.0)
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


def iterate_segment_section_html(campaign: Campaign, recordings: Mapping[str, Sequence[MeasuredCurve]],
                                 pictures: FigureEmbedder | None) -> Iterator[str]:
    """Yield the HTML of the section on segments: segments and fitted samples of each recording, one figure per test.

    The figure shows the first recording with a note, or the first recording if none has a note.
    """
    known = {test: [curve for curve in curves if curve.whole is not None] for test, curves in recordings.items()}
    if not any(known.values()):
        return
    yield "<h2>Segments</h2>"
    yield ('<p class="quiet">Segments are the labels in the file. Without labels they are found from the motion, the '
           "first rise of the force above its zero and drift (contact), and the first loss of force during loading "
           "(failure).</p>")
    for number, test in enumerate(each.name for each in campaign.tests):
        if not (curves := known.get(test)):
            continue
        yield f"<h3>{escape(test)}</h3>"
        yield make_html_list(_describe_recording(curve) for curve in curves)
        if pictures is not None:
            drawn = next((curve for curve in curves if curve.notes), curves[0])
            yield pictures.embed_figure(make_numbered_test_figure_name(campaign, number, "segments"),
                                        partial(_make_segments_figure, drawn), f"Segments of {drawn.name}",
                                        f"{escape(drawn.name)}: raw recording; the fitted samples are blue if only a "
                                        "part is fitted.")


def _make_segments_figure(curve: MeasuredCurve):
    """Draw the segments of the whole recording from which a curve was selected; return the matplotlib figure."""
    whole = curve.whole
    assert whole is not None
    return draw_segment_figure(whole.displacement + whole.shift, whole.recorded_force, whole.time, whole.segmentation,
                               whole.used)


def _describe_recording(curve: MeasuredCurve) -> str:
    """Return an HTML sentence on a recording: its segments, number of fitted samples, contact and notes."""
    whole = curve.whole
    assert whole is not None
    found = whole.segmentation
    runs = [name for name, _, _ in found.iterate_segment_names_and_bounds()]
    parts = [f"{'stated' if found.stated else 'found'}: {_format_segments_with_repeat_counts(runs)}",
             f"{int(whole.used.sum())} of {whole.used.size} samples fitted"]
    if found.contact is not None:
        parts.append(found.contact.in_words(stressed=found.stressed))
    if whole.shift:
        parts.append(f"displacement measured from {1e3 * whole.shift:.4g} mm")
    notes = "".join(f'<br><span class="bad">{escape(note)}</span>' for note in curve.notes.values())
    return f"<b>{escape(curve.name)}</b>: {escape('; '.join(parts))}{notes}"


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
