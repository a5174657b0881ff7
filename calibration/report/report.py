"""Write ``report.html`` of a calibration: summary, figures and tables."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from html import escape

from calibration.campaign.campaign import Campaign, Test
from calibration.fit.curves import TestCurves
from calibration.fit.fit import Fit, Prediction
from calibration.fit.population import describe_excluded_specimens
from calibration.fit.result import CalibrationResult
from calibration.output_folder import make_numbered_test_figure_name
from calibration.report.assumptions import list_assumptions
from calibration.report.curve_figures import describe_region, draw_test_figure, format_p_value_text
from calibration.report.drawing import FigureEmbedder, format_count
from calibration.report.estimate_figures import (
    draw_growing_window_parameters_or_none,
    draw_parameter_correlation_or_none,
    draw_profiles,
    draw_unshared_parameters_or_none,
)
from calibration.report.figures import (
    draw_descent_history,
    draw_prediction_errors,
    draw_region_misfit_map,
    format_percentage_value,
)
from calibration.report.layout import LAYOUT
from calibration.report.page import (
    are_laws_ranked_by_prediction,
    format_law_title,
    format_parameter_estimate,
    format_parameter_symbol,
    format_stable_stretches,
    format_young_modulus,
    make_correlation_tables,
    make_html_list,
    make_html_page,
    make_parameter_tables,
    make_recording_list,
    make_recording_offset_table,
    make_remark_list,
    use_minus_signs,
)
from calibration.report.population import iterate_population_section_html
from calibration.report.report_tables import (
    describe_suggested_test_and_errors,
    make_identifiability_table,
    make_prediction_table,
    make_ranking_table,
    make_region_residual_test_table,
    make_table_of_all_solves,
)
from calibration.report.segment_figures import iterate_segment_section_html
from calibration.report.symbols import format_plain_symbol
from calibration.report.units import ReportUnits
from calibration.report.usability import make_usability_section
from tissue_sim.laws import find_law

#: Explanation above the figures of the tests.
_NOTE = ("Displacement, strain, force and stress are positive under load. Tangents are slopes of straight lines "
         "fitted in short windows, the same for recordings and laws. Laws are drawn without contact offset and force "
         "zero. Exception: tangents and holds of tests with holds use the offset and zero of the first recording. Band "
         "and residuals (model − data) belong to the first law; other laws may leave the frame. Shaded: regions whose "
         "residuals exceed the noise.")


def build_report_page(result: CalibrationResult, curves: Mapping[str, Sequence[TestCurves]], methods: str,
                      pictures: FigureEmbedder | None) -> str:
    """Return the HTML report of one campaign.

    Args:
        result: result of the calibration, fits best first.
        curves: recorded and fitted curves of each test by law, including held-out tests.
        methods: methods text for a paper.
        pictures: destination of the figures; None: summary and tables only.
    """
    campaign, analytical = result.campaign, result.campaign.fit.method == "analytical"
    tests, units = {test.name: test for test in campaign.tests}, ReportUnits.choose_for_best_fit(result)
    typical = ReportUnits.choose_first_specimen_test_or_first(campaign.tests)
    recordings = {c.test.name: c.measured for c in next(iter(curves.values()))}
    parts = [f'<p class="quiet">{format_count(sum(map(len, recordings.values())), "recording")} of '
             f"{format_count(len(campaign.tests), 'test')}, {format_count(len(result.fits), 'law')}; "
             f"{'least squares on nominal stress' if analytical else 'inverse finite elements, all tests at once'}</p>",
             _format_summary(result, tests, units)]
    if pictures is not None:
        parts += _iterate_all_figure_sections_html(result, curves, units, pictures)
    ranked_by = "prediction" if are_laws_ranked_by_prediction(result.fits) else "BIC"
    parts += [f"<h2>Ranking by {ranked_by}</h2>", make_ranking_table(result.fits, units),
              make_remark_list(result.fits), *make_usability_section(result.fits, result.failures, units),
              "<h2>Parameters</h2>", *make_parameter_tables(result.fits, units, pictures is not None)]
    if result.predictions:
        parts += ["<h2>Predictions</h2>", make_prediction_table(result.predictions, tests, units)]
    if any(fit.regions for fit in result.fits):
        parts += ["<h2>Residuals by region</h2>", make_region_residual_test_table(result.fits, tests, units)]
    if not analytical:
        parts += ["<h2>Identifiability of the parameters</h2>", make_identifiability_table(result.fits, units)]
    parts += make_correlation_tables([fit for fit in result.fits if pictures is None
                                      or not _is_best_or_has_profiles(fit, result)])
    if result.best.nuisances:
        parts += [f"<h2>Contact offsets and zeros of {format_law_title(result.best.law)}</h2>",
                  make_recording_offset_table(result.best, units.get_displacement_unit(typical),
                                              units.get_load_unit(typical))]
    if any(fit.history for fit in result.fits):
        parts += ["<h2>Every solve</h2>", *(
            f"<details><summary>{format_law_title(fit.law)}: {_format_effort(fit)}</summary>"
            f"{make_table_of_all_solves(fit, units)}</details>"
            for fit in result.fits if fit.history)]
    parts += iterate_segment_section_html(campaign, recordings, pictures)
    parts += ["<h2>Assumptions</h2>", make_html_list(map(escape, list_assumptions(result, units))),
              '<h2>Methods <small class="quiet">for a paper; also in methods.txt</small></h2>',
              f'<pre class="paste">{escape(methods)}</pre>', "<h2>Recordings</h2>",
              make_recording_list(curve for several in recordings.values() for curve in several)]
    return make_html_page(f"Calibration of {campaign.name}", parts)


def _format_summary(result: CalibrationResult, tests: Mapping[str, Test], units: ReportUnits) -> str:
    """Return the summary as an HTML list: best law, its predictions, its misfits and undetermined parameters."""
    best = result.best
    rows = [("Law", [_format_best_law(best, units), escape(_get_message_with_law_titles(result))])]
    predictions = [_format_prediction(p, tests[p.test], units) for p in result.predictions if p.law == best.law]
    rows.append(("Predictions", predictions or ["No prediction: all tests were fitted. Add a second test, left out or "
                                                "held out, to check the law on data that it was not fitted to."]))
    if best.regions:
        rows.append(("Misfits", [*_iterate_worst_misfit_sentences(best, tests, units)]
                     or ["All regions of all tests agree with the law within chance."]))
    rows.append(("Undetermined", [*_iterate_undetermined_sentences(result.fits, units)]))
    items = (f"<dt>{term}</dt><dd>" + "<br>".join(lines) + "</dd>" for term, lines in rows)
    return f'<dl class="verdict">{"".join(items)}</dl>'


def _format_best_law(fit: Fit, units: ReportUnits) -> str:
    """Return the law, its parameters, Young's modulus and stable stretches as HTML; with a warning if not usable."""
    parts = [f"{format_parameter_symbol(fit, name)} = {use_minus_signs(format_parameter_estimate(fit, name, units))}"
             for name in fit.parameters]
    usable = "" if fit.status == "converged" else f' <span class="bad">{escape(fit.unusable or fit.message)}</span>'
    return (f"<b>{format_law_title(fit.law)}</b>: {', '.join(parts)}; E<sub>0</sub> = "
            f"{use_minus_signs(format_young_modulus(fit, units))}, stable stretches "
            f"{format_stable_stretches(fit)}.{usable}")


def _get_message_with_law_titles(result: CalibrationResult) -> str:
    """Return the message of a calibration, in which the names of laws are replaced by their titles."""
    message = result.message
    for law in sorted(result.campaign.fit.laws, key=len, reverse=True):
        message = re.sub(rf"\b{re.escape(law)}\b", find_law(law).title, message)
    return message


def _format_prediction(prediction: Prediction, test: Test, units: ReportUnits) -> str:
    """Return the error of the prediction of a test as HTML, compared with the error by chance; or why there is none."""
    how = "held out of every fit" if test.hold_out else f"fitted to {', '.join(prediction.fitted)} only"
    how += f", its specimen from the mean of {len(prediction.mean_of)} others" if prediction.mean_of else ""
    name = f"<b>{escape(prediction.test)}</b>, {escape(how)}: "
    if prediction.percent is None:
        return name + f'<span class="bad">no prediction: {escape(prediction.note)}</span>'
    load, error = units.get_load_unit(test), prediction.RMSE_Pa if test.specimen is None else prediction.RMSE_N
    size = "" if error is None else f"{load.format_quantity(error, 2)}, "
    expected = prediction.expected_N
    chance = "" if expected is None else f" (expected by chance: {load.format_quantity(expected, 2)})"
    largest = "stress" if test.specimen is None else "force"
    return f"{name}{size}{format_percentage_value(prediction.percent)} of the largest {largest}{chance}"


def _iterate_worst_misfit_sentences(fit: Fit, tests: Mapping[str, Test], units: ReportUnits) -> Iterator[str]:
    """Yield HTML sentences on the most significant misfits of a fit, and the number of further ones."""
    bad = sorted((r for r in fit.regions if not r.adequate), key=lambda r: r.p)
    for r in bad[:LAYOUT.summary_misfits]:
        test = tests[r.test]
        size = units.get_load_unit(test).format_quantity(r.misfit_N, 2)
        yield (f"<b>{escape(r.test)}</b>, {escape(describe_region(r, test, units))}: {size} that the law does not "
               f"explain ({escape(format_p_value_text(r.p))})")
    if len(bad) > LAYOUT.summary_misfits:
        yield f"and {len(bad) - LAYOUT.summary_misfits} more regions, in the table below."


def _iterate_undetermined_sentences(fits: Sequence[Fit], units: ReportUnits) -> Iterator[str]:
    """Yield an HTML sentence for each law with parameters that the tests do not determine, and one for the best law."""
    for i, fit in enumerate(fits):
        if fit.not_identifiable:
            names = ", ".join(format_parameter_symbol(fit, name) for name in fit.not_identifiable)
            remedy = "".join(f"; {escape(describe_suggested_test_and_errors(each, fit, units, format_plain_symbol))}"
                             for each in fit.suggestions[:1])
            yield f'<span class="bad">{names}</span> of {format_law_title(fit.law)} from these tests{remedy}.'
        elif i == 0 and fit.left_out_specimens:
            left_out = escape(describe_excluded_specimens(fit.left_out_specimens))
            yield f'<span class="bad">The parameters of {left_out}</span> for {format_law_title(fit.law)}.'
        elif i == 0:
            yield f"These tests determine every parameter of {format_law_title(fit.law)}."


def _iterate_all_figure_sections_html(result: CalibrationResult, curves: Mapping[str, Sequence[TestCurves]],
                                      units: ReportUnits, pictures: FigureEmbedder) -> Iterator[str]:
    """Yield the HTML parts of all figure sections: predictions, tests, misfit, specimens, estimates, convergence."""
    campaign, fits = result.campaign, result.fits
    # Without an expected error by chance the figure shows no more than the table.
    if any(p.percent is not None and (p.expected_N is not None or p.fitted) for p in result.predictions):
        of_mean = "" if not any(p.mean_of for p in result.predictions) else \
            " A prediction from the mean of other specimens includes the scatter between specimens: one in three " \
            "errors exceeds the mark and one in twenty exceeds twice the mark, more if the scatter is estimated from " \
            "few specimens."
        yield "<h2>Predictions of tests that were not fitted</h2>"
        yield pictures.embed_figure("predictions",
                                    partial(draw_prediction_errors, result.predictions, campaign.tests, units),
                                    "Errors of the predictions",
                                    "Each test is predicted by a fit to other tests. The black mark is the error "
                                    "expected by chance: noise, offsets, zeros and parameter errors. A larger error is "
                                    f"due to the law.{of_mean}")
    yield "<h2>Recordings and laws</h2>"
    yield f'<p class="quiet">{_NOTE}</p>'
    for i, test in enumerate(campaign.tests):
        of_test = {law: several[i] for law, several in curves.items()}
        count = len(next(iter(of_test.values())).measured)
        yield f"<h3>{escape(test.name)} <small>{escape(_format_test_description(test, count))}</small></h3>"
        yield pictures.embed_figure(make_numbered_test_figure_name(campaign, i),
                                    partial(draw_test_figure, fits, of_test, units),
                                    f"Recordings, curves, prediction band and residuals of {test.name}")
    if any(fit.regions for fit in fits):
        yield "<h2>Misfit by region</h2>"
        yield pictures.embed_figure("regions", partial(draw_region_misfit_map, fits, campaign.tests, units),
                                    "Misfit of each law in each region of each test",
                                    "Root mean square of the misfit in each region and its probability by chance, "
                                    "adjusted for the number of regions (Holm); orange for p ≤ 0.05. Offsets, zeros "
                                    "and mesh error can compensate part of the misfit; the numbers do not include this "
                                    "compensation.")
    yield from iterate_population_section_html(fits, units, pictures)
    differing = "" if any(fit.population for fit in fits) else pictures.embed_figure(
        "specimens", partial(draw_unshared_parameters_or_none, fits, units), "Parameters of each specimen",
        "Thick: ± one standard error; thin: 95 % interval.")
    if differing:
        yield f"<h2>Differences between specimens</h2>{differing}"
    for fit in (fit for fit in fits if _is_best_or_has_profiles(fit, result)):
        inside = "".join(_iterate_estimate_figures_html(fit, campaign, units, pictures))
        if inside:
            name = format_law_title(fit.law)
            yield f"<h2>How well {name} is determined</h2>{inside}" if fit is fits[0] else \
                f"<details><summary>How well {name} is determined</summary>{inside}</details>"
    if any(fit.history for fit in fits):
        yield "<h2>Convergence</h2>"
        yield pictures.embed_figure("convergence", partial(draw_descent_history, fits),
                                    "Error and parameters at every solve of every start",
                                    "Error: sum of squares of the whitened residuals and priors. One line per start; "
                                    "one solve simulates all tests. At the change to the accurate mesh the error may "
                                    "rise, because the covariance of the fast mesh includes a larger mesh error.")


def _is_best_or_has_profiles(fit: Fit, result: CalibrationResult) -> bool:
    """Return whether a fit is the best one or has profile likelihoods, so that the report draws its parameters."""
    return fit is result.best or bool(fit.profiles)


def _iterate_estimate_figures_html(fit: Fit, campaign: Campaign, units: ReportUnits,
                                   pictures: FigureEmbedder) -> Iterator[str]:
    """Yield the HTML of the figures of the estimates of one law: profiles, strain windows and correlation."""
    if fit.profiles:
        note = ("Increase of the sum of squares when one parameter is fixed and all others are fitted again. If the "
                "profile differs from the dashed parabola, ± 2 standard errors are not a 95 % interval.")
        yield pictures.embed_figure(f"profiles {fit.law}", partial(draw_profiles, fit, campaign.fit.bounds, units),
                                    f"Profile likelihoods of {fit.law}", note)
    yield pictures.embed_figure(f"windows {fit.law}", partial(draw_growing_window_parameters_or_none, fit, units),
                                f"Parameters of {fit.law} from parts of the strain",
                                "Estimates from the first part of the strain of each test only, as with max_strain.")
    yield pictures.embed_figure(f"correlation {fit.law}", partial(draw_parameter_correlation_or_none, fit, units),
                                f"Correlation of the parameters of {fit.law}")


def _format_effort(fit: Fit) -> str:
    """Return the effort as text: ``106 solves from 20 starts, 270 simulated tests, 1.8 s of processor time``."""
    starts = len({step.start for step in fit.history})
    return (f"{format_count(len(fit.history), 'solve')} from {format_count(starts, 'start')}, "
            f"{format_count(fit.fem_solves, 'simulated test')}, {fit.cpu_s:.3g} s of processor time")


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
