"""Report which laws are usable: the criteria that each law meets or fails, alternative optima, laws without a fit."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape

from calibration.fit.fit import Fit
from calibration.report.page import format_law_title, make_html_table, use_minus_signs
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


def make_usability_section(fits: Sequence[Fit], failures: Mapping[str, str], units: ReportUnits) -> list[str]:
    """Return the HTML parts of the section on usable laws: criteria with reasons of failure, and alternative optima.

    The list is empty if no fit was judged.
    """
    if not any(fit.clauses for fit in fits):
        return []
    rows: list[list[str | None]] = []
    for fit in fits:
        failed = [clause for clause in fit.clauses if not clause.holds]
        held = ", ".join(CRITERIA.get(clause.name, clause.name) for clause in fit.clauses if clause.holds)
        reasons = "<br>".join(
            f'<span class="bad">{escape(CRITERIA.get(clause.name, clause.name))}</span>: {escape(clause.reason)}'
            + (f"; {escape(clause.remedy)}" if clause.remedy else "") for clause in failed)
        rows.append([format_law_title(fit.law), "usable" if not failed else escape(fit.status), reasons or "-",
                     escape(held)])
    rows += [[format_law_title(law), "no fit", escape(reason), "-"] for law, reason in failures.items()]
    parts = ["<h2>Which laws are usable</h2>",
             make_html_table(["Law", "Status", "Fails", "Holds"], rows, text=(1, 2, 3))]
    return [*parts, *(_make_alternatives_table(fit, units) for fit in fits if fit.alternatives)]


def _make_alternatives_table(fit: Fit, units: ReportUnits) -> str:
    """Return the HTML table of the alternative optima of a law and the tests that distinguish them."""
    def format_values_with_units_as_cells(parameters: Mapping[str, float]) -> list[str]:
        """Return the values of parameters with their display units as texts, one for each cell of a row."""
        scales = [units.choose_display_unit_of_si_unit(fit.units[name]) for name in parameters]
        return [use_minus_signs(f"{value / unit.size:.5g} {unit.name}".strip())
                for value, unit in zip(parameters.values(), scales, strict=True)]

    pressure = units.pressure
    rows: list[list[str | None]] = [[*format_values_with_units_as_cells(fit.parameters), f"{fit.R2:.5f}", "reported",
                                     "-"]]
    for each in fit.alternatives:
        stress = (f"{each.alternative_stress_Pa / pressure.size:.4g} {pressure.name} instead of "
                  f"{each.stress_Pa / pressure.size:.4g} {pressure.name}{each.stress_ratio_suffix_or_empty}")
        rows.append([*format_values_with_units_as_cells(each.parameters), f"{each.R2:.5f}", escape(each.separated_by),
                     use_minus_signs(stress)])
    labels = [*(escape(fit.symbols[name]) for name in fit.parameters), "R²", "Distinguished by",
              "Nominal stress there"]
    return (f"<h3>{format_law_title(fit.law)}: parameters that fit equally well</h3>"
            + make_html_table(labels, rows, text=(len(labels) - 2, len(labels) - 1)))
