"""Section with the ranking of the laws and remarks on the fits."""

from __future__ import annotations

from collections.abc import Iterator

from calibration.report.content import Block, Listing, Span
from calibration.report.fit_tables import make_ranking_table
from calibration.report.fit_text import (
    are_laws_ranked_by_prediction,
    format_law_title,
    iterate_fit_groups_with_remarks,
)
from calibration.report.section import CalibrationReport, Section


class Ranking(Section):
    """Laws in the order of their rank, with their stability and messages; common remarks appear once."""

    name = "ranking"

    def make_title(self, report: CalibrationReport) -> str:
        """Return the title with the criterion."""
        return f"Ranking by {'prediction' if are_laws_ranked_by_prediction(report.fits) else 'BIC'}"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield the table and the list of remarks."""
        fits, remarks = report.fits, []
        yield make_ranking_table(fits, report.units)
        for having, words in iterate_fit_groups_with_remarks(fits, lambda fit: [*fit.message.split("; "),
                                                                                f"Drucker: {fit.stability}"]):
            laws = "All laws" if 1 < len(having) == len(fits) else ", ".join(format_law_title(fit.law)
                                                                             for fit in having)
            is_good = any(fit.status == "converged" for fit in having)
            remarks.append(Span(f"{laws}: {words}", "" if is_good else "bad"))
        yield Listing(remarks)
