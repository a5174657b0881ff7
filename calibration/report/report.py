"""``report.html``: the verdict, pictures of what it rests on, and the numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path

from calibration.campaign.campaign import Campaign, Test
from calibration.fit.curves import TestCurves
from calibration.fit.fit import Fit, Prediction
from calibration.fit.result import CalibrationResult
from calibration.report.assumptions import assumptions
from calibration.report.curve_figures import draw_test, place_of, probability, size_of
from calibration.report.drawing import counted
from calibration.report.estimate_figures import draw_correlation, draw_profiles
from calibration.report.figures import draw_history, draw_predictions, draw_regions, percent
from calibration.report.page import (
    correlation_tables,
    html_figure,
    html_list,
    html_page,
    nuisance_table,
    parameter_table,
    plus_minus,
    recording_list,
    remark_list,
    stable_stretches,
    symbol_of,
    title_of,
)
from calibration.report.population import populations
from calibration.report.pressure import format_pressure
from calibration.report.report_tables import (
    history_table,
    identifiability_table,
    prediction_table,
    ranking_table,
    region_table,
    suggestion_in_words,
)
from calibration.report.segment_figures import segment_section
from tissue_sim.atomic_write import write_text


def write_report(result: CalibrationResult, curves: Mapping[str, Sequence[TestCurves]], path: Path, *,
                 figures: bool = True) -> None:
    """Write the page of one campaign; without `figures` it holds verdict and tables only.

    Args:
        result: fits best first. curves: law -> each test of the campaign as that law sees it, held-out ones too.
    """
    campaign, analytical = result.campaign, result.campaign.fit.method == "analytical"
    tests = {test.name: test for test in campaign.tests}
    recordings = {c.test.name: c.measured for c in next(iter(curves.values()))}
    parts = [f'<p class="quiet">{counted(sum(map(len, recordings.values())), "recording")} of '
             f"{counted(len(campaign.tests), 'test')}, {counted(len(result.fits), 'law')}; "
             f"{'least squares on nominal stress' if analytical else 'inverse finite elements, all tests at once'}</p>",
             _verdict(result, tests)]
    if figures:
        parts += _pictures(result, curves, recordings)
    parts += [f"<h2>Ranking by {'BIC' if analytical else 'prediction'}</h2>", ranking_table(result.fits),
              remark_list(result.fits), "<h2>Parameters</h2>", parameter_table(result.fits, figures)]
    if result.predictions:
        parts += ["<h2>Predictions</h2>", prediction_table(result.predictions, tests)]
    if any(fit.regions for fit in result.fits):
        parts += ["<h2>Residuals by region</h2>", region_table(result.fits, tests)]
    if not analytical:
        parts += ["<h2>What these tests can tell</h2>", identifiability_table(result.fits)]
    if analytical or not figures:
        parts += correlation_tables(result.fits)
    if result.best.nuisances:
        parts += [f"<h2>Contact offsets and zeros of {title_of(result.best.law)}</h2>", nuisance_table(result.best)]
    if any(fit.history for fit in result.fits):
        parts += ["<h2>Every solve</h2>", *(
            f"<details><summary>{title_of(fit.law)}: {_effort(fit)}</summary>{history_table(fit)}</details>"
            for fit in result.fits if fit.history)]
    parts += segment_section(recordings, figures=figures)
    parts += ["<h2>What was assumed</h2>", html_list(map(escape, assumptions(result))),
              "<h2>Recordings</h2>",
              recording_list(curve for several in recordings.values() for curve in several)]
    write_text(path, html_page(f"Calibration of {campaign.name}", parts))


def _verdict(result: CalibrationResult, tests: Mapping[str, Test]) -> str:
    """Which law, what it predicts, what it misses and what nobody can tell from these tests."""
    best = result.best
    rows = [("Law", [_law_in_words(best), escape(result.message)])]
    seen = [_prediction_in_words(p, tests[p.test]) for p in result.predictions if p.law == best.law]
    rows.append(("Predicts", seen or ["Nothing was left to predict: a second test, left out or held out, would show "
                                      "what this law is worth beyond the data it was fitted to."]))
    if best.regions:
        rows.append(("Misses", [*_misfits(best, tests)]
                     or ["In no region of any test is a misfit larger than chance makes."]))
    rows.append(("Cannot tell", [*_untold(result.fits)]))
    items = (f"<dt>{term}</dt><dd>" + "<br>".join(lines) + "</dd>" for term, lines in rows)
    return f'<dl class="verdict">{"".join(items)}</dl>'


def _law_in_words(fit: Fit) -> str:
    parts = []
    for name, value in fit.parameters.items():
        unit, error = fit.unit(name), fit.standard_errors[name]
        spread = " (on its bound)" if error is None and name in fit.on_bound else " (fixed)" if error == 0 else \
            plus_minus(error)
        parts.append(f"{symbol_of(fit, name)} = {value:.5g}{spread}{f' {unit}' if unit else ''}")
    usable = "" if fit.status == "converged" else f' <span class="bad">{escape(fit.unusable or fit.message)}</span>'
    return (f"<b>{title_of(fit.law)}</b>: {', '.join(parts)}; E<sub>0</sub> = {format_pressure(fit.E0, 4)}, stable "
            f"stretches {stable_stretches(fit)}.{usable}")


def _prediction_in_words(prediction: Prediction, test: Test) -> str:
    how = "held out of every fit" if test.hold_out else f"fitted to {', '.join(prediction.fitted)} only"
    name = f"<b>{escape(prediction.test)}</b>, {escape(how)}: "
    if prediction.percent is None:
        return name + f'<span class="bad">no prediction: {escape(prediction.note)}</span>'
    error = prediction.RMSE_N if prediction.RMSE_N is not None else prediction.RMSE_Pa
    size = "" if error is None else f"{size_of(error, test)}, "
    chance = "" if prediction.expected_N is None else f" (chance alone would make {prediction.expected_N:.2g} N)"
    largest = "stress" if test.specimen is None else "force"
    return f"{name}{size}{percent(prediction.percent)} of the largest {largest}{chance}"


def _misfits(fit: Fit, tests: Mapping[str, Test]) -> Iterator[str]:
    for r in sorted((r for r in fit.regions if not r.adequate), key=lambda r: r.p):
        test = tests[r.test]
        yield (f"<b>{escape(r.test)}</b>, {escape(place_of(r, test))}: {size_of(r.misfit_N, test)} that the law does "
               f"not explain ({escape(probability(r.p))})")


def _untold(fits: Sequence[Fit]) -> Iterator[str]:
    for i, fit in enumerate(fits):
        if fit.not_identifiable:
            names = ", ".join(symbol_of(fit, name) for name in fit.not_identifiable)
            remedy = f"; {escape(suggestion_in_words(fit.suggestions[0], fit))}" if fit.suggestions else ""
            yield f'<span class="bad">{names}</span> of {title_of(fit.law)} from these tests{remedy}.'
        elif i == 0:
            yield f"These tests determine every parameter of {title_of(fit.law)}."


def _pictures(result: CalibrationResult, curves: Mapping[str, Sequence[TestCurves]],
              recordings: Mapping[str, Sequence]) -> Iterator[str]:
    campaign, fits = result.campaign, result.fits
    # Where nobody knows what chance alone would make, the table says as much.
    if any(p.expected_N is not None or p.fitted for p in result.predictions):
        yield "<h2>Tests that the laws had not seen</h2>"
        yield html_figure(draw_predictions(result.predictions, campaign.tests), "Errors of the predictions",
                          "No test is predicted by a fit to itself. Up to the black mark, chance could make the error: "
                          "noise, offsets, zeros and the errors of the parameters. Beyond it, the error is the law's.")
    yield "<h2>Recordings and laws</h2>"
    for i, test in enumerate(campaign.tests):
        yield f"<h3>{escape(test.name)} <small>{escape(_what(test, len(recordings[test.name])))}</small></h3>"
        yield html_figure(draw_test(fits, {law: several[i] for law, several in curves.items()}),
                          f"Recordings, curves, prediction band and residuals of {test.name}")
    yield ('<p class="quiet">Band and residuals are those of the first law; the others are dashed and leave the frame '
           "where they are far off. Shaded: regions whose residuals are more than noise.</p>")
    if any(fit.regions for fit in fits):
        yield "<h2>What is left, by region</h2>"
        yield html_figure(draw_regions(fits, campaign.tests), "Misfit of each law in each region of each test",
                          "Root mean square of what the law lacks there, before offsets, zeros and mesh error make up "
                          "for part of it, and the probability of so much by chance, adjusted for the number of "
                          "regions (Holm); orange from p = 0.05 down.")
    for fit in fits if campaign.fit.method != "analytical" else ():
        inside = "".join(_estimates(fit, campaign))
        if inside:
            name = title_of(fit.law)
            yield f"<h2>How well {name} is determined</h2>{inside}" if fit is fits[0] else \
                f"<details><summary>How well {name} is determined</summary>{inside}</details>"
    yield from populations(fits)
    if any(fit.history for fit in fits):
        yield "<h2>Convergence</h2>"
        yield html_figure(draw_history(fits), "Error and parameters at every solve of every start",
                          "Error: sum of squares of the whitened residuals and priors. A line a start; one solve "
                          "simulates all tests. Where the accurate mesh comes in the error of a law that misses "
                          "something may rise: until then the larger error of the fast mesh is allowed for.")


def _estimates(fit: Fit, campaign: Campaign) -> Iterator[str]:
    if fit.profiles:
        yield html_figure(draw_profiles(fit, campaign.fit.bounds), f"Profile likelihoods of {fit.law}",
                          "How much worse the fit becomes when one parameter is held and all others follow. Where the "
                          "profile leaves the dashed parabola, ± 2 standard errors are not the interval.")
    correlation = draw_correlation(fit)
    if correlation is not None:
        yield html_figure(correlation, f"Correlation of the parameters of {fit.law}")


def _effort(fit: Fit) -> str:
    """``106 solves from 20 starts, 270 simulated tests, 1.8 s of processor time``."""
    starts = len({step.start for step in fit.history})
    return (f"{counted(len(fit.history), 'solve')} from {counted(starts, 'start')}, "
            f"{counted(fit.fem_solves, 'simulated test')}, {fit.cpu_s:.3g} s of processor time")


def _what(test: Test, count: int) -> str:
    """``needle indentation of phantom, flat tool of radius 8 mm, face bonded; 3 recordings``."""
    words = test.kind.name.replace("_", " ")
    if test.specimen is not None:
        words += f" of {test.specimen.name}"
    if test.experiment is not None:
        tool, friction = test.experiment.tool, test.experiment.friction
        if tool.radius is not None:
            words += f", {tool.shape} tool of radius {tool.radius * 1e3:g} mm"
        words += f", face {friction}" if isinstance(friction, str) else f", face with friction {friction:g}"
    return f"{words}; {counted(count, 'recording')}{'; held out: predicted, not fitted' if test.hold_out else ''}"
