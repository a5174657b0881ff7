"""Section with the segments of the recordings."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial

from calibration.campaign.measured import MeasuredCurve
from calibration.output_folder import make_numbered_test_figure_name
from calibration.report.content import LINE_BREAK, Block, Figure, Heading, Listing, Paragraph, Part, Span, Text
from calibration.report.section import CalibrationReport, Section
from calibration.report.segment_figures import draw_segments_of_recording


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
        parts.append(found.contact.in_words(stressed=found.stressed))
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
