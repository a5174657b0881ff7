"""Section with the errors of the predictions."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from calibration.report.content import Block, Figure
from calibration.report.figures import draw_prediction_errors
from calibration.report.fit_tables import make_prediction_table
from calibration.report.section import CalibrationReport, Section


class Predictions(Section):
    """Errors of each law in tests that it was not fitted to, compared with the errors expected by chance."""

    name = "predictions"
    title = "Predictions of tests that were not fitted"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield the figure, unless it would show no more than the table, and the table; nothing without predictions."""
        predictions = report.result.predictions
        of_mean = "" if not any(p.mean_of for p in predictions) else \
            " A prediction from the mean of other specimens includes the scatter between specimens: one in three " \
            "errors exceeds the mark and one in twenty exceeds twice the mark, more if the scatter is estimated from " \
            "few specimens."
        if any(p.percent is not None and (p.expected_N is not None or p.fitted) for p in predictions):
            yield Figure(
                "predictions", partial(draw_prediction_errors, predictions, report.campaign.tests, report.units),
                "Errors of the predictions",
                "Each test is predicted by a fit to other tests. The black mark is the error expected by chance: "
                f"noise, offsets, zeros and parameter errors. A larger error is due to the law.{of_mean}")
        if predictions:
            yield make_prediction_table(predictions, report.tests, report.units)
