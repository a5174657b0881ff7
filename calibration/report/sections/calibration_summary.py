"""Section with the summary of a calibration: best law, predictions, misfits, undetermined parameters."""

from __future__ import annotations

import re
from collections.abc import Iterator

from calibration.campaign.campaign import Test
from calibration.fit.fit import Prediction
from calibration.fit.population import describe_excluded_specimens
from calibration.report.content import Block, Paragraph, Part, Span, Summary, Text, join_texts
from calibration.report.curve_figures import describe_region, format_p_value_text
from calibration.report.drawing import LAYOUT, format_count
from calibration.report.figures import format_percentage_value
from calibration.report.fit_tables import describe_suggested_test_and_errors
from calibration.report.fit_text import (
    format_law_title,
    format_parameter_estimate,
    format_stable_stretches,
    format_young_modulus,
    make_parameter_symbol,
)
from calibration.report.rounding import use_minus_signs
from calibration.report.section import CalibrationReport, Section
from calibration.report.symbols import format_plain_symbol
from calibration.report.units import ReportUnits
from tissue_sim.laws import find_law


class CalibrationSummary(Section):
    """Numbers of recordings, tests and laws; then best law, its predictions, misfits and undetermined parameters."""

    name = "calibration_summary"

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield the line with the numbers and the summary."""
        recordings = sum(map(len, report.recordings.values()))
        method = "least squares on nominal stress" if report.campaign.fit.method == "analytical" else \
            "inverse finite elements, all tests at once"
        yield Paragraph(f"{format_count(recordings, 'recording')} of "
                        f"{format_count(len(report.campaign.tests), 'test')}, "
                        f"{format_count(len(report.fits), 'law')}; {method}", quiet=True)
        best = report.result.best
        predictions: list[Text] = [_make_prediction_line(each, report.tests[each.test], report.units)
                                   for each in report.result.predictions if each.law == best.law]
        rows: list[tuple[str, list[Text]]] = [
            ("Law", [_make_best_law_line(report), _get_message_with_law_titles(report)]),
            ("Predictions", predictions or ["No prediction: all tests were fitted. Add a second test, left out or held "
                                            "out, to check the law on data that it was not fitted to."])]
        if best.regions:
            rows.append(("Misfits", [*_iterate_worst_misfit_lines(report)]
                         or ["All regions of all tests agree with the law within chance."]))
        yield Summary([*rows, ("Undetermined", [*_iterate_undetermined_lines(report)])])


def _make_best_law_line(report: CalibrationReport) -> Text:
    """Return the best law, its parameters, Young's modulus and stable stretches; with a warning if not usable."""
    fit, units = report.result.best, report.units
    estimates = join_texts((make_parameter_symbol(fit, name),
                            f" = {use_minus_signs(format_parameter_estimate(fit, name, units))}")
                           for name in fit.parameters)
    warning: list[Part] = [] if fit.status == "converged" else [" ", Span(fit.unusable or fit.message, "bad")]
    return [Span(format_law_title(fit.law), "strong"), ": ", *estimates, "; ", Span("E0", "symbol"),
            f" = {use_minus_signs(format_young_modulus(fit, units))}, stable stretches {format_stable_stretches(fit)}.",
            *warning]


def _get_message_with_law_titles(report: CalibrationReport) -> str:
    """Return the message of a calibration, in which the names of laws are replaced by their titles."""
    message = report.result.message
    for law in sorted(report.campaign.fit.laws, key=len, reverse=True):
        message = re.sub(rf"\b{re.escape(law)}\b", find_law(law).title, message)
    return message


def _make_prediction_line(prediction: Prediction, test: Test, units: ReportUnits) -> Text:
    """Return the error of the prediction of a test, compared with the error by chance; or why there is none."""
    how = "held out of every fit" if test.hold_out else f"fitted to {', '.join(prediction.fitted)} only"
    how += f", its specimen from the mean of {len(prediction.mean_of)} others" if prediction.mean_of else ""
    name = Span(prediction.test, "strong")
    if prediction.percent is None:
        return name, f", {how}: ", Span(f"no prediction: {prediction.note}", "bad")
    load, error = units.get_load_unit(test), prediction.RMSE_Pa if test.specimen is None else prediction.RMSE_N
    size = "" if error is None else f"{load.format_quantity(error, 2)}, "
    expected = prediction.expected_N
    chance = "" if expected is None else f" (expected by chance: {load.format_quantity(expected, 2)})"
    largest = "stress" if test.specimen is None else "force"
    return name, f", {how}: {size}{format_percentage_value(prediction.percent)} of the largest {largest}{chance}"


def _iterate_worst_misfit_lines(report: CalibrationReport) -> Iterator[Text]:
    """Yield the most significant misfits of the best fit, and the number of further ones."""
    bad = sorted((r for r in report.result.best.regions if not r.adequate), key=lambda r: r.p)
    for r in bad[:LAYOUT.summary_misfits]:
        test = report.tests[r.test]
        size = report.units.get_load_unit(test).format_quantity(r.misfit_N, 2)
        yield Span(r.test, "strong"), (f", {describe_region(r, test, report.units)}: {size} that the law does not "
                                       f"explain ({format_p_value_text(r.p)})")
    if len(bad) > LAYOUT.summary_misfits:
        yield f"and {len(bad) - LAYOUT.summary_misfits} more regions, in the table below."


def _iterate_undetermined_lines(report: CalibrationReport) -> Iterator[Text]:
    """Yield a line for each law with parameters that the tests do not determine, and one for the best law."""
    for i, fit in enumerate(report.fits):
        law = format_law_title(fit.law)
        if fit.not_identifiable:
            names = join_texts(make_parameter_symbol(fit, name, "bad_symbol") for name in fit.not_identifiable)
            remedy = "".join(f"; {describe_suggested_test_and_errors(each, fit, report.units, format_plain_symbol)}"
                             for each in fit.suggestions[:1])
            yield [*names, f" of {law} from these tests{remedy}."]
        elif i == 0 and fit.left_out_specimens:
            left_out = describe_excluded_specimens(fit.left_out_specimens)
            yield Span(f"The parameters of {left_out}", "bad"), f" for {law}."
        elif i == 0:
            yield f"These tests determine every parameter of {law}."
