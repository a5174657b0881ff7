"""Section with the usable laws: criteria that each law meets or fails, alternative optima, laws without a fit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from calibration.fit.fit import Fit
from calibration.report.content import EMPTY, LINE_BREAK, Block, Column, Heading, Span, Table, Text, join_texts
from calibration.report.fit_text import format_law_title
from calibration.report.rounding import use_minus_signs
from calibration.report.section import CalibrationReport, Section
from calibration.report.units import ReportUnits

#: Criterion -> the condition in words.
CRITERIA = {
    "physical": "positive shear modulus",
    "converged": "a minimum was found",
    "stable": "stable over the data",
    "recordings": "recordings valid for this law",
    "contact": "contact known well enough for the shear modulus",
    "replicates": "recordings agree",
    "residuals": "residuals within the limit",
    "explained": "variance of the force explained",
    "displacement": "displacement explained where the force is controlled",
    "bounds": "shear modulus independent of bounds that are not stated",
    "determined": "shear modulus determined",
    "unique": "no other optimum fits as well",
    "population": "enough specimens determined",
}


class Usability(Section):
    """Which laws are usable: criteria with reasons of failure, and alternative optima."""

    name = "usability"
    title = "Which laws are usable"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield the table of the criteria and the tables of the alternatives; nothing if no fit was judged."""
        if not any(fit.clauses for fit in report.fits):
            return
        rows: list[list[Text | None]] = []
        for fit in report.fits:
            failed = [clause for clause in fit.clauses if not clause.holds]
            reasons = join_texts(((Span(CRITERIA.get(clause.name, clause.name), "bad"),
                                   f": {clause.reason}{f'; {clause.remedy}' if clause.remedy else ''}")
                                  for clause in failed), LINE_BREAK)
            held = ", ".join(CRITERIA.get(clause.name, clause.name) for clause in fit.clauses if clause.holds)
            rows.append([format_law_title(fit.law), fit.status if failed else "usable", reasons or EMPTY, held])
        rows += [[format_law_title(law), "no fit", reason, EMPTY] for law, reason in report.result.failures.items()]
        yield Table([Column("Law"), *(Column(heading, text=True) for heading in ("Status", "Fails", "Holds"))], rows)
        for fit in report.fits:
            if fit.alternatives:
                yield Heading(f"{format_law_title(fit.law)}: parameters that fit equally well")
                yield _make_alternatives_table(fit, report.units)


def _make_alternatives_table(fit: Fit, units: ReportUnits) -> Table:
    """Return the table of the alternative optima of a law and the tests that distinguish them."""
    def format_values_with_units_as_cells(parameters: Mapping[str, float]) -> list[str]:
        """Return the values of parameters with their display units as texts, one for each cell of a row."""
        scales = [units.choose_display_unit_of_si_unit(fit.units[name]) for name in parameters]
        return [use_minus_signs(f"{value / unit.size:.5g} {unit.name}".strip())
                for value, unit in zip(parameters.values(), scales, strict=True)]

    pressure = units.pressure
    rows = [[*format_values_with_units_as_cells(fit.parameters), f"{fit.R2:.5f}", "reported", EMPTY]]
    for each in fit.alternatives:
        stress = (f"{each.alternative_stress_Pa / pressure.size:.4g} {pressure.name} instead of "
                  f"{each.stress_Pa / pressure.size:.4g} {pressure.name}{each.stress_ratio_suffix_or_empty}")
        rows.append([*format_values_with_units_as_cells(each.parameters), f"{each.R2:.5f}", each.separated_by,
                     use_minus_signs(stress)])
    return Table([*(Column(fit.symbols[name]) for name in fit.parameters), Column("R²"),
                  Column("Distinguished by", text=True), Column("Nominal stress there", text=True)], rows)
