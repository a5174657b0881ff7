"""Write ``report.html`` of a diagnosis: missing effects, misfit by region, parameter changes, next experiments."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from html import escape

from calibration.campaign.measured import MeasuredCurve
from calibration.diagnosis.decision_limits import DecisionLimits
from calibration.diagnosis.diagnosis import VERDICTS, CandidateResult, Diagnosis, Verdict
from calibration.diagnosis.evidence import FitEvidence
from calibration.diagnosis.words import join_as_enumeration
from calibration.effects.effect import Effect
from calibration.fit.fit import Fit
from calibration.output_folder import make_numbered_test_figure_name
from calibration.report.diagnosis_figures import (
    build_fitted_curves_of_test,
    draw_candidate_scores,
    draw_region_significance_in_deviations,
    draw_test_misfit,
)
from calibration.report.diagnosis_tables import (
    capitalise_first_letter,
    compute_relative_bias_or_none,
    format_effect_title_with_test,
    make_detectable_effects_table,
    make_fitted_effects_table,
    make_misfit_table_before_and_after,
    make_parameter_table_before_and_after,
    make_prediction_error_table,
    make_stage_duration_table,
    make_undetectable_effects_table,
    map_candidate_names_to_labels,
)
from calibration.report.drawing import FigureEmbedder, format_count
from calibration.report.layout import LAYOUT
from calibration.report.page import (
    format_law_title,
    format_parameter_estimate,
    format_parameter_symbol,
    make_html_list,
    make_html_page,
    make_recording_list,
    use_minus_signs,
)
from calibration.report.units import ReportUnits

#: Short heading of each verdict.
HEADINGS: dict[Verdict, str] = {"NAMED": "One effect", "SET": "Several possible effects",
                                "LOOKS_LIKE": "Probable effect", "UNKNOWN": "Unknown effect",
                                "NONE": "No effect missing"}
#: Relative change below which a parameter is not mentioned as biased.
_MIN_CHANGE = 0.005
_NOTE = ("The models include the offset and the zero of each recording. Shaded: regions whose residuals exceed the "
         "noise before an effect is added. The numbers are root mean squares of the misfit there, before → after. "
         "Offsets, zeros and parameters can compensate part of the misfit; the numbers do not include this "
         "compensation. Thin lines: each recording; thick lines: mean of the recordings.")


def build_diagnosis_page(diagnosis: Diagnosis, before: FitEvidence, after: FitEvidence | None,
                         effects: Mapping[str, Effect],
                         measured: Mapping[str, Sequence[MeasuredCurve]], pictures: FigureEmbedder | None) -> str:
    """Return the HTML report of one diagnosis.

    Args:
        diagnosis: the result of the diagnosis.
        before: the fit without the added effects.
        after: the fit with the added effects; None if no effect was added.
        effects: catalogue of effects by name.
        measured: all recordings of each test.
        pictures: destination of the figures; None: no figures.
    """
    units = ReportUnits.choose_for_fit(diagnosis.fit_before)
    recordings = [curve for several in measured.values() for curve in several]
    parts = [f'<p class="quiet">{format_count(len(recordings), "recording")} of {format_count(len(measured), "test")}, '
             f"{format_law_title(diagnosis.law)}, {format_count(len(effects), 'effect')} in the catalogue</p>",
             _format_summary(diagnosis, effects, units)]
    if pictures is not None:
        parts += _iterate_misfit_section_html(diagnosis, before, after, units, pictures)
    parts += ["<h2>Parameters</h2>",
              make_parameter_table_before_and_after(diagnosis.fit_before, diagnosis.fit_after, units)]
    if diagnosis.held_out:
        parts += ["<h2>Data that were not fitted</h2>", make_prediction_error_table(diagnosis.held_out, units)]
    parts += _iterate_effect_catalogue_html(diagnosis, units, pictures)
    if diagnosis.next_experiment:
        parts += ["<h2>What to measure next</h2>", _format_next_experiments(diagnosis)]
    parts += ["<h2>Assumptions</h2>", make_html_list(_iterate_assumption_sentences(diagnosis, before, units)),
              "<h2>Time</h2>", make_stage_duration_table(diagnosis)]
    if diagnosis.files:
        parts += ["<h2>Files</h2>", make_html_list(f"{escape(what)}: <code>{escape(name)}</code>"
                                                   for what, name in diagnosis.files.items())]
    parts += ["<h2>Recordings</h2>", make_recording_list(recordings)]
    return make_html_page(f"Diagnosis of {diagnosis.campaign}", parts)


def _format_summary(diagnosis: Diagnosis, effects: Mapping[str, Effect], units: ReportUnits) -> str:
    """Return the summary of a diagnosis as an HTML definition list."""
    verdict = diagnosis.verdict
    # The message may already contain the meaning of the verdict.
    is_stated = VERDICTS[verdict] in diagnosis.message.lower()
    meaning = [] if is_stated else [f'<span class="quiet">{verdict}: {escape(VERDICTS[verdict])}.</span>']
    rows = [(HEADINGS[verdict], [f"<b>{escape(diagnosis.message)}</b>", *meaning]),
            ("Where", [escape(sentence) for sentence in iterate_misfit_sentences(diagnosis)]),
            ("Influence",
             [f"{escape(capitalise_first_letter(effects[each.name].title))}: {escape(effects[each.name].signature)}"
              + (f"; largest here in {escape(join_as_enumeration(each.acts_in))}." if each.acts_in
                 else ".")
              for each in diagnosis.effects if each.name in effects]),
            ("Distinguished by", list(_iterate_how_to_separate_sentences(diagnosis, effects))),
            ("Biased parameters",
             list(_iterate_parameter_bias_sentences(diagnosis.fit_before, diagnosis.fit_after, units))),
            ("Data not fitted", list(_iterate_held_out_prediction_sentences(diagnosis, units))),
            ("Next", [f"{escape(capitalise_first_letter(each.sentence))}." for each in diagnosis.next_experiment[:1]])]
    items = (f"<dt>{term}</dt><dd>" + "<br>".join(lines) + "</dd>" for term, lines in rows if lines)
    return f'<dl class="verdict">{"".join(items)}</dl>'


def iterate_misfit_sentences(diagnosis: Diagnosis) -> Iterator[str]:
    """Yield a sentence for each of the worst regions, and one for the regions that agree with the model."""
    # Holds first: a reader understands a change of force at constant displacement without a model.
    bad = sorted((each for each in diagnosis.regions if not each.adequate_before),
                 key=lambda one: (not one.segment.startswith("hold"), -one.before_sigma))
    for each in bad[:LAYOUT.summary_regions]:
        yield f"{each.sentence}."
    if len(bad) > LAYOUT.summary_regions:
        yield f"And {format_count(len(bad) - LAYOUT.summary_regions, 'more region')}."
    good = [f"{each.test} {each.segment}" for each in diagnosis.regions if each.adequate_before]
    if good and len(good) == len(diagnosis.regions):
        yield "Every region agrees."
    elif good:
        yield f"{join_as_enumeration(good)} {'agrees' if len(good) == 1 else 'agree'}."


def _iterate_how_to_separate_sentences(diagnosis: Diagnosis, effects: Mapping[str, Effect]) -> Iterator[str]:
    """Yield for each effect that these data cannot distinguish a sentence on what would distinguish it."""
    if diagnosis.verdict != "SET":
        return
    labels = map_candidate_names_to_labels(diagnosis.candidates)
    ratios = {each.name: each.evidence_ratio for each in diagnosis.candidates}
    for name in diagnosis.indistinguishable:
        effect = effects.get(name.partition("@")[0])
        if effect is None:
            continue
        ratio = ratios.get(name)
        against = "" if ratio is None or ratio < 1.05 else f" (1 : {ratio:.2g} against the most likely effect)"
        label = escape(capitalise_first_letter(labels.get(name, effect.title)))
        yield f"{label}{against}: {escape(effect.separated_by)}."


def _iterate_parameter_bias_sentences(before: Fit, after: Fit | None, units: ReportUnits) -> Iterator[str]:
    """Yield a sentence for each parameter that was biased because the effect was missing in the model."""
    for name in before.parameters:
        change = compute_relative_bias_or_none(before, after, name)
        if after is not None and change is not None and abs(change) > _MIN_CHANGE:
            side = "too large" if change > 0 else "too small"
            yield (f"{format_parameter_symbol(before, name)} was {abs(100 * change):.2g}\u00a0% {side}: "
                   f"{use_minus_signs(format_parameter_estimate(before, name, units))} without the effect, "
                   f"{use_minus_signs(format_parameter_estimate(after, name, units))} with the effect.")


def _iterate_held_out_prediction_sentences(diagnosis: Diagnosis, units: ReportUnits) -> Iterator[str]:
    """Yield a sentence on the prediction errors in recordings left out of the fit, and one on tests held out."""
    for kind, noun, how in (("replicate", "recording", "left out"), ("test", "test", "held out")):
        predicted = [each for each in diagnosis.held_out if each.kind == kind and each.before_N is not None]
        if not predicted:
            continue
        later = [each.after_N for each in predicted if each.after_N is not None]
        before, after = (" to ".join(units.force.format_quantity(size, 2)
                                     for size in _get_distinct_minimum_and_maximum(sizes))
                         for sizes in ([each.before_N for each in predicted], later))
        judged = [each.adequate_before if each.after_N is None else each.adequate_after for each in predicted]
        held = sum(each is True for each in judged)
        added = f", with the added effects {after}" if after else ""
        yield (f"Error in {format_count(len(predicted), noun)} {how}: {before}{added}. In {held} of {len(predicted)} "
               "the error is within noise, jitter and parameter uncertainty.")


def _get_distinct_minimum_and_maximum(sizes: Sequence[float | None]) -> list[float]:
    """Return the smallest and the largest value that is not None, once if they are equal; empty without values."""
    known = [size for size in sizes if size is not None]
    return sorted({min(known), max(known)}) if known else []


def _iterate_misfit_section_html(diagnosis: Diagnosis, before: FitEvidence, after: FitEvidence | None,
                                 units: ReportUnits, pictures: FigureEmbedder) -> Iterator[str]:
    """Yield the HTML parts of the section on misfit: one figure for each test, then the evidence by region."""
    yield "<h2>Where model and measurement differ</h2>"
    yield f'<p class="quiet">{_NOTE}</p>'
    label = join_as_enumeration([each.title for each in diagnosis.effects])
    for number, test in enumerate(before.campaign.tests):
        gaps = [each for each in diagnosis.regions if each.test == test.name]
        if not gaps:
            continue
        count = format_count(len(before.measured[test.name]), "recording")
        yield f"<h3>{escape(test.name)} <small>{escape(test.kind.name.replace('_', ' '))}; {count}</small></h3>"
        regions = [region for region in before.region_misfit_tests if region.test == test.name]
        later = None if after is None else build_fitted_curves_of_test(after, test.name)
        yield pictures.embed_figure(make_numbered_test_figure_name(before.campaign, number), partial(
            draw_test_misfit, build_fitted_curves_of_test(before, test.name), later, regions, gaps, label, units),
            f"Recordings, model before and after, and residuals of {test.name}")
    yield "<h2>Evidence by region</h2>"
    yield pictures.embed_figure("regions", partial(draw_region_significance_in_deviations, diagnosis.regions, units),
                                "Significance of the residuals in each region, before and after",
                                "Significance of the smooth part of the residuals, adjusted for the number of regions "
                                "(Holm). Right: root mean square of the smooth part.")
    table = make_misfit_table_before_and_after(diagnosis.regions, units)
    yield f"<details><summary>In numbers</summary>{table}</details>"


def _iterate_effect_catalogue_html(diagnosis: Diagnosis, units: ReportUnits,
                                   pictures: FigureEmbedder | None) -> Iterator[str]:
    """Yield the HTML parts of the section on the effects of the catalogue: one figure and three tables."""
    seen = [each for each in diagnosis.candidates if each.testable]
    yield "<h2>Effects of the catalogue in these tests</h2>"
    limits = DecisionLimits(**diagnosis.decision_limits)
    drawn = [each for each in seen
             if each.refitted or (each.p is not None and each.p <= limits.effect_level)][:LAYOUT.drawn_effects]
    if drawn and pictures is not None:
        draw = partial(draw_candidate_scores, drawn, [format_effect_title_with_test(each) for each in drawn],
                       _get_names_of_added_candidates(diagnosis, drawn))
        yield pictures.embed_figure("candidates", draw, "Score and gain of each effect")
    yield make_fitted_effects_table(diagnosis.candidates, units)
    if seen:
        yield "<h3>Effects that these tests can detect</h3>"
        yield make_detectable_effects_table(diagnosis.candidates, units)
        yield ('<p class="quiet">Smallest detectable size: nine of ten data sets like this would show an effect of '
               "this size. Score: standard deviations along the force change that the effect makes and that the fitted "
               "parameters cannot compensate. p: probability that chance gives any effect of the catalogue such a "
               "score. Explains: fraction of the misfit beyond chance that the effect removes. Similar effects: change "
               "these tests in the same way except for a few per cent.</p>")
    if len(seen) < len(diagnosis.candidates):
        yield "<h3>Effects that these tests cannot detect</h3>"
    yield make_undetectable_effects_table(diagnosis.candidates)


def _get_names_of_added_candidates(diagnosis: Diagnosis, seen: Sequence[CandidateResult]) -> list[str]:
    """Return those names of the candidates `seen` whose effect was added to the model.

    An effect that acts in one test matches only the candidate of this test.
    """
    added = {(each.name, tuple(each.tests)) for each in diagnosis.effects}
    return [each.name for each in seen for test in (each.name.partition("@")[2],)
            if (each.effect, (test,) if test else ()) in added]


def _format_next_experiments(diagnosis: Diagnosis) -> str:
    """Return the proposed experiments as a numbered HTML list, with the effects that each would distinguish."""
    labels = map_candidate_names_to_labels(diagnosis.candidates)
    lines = []
    for each in diagnosis.next_experiment:
        by = "" if each.deviations is None else f" by {each.deviations:.2g} standard deviations"
        names = join_as_enumeration([labels.get(name, name) for name in each.separates], "and")
        separation = f' <span class="quiet">Distinguishes {escape(names)}{by}.</span>' if names else ""
        lines.append(f"{escape(capitalise_first_letter(each.sentence))}.{separation}")
    return f"<ol>{''.join(f'<li>{line}</li>' for line in lines)}</ol>"


def _iterate_assumption_sentences(diagnosis: Diagnosis, before: FitEvidence, units: ReportUnits) -> Iterator[str]:
    """Yield the assumptions of a diagnosis, one sentence each."""
    sources = sorted({curve.noise.source for curve in before.problem.measured})
    colour = "white" if not diagnosis.noise_correlation_s else \
        f"correlated over {diagnosis.noise_correlation_s:.2g} s"
    yield (f"Noise: {units.force.format_quantity(diagnosis.noise_N, 2)} (standard deviation, "
           f"{join_as_enumeration(sources)}), {colour}.")
    freedom = before.problem.jitter.freedom
    source = "stated in the campaign, or the default prior" if freedom is None else \
        f"estimated with {format_count(freedom, 'degree')} of freedom" if freedom else \
        "assumed, because no test has two recordings"
    contact = units.length.format_quantity(1e-3 * diagnosis.contact_jitter_mm, 2)
    yield (f"Between recordings the contact point scatters by {contact} and the force zero by "
           f"{units.force.format_quantity(diagnosis.zero_jitter_N, 2)} (standard deviations), {source}; both are "
           "marginalised.")
    yield (f"The difference of the accurate mesh is corrected. The remaining mesh error, {diagnosis.mesh_percent:.2g} "
           "% of the force, is included in the covariance.")
    yield "All samples after contact are fitted, including holds and unloading, also with an elastic law."
    yield ("An effect is accepted if it improves the BIC by at least 10, with the effective number of samples of the "
           "correlated noise. An effect that is 20 times less likely than the best effect is rejected.")
