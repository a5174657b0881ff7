"""Section with a figure of each test: recordings, laws, tangents and residuals."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from calibration.campaign.campaign import Test
from calibration.output_folder import make_numbered_test_figure_name
from calibration.report.content import Block, Figure, Heading, Paragraph, Span
from calibration.report.curve_figures import draw_test_figure
from calibration.report.drawing import format_count
from calibration.report.section import CalibrationReport, Section

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
