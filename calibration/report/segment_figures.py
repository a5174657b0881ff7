"""Draw the segments of recordings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from calibration.report.drawing import LAYOUT, create_figure
from tissue_sim.recording.contact import Contact

if TYPE_CHECKING:
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


def draw_segments_of_recording(curve: MeasuredCurve):
    """Draw the segments of the whole recording from which a curve was selected; return the matplotlib figure."""
    whole = curve.whole
    assert whole is not None
    return draw_segment_figure(whole.displacement + whole.shift, whole.recorded_force, whole.time, whole.segmentation,
                               whole.used)
