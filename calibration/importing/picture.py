"""Draw the result of an import: motion against time and load against motion of each test, and the assumptions."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np

from calibration.importing.campaign_text import format_shortened_table_lines
from calibration.importing.imported import ImportedTest, ImportResult
from calibration.report.drawing import COLOURS, STYLE, create_figure, make_thinning_slice
from calibration.report.png import render_png
from tissue_sim.experiment.kinds.kind import MODULI
from tissue_sim.recording.formats.modulus_tables import has_moduli
from tissue_sim.recording.moduli import add_storage_and_loss_modulus
from tissue_sim.recording.recording import LOADS, Recording
from tissue_sim.recording.screening import Screening


@dataclass(frozen=True)
class ImportPictureLayoutSettings:
    """Layout of the picture of an import.

    Attributes:
        most_tests: largest number of tests in the picture.
        most_names: largest number of recordings in the legend of a test.
        row_height: height of the axes of a test, inches.
        line_height: height of a line of the table below the axes, inches.
        font_size: font size of the table, points.
        text_columns: largest number of characters in a line of the table.
        most_lines: largest number of lines of the table.
    """

    most_tests: int = 12
    most_names: int = 8
    row_height: float = 3.0
    line_height: float = 0.13
    font_size: float = 6.5
    text_columns: int = 165
    most_lines: int = 40


#: Settings that the functions of this module use.
_SETTINGS = ImportPictureLayoutSettings()
_SHOWN = {"displacement": ("displacement, mm", 1e3), "stretch": ("stretch", 1.0), "shear strain": ("shear strain", 1.0),
          "force": ("force, N", 1.0), "nominal stress": ("nominal stress, kPa", 1e-3),
          "angle": ("angle, deg", 180.0 / np.pi), "torque": ("torque, mN m", 1e3)}
_SHADES = {"hold": "0.85", "unload": "#fde3d0", "reload": "#dcebf7", "approach": "#e8f4fb", "preload": "#f5e4ee",
           "preconditioning": "#fbefd5", "failure": "#f3c9ad"}


def render_import_as_png_bytes(imported: ImportResult) -> bytes:
    """Draw the recordings of all tests and the assumptions; return the bytes of a PNG file.

    A channel without a known unit is drawn in the numbers of its file.
    """
    import matplotlib

    tests = imported.tests[:_SETTINGS.most_tests]
    with matplotlib.rc_context(STYLE):
        lines = format_shortened_table_lines(tests, _SETTINGS.text_columns, _SETTINGS.most_lines)
        heights = [_SETTINGS.row_height] * len(tests) + [max(len(lines), 1) * _SETTINGS.line_height]
        figure = create_figure(10.0, sum(heights))
        axes = figure.subplots(len(heights), 2, gridspec_kw={"height_ratios": heights})
        for row, test in zip(axes[:-1], tests, strict=True):
            _draw_test_motion_and_load_in_two_axes(row[0], row[1], test)
        _draw_assumption_table(axes[-1], lines)
        if len(imported.tests) > len(tests):
            figure.supxlabel(f"the first {len(tests)} of {len(imported.tests)} tests", fontsize=9)
        return render_png(figure, 110)


def _draw_assumption_table(axes, lines: Sequence[str]) -> None:
    """Draw the lines of the table of assumptions as text into the last row of axes, which have no frame."""
    for each in axes:
        each.set_axis_off()
    axes[0].text(0.0, 1.0, "\n".join(line.replace("$", r"\$") for line in lines), transform=axes[0].transAxes, va="top",
                 ha="left", family="monospace", fontsize=_SETTINGS.font_size, linespacing=1.15, in_layout=False,
                 clip_on=False)


def _draw_test_motion_and_load_in_two_axes(left, right, test: ImportedTest) -> None:
    """Draw the recordings of a test: motion over time in the left axes, load over motion in the right axes."""
    number = 0
    if has_moduli(test.parts[0].reading):
        _draw_moduli_over_frequency(left, right, test)
        return
    for part in test.parts:
        raw = part.reading.channels_without_unit
        for recording, motion in zip(part.reading.recordings, part.motions, strict=True):
            load = next(name for name in LOADS if name in recording)
            style = {"color": COLOURS[number % len(COLOURS)], "lw": 1.0}
            name = part.file.name if len(part.motions) == 1 else f"{part.file.name} {number + 1}"
            kept = np.arange(len(recording)) if motion.kept is None else motion.kept
            every = kept[make_thinning_slice(kept.size)]
            ways, loads = (_convert_to_plotted_unit(recording, channel, raw) for channel in (motion.channel, load))
            clocks = recording.time if motion.rate is not None else np.arange(len(recording))
            left.plot(clocks[every], ways[every], **style)
            right.plot(ways[every], loads[every], **style, label=name if number < _SETTINGS.most_names else None)
            if kept.size < len(recording):
                _mark_outliers_and_saturated_samples(left, right, clocks, ways, loads, kept, motion.screening)
            if motion.failure is not None:
                at = motion.get_sample_index_in_file(motion.failure.index)
                point = [_convert_to_plotted_unit(recording, channel, raw)[at] for channel in (motion.channel, load)]
                right.plot(*point, "x", color="k", ms=7, label="failure" if number == 0 else None)
            if number == 0:
                _set_axis_labels(left, right, motion.channel, load, raw, timed=motion.rate is not None)
                _shade_segments(left, recording, motion)
            number += 1
    kind = test.kind.replace("_", " ") if test.kind else "kind not known"
    left.set_title(f"{test.name}: {kind}", loc="left", fontsize=10)
    more = f"and {number - _SETTINGS.most_names} more" if number > _SETTINGS.most_names else None
    if number > 1 or any(motion.failure or motion.kept is not None for part in test.parts for motion in part.motions):
        right.legend(fontsize=7, title=more, title_fontsize=7)


def _draw_moduli_over_frequency(left, right, test: ImportedTest) -> None:
    """Draw the storage modulus in the left axes and the loss modulus in the right axes, with logarithmic axes."""
    recordings = [recording for part in test.parts for recording in part.reading.recordings]
    for number, recording in enumerate(map(add_storage_and_loss_modulus, recordings)):
        for axes, channel in zip((left, right), MODULI, strict=True):
            axes.plot(recording.channel("frequency"), 1e-3 * recording.channel(channel), "o", ms=3,
                      color=COLOURS[number % len(COLOURS)])
            axes.set(xscale="log", yscale="log", xlabel="frequency, Hz", ylabel=f"{channel}, kPa")
    kind = test.kind.replace("_", " ") if test.kind else "kind not known"
    left.set_title(f"{test.name}: {kind}", loc="left", fontsize=10)


def _convert_to_plotted_unit(recording: Recording, channel: str, raw: Collection[str]) -> np.ndarray:
    """Return the values of a channel in the unit of the picture; channels in `raw` (unknown unit) are unchanged."""
    return recording.channel(channel) * (1.0 if channel in raw else _SHOWN[channel][1])


def _mark_outliers_and_saturated_samples(left, right, clocks: np.ndarray, ways: np.ndarray, loads: np.ndarray,
                                         kept: np.ndarray, screening: Screening) -> None:
    """Mark the samples that are left out: outliers as red crosses, saturated samples as grey dots.

    An outlier outside the range of the kept samples is drawn at the edge of this range.
    """
    saturated = [sample - 1 for each in screening.saturation for sample in each.samples]
    outliers = np.setdiff1d(np.setdiff1d(np.arange(ways.size), kept), saturated)
    for samples, style, name in ((outliers, {"marker": "x", "color": "r", "ms": 6}, "left out: outlier"),
                                 (np.array(saturated, int), {"marker": ".", "color": "0.5", "ms": 3},
                                  "left out: saturated")):
        if samples.size:
            way, load = ways[samples], loads[samples]
            if samples is outliers:
                way, load = (np.clip(values[samples], values[kept].min(), values[kept].max())
                             for values in (ways, loads))
            left.plot(clocks[samples], way, ls="", **style)
            right.plot(way, load, ls="", **style, label=name)


def _set_axis_labels(left, right, way: str, load: str, raw: Collection[str], *, timed: bool) -> None:
    """Label the axes with quantity and unit; channels in `raw` have no known unit."""
    def make_axis_label(channel: str) -> str:
        """Return the label of an axis: name and unit of a channel."""
        return f"{channel}, unit not known" if channel in raw else _SHOWN[channel][0]

    left.set_xlabel("time, s" if timed else "sample")
    left.set_ylabel(make_axis_label(way))
    right.set_xlabel(make_axis_label(way))
    right.set_ylabel(make_axis_label(load))


def _shade_segments(axes, recording: Recording, motion) -> None:
    """Shade the time spans of all segments other than the first loading, one colour for each kind of segment."""
    for segment in motion.segments:
        if segment.name in _SHADES:
            ends = ((recording.time[segment.first], recording.time[segment.last]) if motion.rate is not None
                    else (segment.first, segment.last))
            axes.axvspan(*ends, color=_SHADES[segment.name], lw=0, zorder=0)
