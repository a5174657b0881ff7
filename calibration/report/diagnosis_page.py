"""``report.html`` of a diagnosis: what is missing, where it shows, what it costs, and what to measure next."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from html import escape

from calibration.campaign.measured import MeasuredCurve
from calibration.diagnosis.diagnosis import VERDICTS, CandidateStatement, Diagnosis, Verdict
from calibration.diagnosis.evidence import Evidence
from calibration.diagnosis.proposals import LEVEL
from calibration.diagnosis.words import joined
from calibration.effects.effect import Effect
from calibration.fit.fit import Fit
from calibration.output_folder import picture_of_test
from calibration.report.diagnosis_figures import curves_of, draw_candidates, draw_evidence, draw_gap
from calibration.report.diagnosis_tables import (
    absorbed,
    capital,
    fitted_table,
    held_out_table,
    label_of,
    labels_of,
    parameter_table,
    region_table,
    silent_table,
    stage_table,
    testable_table,
)
from calibration.report.drawing import Pictures, counted
from calibration.report.page import estimate_of, html_list, html_page, recording_list, symbol_of, title_of, with_minus
from calibration.report.units import Units

#: A verdict in a word or two.
HEADINGS: dict[Verdict, str] = {"NAMED": "Named", "SET": "A set", "LOOKS_LIKE": "Looks like it", "UNKNOWN": "Unknown",
                                "NONE": "Nothing missing"}
#: Regions that the summary names; the picture has all.
_MOST_REGIONS = 4
#: Effects in the picture; the table has all.
_MOST_DRAWN = 14
#: A parameter that moved by less than this share had absorbed nothing worth a sentence.
_MOVED = 0.005
_NOTE = ("Models have the offset and the zero of each recording. Shaded: regions whose residuals are more than noise "
         "before anything is added, with the root mean square of what the model lacks there, before → after, as it is "
         "before offsets, zeros and parameters make up for part of it. Thin lines: each recording; thick: their mean.")


def diagnosis_page(diagnosis: Diagnosis, before: Evidence, after: Evidence | None, effects: Mapping[str, Effect],
                   measured: Mapping[str, Sequence[MeasuredCurve]], pictures: Pictures | None) -> str:
    """The page of one diagnosis as HTML.

    Args:
        diagnosis: the answer. before, after: evidence without and with what was added. effects: name -> effect, of the
            catalogue. measured: test -> all of its recordings. pictures: where they go; None: no pictures.
    """
    units = Units.of_fit(diagnosis.fit_before)
    recordings = [curve for several in measured.values() for curve in several]
    parts = [f'<p class="quiet">{counted(len(recordings), "recording")} of {counted(len(measured), "test")}, '
             f"{title_of(diagnosis.law)}, {counted(len(effects), 'effect')} in the catalogue</p>",
             _summary(diagnosis, effects, units)]
    if pictures is not None:
        parts += _where(diagnosis, before, after, units, pictures)
    parts += ["<h2>Parameters</h2>", parameter_table(diagnosis.fit_before, diagnosis.fit_after, units)]
    if diagnosis.held_out:
        parts += ["<h2>Data that the fits have not seen</h2>", held_out_table(diagnosis.held_out, units)]
    parts += _catalogue(diagnosis, units, pictures)
    if diagnosis.next_experiment:
        parts += ["<h2>What to measure next</h2>", _next(diagnosis)]
    parts += ["<h2>What was assumed</h2>", html_list(_assumed(diagnosis, before, units)),
              "<h2>Time</h2>", stage_table(diagnosis)]
    if diagnosis.files:
        parts += ["<h2>Files</h2>", html_list(f"{escape(what)}: <code>{escape(name)}</code>"
                                              for what, name in diagnosis.files.items())]
    parts += ["<h2>Recordings</h2>", recording_list(recordings)]
    return html_page(f"Diagnosis of {diagnosis.campaign}", parts)


def _summary(diagnosis: Diagnosis, effects: Mapping[str, Effect], units: Units) -> str:
    """What a reader takes along."""
    verdict = diagnosis.verdict
    # A message may say all that its verdict means.
    said = VERDICTS[verdict] in diagnosis.message.lower()
    meaning = [] if said else [f'<span class="quiet">{verdict}: {escape(VERDICTS[verdict])}.</span>']
    rows = [(HEADINGS[verdict], [f"<b>{escape(diagnosis.message)}</b>", *meaning]),
            ("Where", [escape(sentence) for sentence in places(diagnosis)]),
            ("What it does", [f"{escape(capital(effects[each.name].title))}: {escape(effects[each.name].signature)}"
                              + (f"; here most in {escape(joined(each.acts_in))}." if each.acts_in else ".")
                              for each in diagnosis.effects if each.name in effects]),
            ("Told apart by", list(_separations(diagnosis, effects))),
            ("Had absorbed", list(_moved(diagnosis.fit_before, diagnosis.fit_after, units))),
            ("Unseen data", list(_unseen(diagnosis, units))),
            ("Next", [f"{escape(capital(each.sentence))}." for each in diagnosis.next_experiment[:1]])]
    items = (f"<dt>{term}</dt><dd>" + "<br>".join(lines) + "</dd>" for term, lines in rows if lines)
    return f'<dl class="verdict">{"".join(items)}</dl>'


def places(diagnosis: Diagnosis) -> Iterator[str]:
    """The worst regions, and which agree, a sentence each."""
    # Holds first: what a force does there by itself needs no model to be understood.
    bad = sorted((each for each in diagnosis.regions if not each.adequate_before),
                 key=lambda one: (not one.segment.startswith("hold"), -one.before_sigma))
    for each in bad[:_MOST_REGIONS]:
        yield f"{each.sentence}."
    if len(bad) > _MOST_REGIONS:
        yield f"And {counted(len(bad) - _MOST_REGIONS, 'more region')}."
    good = [f"{each.test} {each.segment}" for each in diagnosis.regions if each.adequate_before]
    if good and len(good) == len(diagnosis.regions):
        yield "Every region agrees."
    elif good:
        yield f"{joined(good)} {'agrees' if len(good) == 1 else 'agree'}."


def _separations(diagnosis: Diagnosis, effects: Mapping[str, Effect]) -> Iterator[str]:
    if diagnosis.verdict != "SET":
        return
    labels = labels_of(diagnosis.candidates)
    ratios = {each.name: each.evidence_ratio for each in diagnosis.candidates}
    for name in diagnosis.indistinguishable:
        effect = effects.get(name.partition("@")[0])
        if effect is None:
            continue
        ratio = ratios.get(name)
        against = "" if ratio is None or ratio < 1.05 else f" (1 : {ratio:.2g} against the likeliest)"
        yield f"{escape(capital(labels.get(name, effect.title)))}{against}: {escape(effect.separated_by)}."


def _moved(before: Fit, after: Fit | None, units: Units) -> Iterator[str]:
    """Parameters that had taken up part of the effect."""
    for name in before.parameters:
        moved = absorbed(before, after, name)
        if after is not None and moved is not None and abs(moved) > _MOVED:
            side = "too large" if moved > 0 else "too small"
            yield (f"{symbol_of(before, name)} was {abs(100 * moved):.2g}\u00a0% {side}: "
                   f"{with_minus(estimate_of(before, name, units))} without, "
                   f"{with_minus(estimate_of(after, name, units))} with it.")


def _unseen(diagnosis: Diagnosis, units: Units) -> Iterator[str]:
    for kind, noun, how in (("replicate", "recording", "left out"), ("test", "test", "held out")):
        mine = [each for each in diagnosis.held_out if each.kind == kind and each.before_N is not None]
        if not mine:
            continue
        later = [each.after_N for each in mine if each.after_N is not None]
        before, after = (" to ".join(units.force.text(size, 2) for size in _ends(sizes))
                         for sizes in ([each.before_N for each in mine], later))
        judged = [each.adequate_before if each.after_N is None else each.adequate_after for each in mine]
        held = sum(each is True for each in judged)
        added = f", with what was added {after}" if after else ""
        yield (f"Error in {counted(len(mine), noun)} {how}: {before}{added}; in {held} of {len(mine)} nothing but "
               "noise, jitter and the parameters' uncertainty is left.")


def _ends(sizes: Sequence[float | None]) -> list[float]:
    known = [size for size in sizes if size is not None]
    return sorted({min(known), max(known)}) if known else []


def _where(diagnosis: Diagnosis, before: Evidence, after: Evidence | None, units: Units,
           pictures: Pictures) -> Iterator[str]:
    yield "<h2>Where model and measurement part</h2>"
    yield f'<p class="quiet">{_NOTE}</p>'
    label = joined([each.title for each in diagnosis.effects])
    for number, test in enumerate(before.campaign.tests):
        gaps = [each for each in diagnosis.regions if each.test == test.name]
        if not gaps:
            continue
        count = counted(len(before.measured[test.name]), "recording")
        yield f"<h3>{escape(test.name)} <small>{escape(test.kind.name.replace('_', ' '))}; {count}</small></h3>"
        regions = [region for region in before.regions if region.test == test.name]
        later = None if after is None else curves_of(after, test.name)
        yield pictures.show(picture_of_test(before.campaign, number), partial(
            draw_gap, curves_of(before, test.name), later, regions, gaps, label, units),
            f"Recordings, model before and after, and residuals of {test.name}")
    yield "<h2>Evidence by region</h2>"
    yield pictures.show("regions", partial(draw_evidence, diagnosis.regions, units),
                        "Improbability of the residuals in each region, before and after",
                        "How improbable the smooth part of the residuals is, adjusted for the number of regions "
                        "(Holm); on the right its root mean square.")
    yield f"<details><summary>In numbers</summary>{region_table(diagnosis.regions, units)}</details>"


def _catalogue(diagnosis: Diagnosis, units: Units, pictures: Pictures | None) -> Iterator[str]:
    seen = [each for each in diagnosis.candidates if each.testable]
    yield "<h2>The catalogue, held against these tests</h2>"
    drawn = [each for each in seen if each.refitted or (each.p is not None and each.p <= LEVEL)][:_MOST_DRAWN]
    if drawn and pictures is not None:
        yield pictures.show("candidates", partial(draw_candidates, drawn, [label_of(each) for each in drawn],
                                                  _chosen(diagnosis, drawn)), "Score and gain of each effect")
    yield fitted_table(diagnosis.candidates, units)
    if seen:
        yield "<h3>What these tests can show</h3>"
        yield testable_table(diagnosis.candidates, units)
        yield ('<p class="quiet">Smallest size seen: nine of ten such data sets would show it. Score: deviations along '
               "what the effect changes and the fitted parameters cannot take up. p: that chance makes any effect of "
               "the catalogue score so. Explains: share of what the regions show beyond chance. Twins: change these "
               "tests in the same way but for a few per cent.</p>")
    if len(seen) < len(diagnosis.candidates):
        yield "<h3>What they cannot show</h3>"
    yield silent_table(diagnosis.candidates)


def _chosen(diagnosis: Diagnosis, seen: Sequence[CandidateStatement]) -> list[str]:
    """Names of the candidates that were added: of an effect of one test, that one."""
    added = {(each.name, tuple(each.tests)) for each in diagnosis.effects}
    return [each.name for each in seen for test in (each.name.partition("@")[2],)
            if (each.effect, (test,) if test else ()) in added]


def _next(diagnosis: Diagnosis) -> str:
    labels = labels_of(diagnosis.candidates)
    lines = []
    for each in diagnosis.next_experiment:
        by = "" if each.deviations is None else f" by {each.deviations:.2g} standard deviations"
        names = joined([labels.get(name, name) for name in each.separates], "and")
        told = f' <span class="quiet">Separates {escape(names)}{by}.</span>' if names else ""
        lines.append(f"{escape(capital(each.sentence))}.{told}")
    return f"<ol>{''.join(f'<li>{line}</li>' for line in lines)}</ol>"


def _assumed(diagnosis: Diagnosis, before: Evidence, units: Units) -> Iterator[str]:
    """What the numbers rest on, a sentence each."""
    sources = sorted({curve.noise.source for curve in before.problem.measured})
    colour = "white" if not diagnosis.noise_correlation_s else \
        f"correlated over {diagnosis.noise_correlation_s:.2g} s"
    yield f"Noise: {units.force.text(diagnosis.noise_N, 2)} (standard deviation, {joined(sources)}), {colour}."
    freedom = before.problem.jitter.freedom
    source = "stated in the campaign, or the usual prior" if freedom is None else \
        f"estimated with {counted(freedom, 'degree')} of freedom" if freedom else \
        "assumed, as no test has two recordings"
    contact = units.length.text(1e-3 * diagnosis.contact_jitter_mm, 2)
    yield (f"Between recordings the contact point scatters by {contact} and the zero by "
           f"{units.force.text(diagnosis.zero_jitter_N, 2)} (standard deviations), {source}; both are marginalised.")
    yield (f"Of the mesh an error of {diagnosis.mesh_percent:.2g} % of the force is carried as covariance, after the "
           "difference of the accurate mesh is corrected.")
    yield "Holds and returns count, with an elastic law too; every sample after the contact does."
    yield ("An effect counts from a gain of 10 of the Schwarz criterion on, with as many samples as the correlated "
           "noise leaves; one that is 20 times less likely than the best is given up.")
