"""Sections with the fits of a calibration: ranking, parameters, their determination, convergence, usability."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial

from calibration.fit.fit import Fit
from calibration.fit.population import describe_excluded_specimens
from calibration.report.content import (
    EMPTY,
    LINE_BREAK,
    Block,
    Column,
    Details,
    Figure,
    Heading,
    Listing,
    Paragraph,
    Picture,
    Span,
    Table,
    Text,
    join_texts,
)
from calibration.report.drawing import (
    format_count,
    get_formula_width_in_css_pixels,
    make_png_data_uri,
    render_law_formula_png_or_none,
)
from calibration.report.figures import (
    draw_descent_history,
    draw_growing_window_parameters_or_none,
    draw_parameter_correlation_or_none,
    draw_population_figure,
    draw_prediction_errors,
    draw_profiles,
    draw_unshared_parameters_or_none,
)
from calibration.report.fit_text import (
    are_laws_ranked_by_prediction,
    format_law_title,
    iterate_fit_groups_with_remarks,
    list_parameters_with_standard_errors,
    make_parameter_symbol,
)
from calibration.report.quantities import (
    ReportUnits,
    format_plain_symbol,
    format_significant_digits_or_dash,
    use_minus_signs,
)
from calibration.report.section import CalibrationReport, Section
from calibration.report.tables import (
    describe_poorly_determined_combination,
    describe_suggested_test_and_errors,
    make_parameter_table,
    make_population_table,
    make_prediction_table,
    make_ranking_table,
)


class FittedParameters(Section):
    """Formula, estimates and intervals of each law."""

    name = "fitted_parameters"
    title = "Parameters"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield a heading with the formula and a table for each law."""
        for fit in report.fits:
            yield Heading((f"{format_law_title(fit.law)} ", _make_formula(fit, report.has_figures)))
            yield make_parameter_table(fit, report.units)


def _make_formula(fit: Fit, is_typeset: bool) -> Picture | Span:
    """Return the formula of a law as an image, or as text if `is_typeset` is false or there is no image."""
    png = render_law_formula_png_or_none(fit.law) if is_typeset else None
    if png is None:
        return Span(fit.formula, "small")
    return Picture(make_png_data_uri(png), get_formula_width_in_css_pixels(png), fit.formula)


class ParameterDetermination(Section):
    """Accuracy of the parameters by law: figures of the best law and of laws with profiles, otherwise tables."""

    name = "parameter_determination"

    def make_title(self, report: CalibrationReport) -> str:
        """Return the title with the best law."""
        return f"How well {format_law_title(report.result.best.law)} is determined"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield the content of the best law, then that of other laws as details."""
        for fit in report.fits:
            is_best = fit is report.result.best
            is_drawn = report.has_figures and (is_best or bool(fit.profiles))
            blocks = _iterate_estimate_figures(fit, report) if is_drawn else _iterate_correlation_tables(fit)
            if is_best:
                yield from blocks
            else:
                yield Details(f"How well {format_law_title(fit.law)} is determined", [*blocks])


def _iterate_estimate_figures(fit: Fit, report: CalibrationReport) -> Iterator[Figure]:
    """Yield the figures of the estimates of one law: profiles, strain windows and correlation."""
    if fit.profiles:
        yield Figure(f"profiles {fit.law}", partial(draw_profiles, fit, report.campaign.fit.bounds, report.units),
                     f"Profile likelihoods of {fit.law}",
                     "Increase of the sum of squares when one parameter is fixed and all others are fitted again. If "
                     "the profile differs from the dashed parabola, ± 2 standard errors are not a 95 % interval.")
    yield Figure(f"windows {fit.law}", partial(draw_growing_window_parameters_or_none, fit, report.units),
                 f"Parameters of {fit.law} from parts of the strain",
                 "Estimates from the first part of the strain of each test only, as with max_strain.")
    yield Figure(f"correlation {fit.law}", partial(draw_parameter_correlation_or_none, fit, report.units),
                 f"Correlation of the parameters of {fit.law}")


def _iterate_correlation_tables(fit: Fit) -> Iterator[Table]:
    """Yield the table of the correlations of the parameters of one law; nothing for fewer than two free parameters."""
    free = list_parameters_with_standard_errors(fit)
    if len(free) < 2:
        return
    indices = [fit.covariance.order.index(name) for name in free]
    symbols = [make_parameter_symbol(fit, name) for name in free]
    rows: list[list[Text]] = [[symbol, *(f"{fit.correlation[i][j]:.3f}" for j in indices)]
                              for symbol, i in zip(symbols, indices, strict=True)]
    yield Table([Column("Correlation"), *map(Column, symbols)], rows, narrow=True)


class Identifiability(Section):
    """Condition number, poorly determined combinations, parameters that are not identifiable, and remedies."""

    name = "identifiability"
    title = "Identifiability of the parameters"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield the table with one row per law; nothing for fits of closed forms."""
        if report.campaign.fit.method == "analytical":
            return
        yield Table([Column("Law"), Column("Condition number"), Column("Poorly determined", text=True),
                     Column("Not identifiable", text=True), Column("Remedy", text=True)], [
            [format_law_title(fit.law), format_significant_digits_or_dash(fit.condition, 3),
             "; ".join(describe_poorly_determined_combination(each, fit, format_plain_symbol)
                       for each in fit.directions) or "none",
             join_texts(make_parameter_symbol(fit, name, "bad_symbol") for name in fit.not_identifiable) or "none",
             "; ".join(describe_suggested_test_and_errors(each, fit, report.units, format_plain_symbol)
                       for each in fit.suggestions) or EMPTY] for fit in report.fits])


class Convergence(Section):
    """Error and parameters at every solve of every start."""

    name = "convergence"
    title = "Convergence"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield the figure and, as details, a table for each law; nothing without a history of solves."""
        if any(fit.history for fit in report.fits):
            yield Figure("convergence", partial(draw_descent_history, report.fits),
                         "Error and parameters at every solve of every start",
                         "Error: sum of squares of the whitened residuals and priors. One line per start; one solve "
                         "simulates all tests. At the change to the accurate mesh the error may rise, because the "
                         "covariance of the fast mesh includes a larger mesh error.")
        for fit in report.fits:
            if fit.history:
                yield Details(f"{format_law_title(fit.law)}: {_format_effort(fit)}",
                              [_make_table_of_all_solves(fit, report.units)])


def _format_effort(fit: Fit) -> str:
    """Return the effort as text: ``106 solves from 20 starts, 270 simulated tests, 1.8 s of processor time``."""
    starts = len({step.start for step in fit.history})
    return (f"{format_count(len(fit.history), 'solve')} from {format_count(starts, 'start')}, "
            f"{format_count(fit.fem_solves, 'simulated test')}, {fit.cpu_s:.3g} s of processor time")


def _make_table_of_all_solves(fit: Fit, units: ReportUnits) -> Table:
    """Return the table of all solves of all starts of a fit: parameters, error and RMSE, one row per solve."""
    names = list(fit.history[0].parameters)
    scales = [units.choose_display_unit_of_si_unit(fit.units[name]) for name in names]
    labels = [(make_parameter_symbol(fit, name), unit.format_axis_label(""))
              for name, unit in zip(names, scales, strict=True)]
    return Table([*map(Column, ("Start", "Run", *labels, "Error", units.force.format_axis_label("RMSE"),
                                "Accurate mesh"))],
                 [[f"{step.start}", f"{step.run}", *(f"{step.parameters[name] / unit.size:.5g}"
                                                     for name, unit in zip(names, scales, strict=True)),
                   f"{step.error:.5g}", f"{step.RMSE_N / units.force.size:.3g}", "yes" if step.corrected else EMPTY]
                  for step in fit.history])


#: Criterion -> the condition in words.
CRITERIA = {
    "physical": "positive shear modulus",
    "converged": "a minimum was found",
    "stable": "stable over the data",
    "recordings": "recordings valid for this law",
    "modulus_noise": "plausible noise of moduli",
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


class Specimens(Section):
    """Mean and scatter of the parameters of several specimens; without a population the parameters of each."""

    name = "specimens"
    needs_figures = True

    def make_title(self, report: CalibrationReport) -> str:
        """Return the title."""
        is_population = any(fit.population for fit in report.fits)
        return "Specimens as a population" if is_population else "Differences between specimens"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield the table, the excluded specimens and the figures; without a population one figure."""
        having = [(fit, fit.population) for fit in report.fits if fit.population is not None]
        if not having:
            yield Figure("specimens", partial(draw_unshared_parameters_or_none, report.fits, report.units),
                         "Parameters of each specimen", "Thick: ± one standard error; thin: 95 % interval.")
            return
        yield make_population_table(report.fits, report.units)
        for fit, _ in having:
            if fit.left_out_specimens:
                yield Paragraph(f"Not in the population of {format_law_title(fit.law)}: "
                                f"{describe_excluded_specimens(fit.left_out_specimens)}.")
        for fit, found in having:
            yield Figure(f"population {fit.law}", partial(draw_population_figure, fit, found, report.units),
                         f"Parameters of the specimens of {fit.law}",
                         f"{format_law_title(fit.law)}: separate fit of each specimen with its 95 % interval, and the "
                         "estimate that also uses the other specimens (shrinkage towards the mean).")


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
