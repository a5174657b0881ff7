"""Section with a figure of each test: misfit before and after the found effects are added."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from calibration.diagnosis.diagnosis import join_as_enumeration
from calibration.output_folder import make_numbered_test_figure_name
from calibration.report.content import Block, Figure, Heading, Paragraph, Span
from calibration.report.diagnosis_figures import build_fitted_curves_of_test, draw_test_misfit
from calibration.report.drawing import format_count
from calibration.report.section import DiagnosisReport, Section

#: Explanation above the figures of the tests.
_NOTE = ("The models include the offset and the zero of each recording. Shaded: regions whose residuals exceed the "
         "noise before an effect is added. The numbers are root mean squares of the misfit there, before → after. "
         "Offsets, zeros and parameters can compensate part of the misfit; the numbers do not include this "
         "compensation. Thin lines: each recording; thick lines: mean of the recordings.")


class MisfitByTest(Section):
    """Recordings, model and residuals of each fitted test, before and after the found effects are added."""

    name = "misfit_by_test"
    title = "Where model and measurement differ"
    reports = ("diagnosis",)
    needs_figures = True

    def iterate_blocks(self, report: DiagnosisReport) -> Iterator[Block]:
        """Yield a note, then a heading and a figure for each test."""
        diagnosis, before, after = report.diagnosis, report.before, report.after
        yield Paragraph(_NOTE, quiet=True)
        label = join_as_enumeration([each.title for each in diagnosis.effects])
        for number, test in enumerate(before.campaign.tests):
            gaps = [each for each in diagnosis.regions if each.test == test.name]
            if not gaps:
                continue
            count = format_count(len(before.measured[test.name]), "recording")
            yield Heading((f"{test.name} ", Span(f"{test.kind.name.replace('_', ' ')}; {count}", "small")))
            regions = [region for region in before.region_misfit_tests if region.test == test.name]
            later = None if after is None else build_fitted_curves_of_test(after, test.name)
            yield Figure(make_numbered_test_figure_name(before.campaign, number), partial(
                draw_test_misfit, build_fitted_curves_of_test(before, test.name), later, regions, gaps, label,
                report.units), f"Recordings, model before and after, and residuals of {test.name}")
