"""Tables of an inverse calibration's page, as HTML."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from html import escape

from calibration.campaign.campaign import Test
from calibration.fit.fit import Direction, Fit, Prediction, Suggestion
from calibration.report.curve_figures import place_of, probability, size_of
from calibration.report.estimate_figures import NOT_TOLD
from calibration.report.figures import percent
from calibration.report.page import html_table, number, plus_minus, stable_stretches, symbol_of, title_of
from calibration.report.pressure import pressure_unit


def ranking_table(fits: Sequence[Fit]) -> str:
    """The laws in their order; the error of tests that they were not fitted to, where it ranks them."""
    best, predicted = fits[0], any(fit.left_out is not None for fit in fits)
    (e_unit, e_size), (mu_unit, mu_size) = pressure_unit(best.E0), pressure_unit(best.mu0)
    r_unit, r_size = pressure_unit(best.RMSE_Pa or 0.0)
    rows = []
    for fit in fits:
        # A difference to a law that cannot be used would invite to use it.
        difference = f"{fit.BIC - best.BIC:.4g}" if fit.unusable is None else "-"
        left_out = "-" if fit.left_out is None else percent(fit.left_out)
        rows.append([title_of(fit.law), *([left_out] if predicted else []),
                     f"{fit.E0 / e_size:.4g}", f"{fit.mu0 / mu_size:.4g}", f"{fit.R2:.5f}", number(fit.RMSE_N, 4),
                     number(None if fit.RMSE_Pa is None else fit.RMSE_Pa / r_size, 4), f"{fit.noise_ratio:.3g}",
                     difference, stable_stretches(fit)])
    return html_table(["Law", *(["Left-out error"] if predicted else []), f"E<sub>0</sub> [{e_unit}]",
                       f"μ<sub>0</sub> [{mu_unit}]", "R²", "RMSE [N]", f"RMSE [{r_unit}]", "Residual / noise", "ΔBIC",
                       "Stable stretches"], rows, best=True)


def prediction_table(predictions: Iterable[Prediction], tests: Mapping[str, Test]) -> str:
    """What each law predicts of each test that it was not fitted to."""
    rows = []
    for p in predictions:
        how = "held out of all fits" if tests[p.test].hold_out else f"left out; fitted to {', '.join(p.fitted)}"
        how += f"; none: {p.note}" if p.percent is None and p.note else ""
        rows.append([escape(p.test), escape(how), title_of(p.law), number(p.RMSE_N, 3), number(p.RMSE_Pa, 3),
                     "-" if p.percent is None else percent(p.percent), number(p.expected_N, 3)])
    return html_table(["Test", "How", "Law", "RMSE [N]", "RMSE [Pa]", "of the largest", "RMSE by chance [N]"], rows,
                      text=(1, 2))


def region_table(fits: Sequence[Fit], tests: Mapping[str, Test]) -> str:
    """Residual tests by region."""
    rows = [[title_of(fit.law), escape(r.test), escape(place_of(r, tests[r.test])), size_of(r.misfit_N, tests[r.test]),
             f"{size_of(r.largest_N, tests[r.test])} at " + (
                 f"strain {r.at:.3g}" if tests[r.test].specimen is None else f"{r.at:.3g} mm"),
             f"{r.statistic:.3g} ({r.freedom})", probability(r.p).replace("<", "&lt;"),
             "as noise" if r.adequate else '<span class="bad">misfit</span>'] for fit in fits for r in fit.regions]
    return html_table(["Law", "Test", "Region", "Misfit (rms)", "Largest model − data", "χ² (freedom)",
                       "p, adjusted", "Residuals"], rows, text=(1, 2))


def identifiability_table(fits: Sequence[Fit]) -> str:
    """Condition, combinations told poorly and what is not identifiable, a row a law."""
    rows = [[title_of(fit.law), number(fit.condition, 3),
             "; ".join(escape(direction_in_words(d, fit)) for d in fit.directions) or "none",
             f'<span class="bad">{", ".join(symbol_of(fit, name) for name in fit.not_identifiable)}</span>'
             if fit.not_identifiable else "none",
             "; ".join(escape(suggestion_in_words(s, fit)) for s in fit.suggestions) or "-"] for fit in fits]
    return html_table(["Law", "Condition", "Told poorly", "Not identifiable", "What would mend it"], rows,
                      text=(2, 3, 4))


def direction_in_words(direction: Direction, fit: Fit) -> str:
    """``0.99 C20 − 0.08 C10, known to ± 35 %``: relative changes of parameters that leave the forces as they are."""
    terms = sorted(direction.shares.items(), key=lambda item: -abs(item[1]))
    words = "".join(f"{' − ' if share < 0 else ' + '}{abs(share):.2f} {fit.symbols[name]}" for name, share in terms
                    if abs(share) >= 0.05)
    words = words.removeprefix(" + ").strip()
    error = direction.relative_error
    return f"{words}, known to ±\u00a0{100 * error:.3g}\u00a0%" if error < NOT_TOLD else f"{words}, not at all"


def suggestion_in_words(suggestion: Suggestion, fit: Fit) -> str:
    """``a test: C20 to ± 6.5 Pa``."""
    worst = [name for name in suggestion.standard_errors if name in fit.not_identifiable] \
        or list(suggestion.standard_errors)
    errors = ", ".join(f"{fit.symbols[name]}{plus_minus(suggestion.standard_errors[name])} {fit.unit(name)}".rstrip()
                       for name in worst)
    return f"{suggestion.test} would give {errors}"


def history_table(fit: Fit) -> str:
    """Every solve of every start."""
    names = list(fit.history[0].parameters)
    rows = [[f"{step.start}", f"{step.run}", *(f"{step.parameters[name]:.6g}" for name in names), f"{step.error:.6g}",
             f"{step.RMSE_N:.4g}", "yes" if step.corrected else "-"] for step in fit.history]
    units = [fit.unit(name) for name in names]
    return html_table(["Start", "Run", *(f"{symbol_of(fit, name)} [{unit}]" if unit else symbol_of(fit, name)
                                         for name, unit in zip(names, units, strict=True)),
                       "Error", "RMSE [N]", "Accurate mesh"], rows)
