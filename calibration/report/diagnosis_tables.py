"""Tables of a diagnosis, as HTML, and its numbers as people write them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

from calibration.diagnosis.diagnosis import CandidateStatement, Diagnosis, HeldOut, Number, RegionGap
from calibration.effects.effect import CATEGORIES
from calibration.fit.fit import Fit
from calibration.report.page import estimate_of, html_table, interval_of, symbol_of, with_minus
from calibration.report.rounding import gain_text, ratio_text, value_and_error
from calibration.report.symbols import html_symbol, plain_symbol
from calibration.report.units import Unit, Units

#: Draws tell no smaller probability.
_SMALLEST = 1e-4
#: Deviations of a score that an effect cannot have, from which on its sign is worth a word.
_TELLING = 3.0
#: A relative change beyond this is told by both values.
_LARGE = 0.5


def label_of(candidate: CandidateStatement) -> str:
    """``plate friction``, ``tilt in needle``."""
    test = candidate.name.partition("@")[2]
    return f"{candidate.title} in {test}" if test else candidate.title


def labels_of(candidates: Iterable[CandidateStatement]) -> dict[str, str]:
    """Name -> label, of all candidates."""
    return {each.name: label_of(each) for each in candidates}


def unit_of(path: str, unit: str, units: Units) -> Unit:
    """In which a number of an effect is written: errors of a scale in %."""
    return Unit("%", 0.01) if unit == "1" and path.endswith("gain") else units.of_parameter(unit)


def sizes_in_words(candidate: CandidateStatement, units: Units) -> str:
    """``c 0.01 mm/N``: the smallest sizes that would be seen, as differences from where the effect is absent."""
    words = []
    for path, value in candidate.seen_from.items():
        absent = candidate.absent.get(path, 0.0)
        unit = unit_of(path, candidate.units.get(path, "1"), units)
        text = unit.text(abs(value - absent), 2)
        if absent:
            share = abs(value / absent - 1.0)
            in_percent = Unit("%", 0.01).text(share, 2)
            text = f"{unit.text(value, 2)} instead of {unit.text(absent, 2)}" if share > _LARGE else \
                in_percent if absent == 1.0 else f"{text} ({in_percent})"
        words.append(f"{plain_symbol(candidate.symbols.get(path, path.rpartition('.')[2]))} {text}")
    return ", ".join(words)


def number_in_words(number: Number, units: Units) -> str:
    """``g₁ = 3.02 ± 0.05 %``, as HTML."""
    unit, error = unit_of(number.path, number.unit, units), number.standard_error
    text = value_and_error(number.value / unit.size, error and error / unit.size, unit.name)
    return f"{html_symbol(number.symbol)} = {with_minus(text)}".replace(" ", "\u00a0")


def fitted_table(candidates: Sequence[CandidateStatement], units: Units) -> str:
    """Effects that were fitted, best first."""
    rows = []
    for each in (each for each in candidates if each.refitted):
        fitted = "<br>".join(number_in_words(number, units) for number in each.parameters)
        notes = [f"{', '.join(map(plain_symbol, each.on_bound))} on a bound"] if each.on_bound else []
        notes += [each.note] if each.note else []
        fitted += f'<br><span class="bad">{escape("; ".join(notes))}</span>' if notes else ""
        rows.append([escape(label_of(each)), fitted or "-", "-" if each.score is None else with_minus(
            f"{each.score:.1f}"), "-" if each.delta_BIC is None else gain_text(each.delta_BIC),
            "-" if each.explained_percent is None else f"{each.explained_percent:.3g}\u00a0%",
            escape(odds(each.evidence_ratio))])
    return html_table(["Fitted", "Numbers", "Score", "ΔBIC", "Explains", "Odds against"], rows, text=(1,),
                      narrow=True) if rows else ""


def testable_table(candidates: Sequence[CandidateStatement], units: Units) -> str:
    """Every effect that these tests can show, by category: the smallest size, and what the data show of it."""
    labels = labels_of(candidates)
    seen = sorted((each for each in candidates if each.testable),
                  key=lambda each: (CATEGORIES.index(each.category), each.title))
    rows: list[list[str | None]] = []
    last = CandidateStatement(name="", effect="", category="", title="", testable=True)
    for each in seen:
        test = each.name.partition("@")[2]
        rows.append([None if each.category == last.category else escape(each.category),
                     None if each.effect == last.effect else escape(each.title), escape(test),
                     escape(sizes_in_words(each, units)),
                     "-" if each.score is None else with_minus(f"{each.score:.1f}"), _likelihood(each),
                     escape(", ".join(labels.get(name, name) for name in each.twins)) or "-"])
        last = each
    labelled = ["Room", "Effect", "Test", "Smallest size seen", "Score", "p", "Twins here"]
    kept = [j for j in range(len(labelled)) if j not in (2, 6) or any(row[j] not in ("", "-") for row in rows)]
    return html_table([labelled[j] for j in kept], [[row[j] for j in kept] for row in rows],
                      text=[kept.index(j) for j in (1, 2, 3, 6) if j in kept])


def _likelihood(each: CandidateStatement) -> str:
    """That chance makes such a score; or that no size of the effect does."""
    if each.score is not None and each.p is not None and each.score < -_TELLING and each.p > 0.5:
        return '<span class="bad">wrong sign</span>'
    return chance(each.p)


def silent_table(candidates: Sequence[CandidateStatement]) -> str:
    """Effects that these tests cannot show, and why; those with the same reason together."""
    reasons: dict[str, list[CandidateStatement]] = {}
    for each in candidates:
        if not each.testable:
            reasons.setdefault(each.reason, []).append(each)
    rows = [[escape(", ".join(map(label_of, several))), escape(capital(reason))]
            for reason, several in reasons.items()]
    return html_table(["Cannot be seen", "Because"], rows, text=(0, 1), narrow=True) if rows else ""


def capital(words: str) -> str:
    """With a capital at its beginning."""
    return words[:1].upper() + words[1:]


def chance(p: float | None) -> str:
    """``0.031``, ``< 10⁻⁴``; ``-`` for None."""
    return "-" if p is None else "&lt; 10⁻⁴" if p < _SMALLEST else f"{p:.2g}".replace("e-0", "e-")


def odds(ratio: float | None) -> str:
    """``best``, ``45 : 1``; ``-`` for None."""
    if ratio is None:
        return "-"
    return "best" if ratio <= 1.0 else f"{ratio_text(ratio)} : 1"


def region_table(regions: Sequence[RegionGap], units: Units) -> str:
    """Each region in numbers and words."""
    rows: list[list[str | None]] = []
    last = None
    for each in regions:
        speed = "-" if each.speed_mm_s is None else f"{each.speed_mm_s:g}"
        after = "-" if each.after_N is None else units.force.text(each.after_N, 2)
        sigma = "-" if each.after_sigma is None else f"{each.after_sigma:.1f}"
        rows.append([None if each.test == last else escape(each.test), escape(each.segment), speed,
                     units.force.text(each.before_N, 2), after, _judged(f"{each.before_sigma:.1f}",
                                                                         each.adequate_before),
                     sigma if each.adequate_after is None else _judged(sigma, each.adequate_after)])
        last = each.test
    return html_table(["Test", "Segment", "Speed [mm/s]", "Gap before", "after", "Deviations before", "after"], rows,
                      text=(1,), narrow=True)


def _judged(text: str, adequate: bool) -> str:
    return text if adequate else f'<span class="bad">{text}</span>'


def parameter_table(before: Fit, after: Fit | None, units: Units) -> str:
    """Every parameter before and after, and what the effect had moved it by."""
    rows = []
    for name in dict.fromkeys((*before.parameters, *(() if after is None else after.parameters))):
        cells = [symbol_of(before if after is None or name in before.parameters else after, name)]
        for fit in (before, after):
            told = fit is not None and name in fit.parameters
            cells += ["-", "-"] if fit is None or not told else [
                with_minus(estimate_of(fit, name, units)), with_minus(interval_of(fit, name, units)) or "-"]
        moved = absorbed(before, after, name)
        cells.append("-" if moved is None else with_minus(f"{100 * moved:+.2g}\u00a0%"))
        rows.append(cells)
    labels = ["Parameter", "Nothing added", "95 % interval", "With what was added", "95 % interval", "Was off by"]
    kept = slice(None, 3 if after is None else None)
    return html_table(labels[kept], [row[kept] for row in rows], narrow=True)


def absorbed(before: Fit, after: Fit | None, name: str) -> float | None:
    """How far a parameter was off without the effect, relative to what it is with it; None where one has none."""
    if after is None or name not in before.parameters or not after.parameters.get(name) \
            or before.standard_errors[name] == 0:
        return None
    return before.parameters[name] / after.parameters[name] - 1.0


def held_out_table(held_out: Sequence[HeldOut], units: Units) -> str:
    """Data that the fits have not seen."""
    def size(value: float | None, noise: float | None, adequate: bool | None) -> str:
        if value is None:
            return "-"
        ratio = f" ({value / noise:.2g} × noise)" if noise else ""
        return _judged(f"{units.force.text(value, 2)}{ratio}", adequate is not False)

    kinds = {"replicate": "recording, left out of fits to the others", "test": "test, held out of all fits"}
    rows = [[escape(each.name), escape(kinds.get(each.kind, each.kind)), size(each.before_N, each.noise_N,
                                                                               each.adequate_before),
             size(each.after_N, each.noise_N, each.adequate_after),
             {None: "not tested", True: "yes", False: '<span class="bad">no</span>'}[
                 each.adequate_before if each.after_N is None else each.adequate_after],
             escape(each.note)] for each in held_out]
    kept = [j for j in range(6) if (j != 3 or any(each.after_N is not None for each in held_out))
            and (j != 5 or any(each.note for each in held_out))]
    labels = ["Unseen", "What", "Error, nothing added", "with what was added", "Only chance is left", "Note"]
    return html_table([labels[j] for j in kept], [[row[j] for j in kept] for row in rows],
                      text=[kept.index(j) for j in (1, 5) if j in kept], narrow=True)


def stage_table(diagnosis: Diagnosis) -> str:
    """What took how long."""
    rows = [[escape(each.name), f"{each.wall_s:.1f}", str(each.simulations)] for each in diagnosis.stages]
    rows.append(["all", f"{sum(each.wall_s for each in diagnosis.stages):.1f}",
                 str(sum(each.simulations for each in diagnosis.stages))])
    return html_table(["Stage", "Time [s]", "Simulations"], rows, narrow=True)
