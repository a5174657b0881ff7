"""``report.html``: one page, pictures inside, that a reader can judge the fits from."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from calibration.figures import as_data_uri, draw_formula, draw_test, natural_width
from calibration.fit import Fit
from calibration.pressure import format_pressure, pressure_unit
from calibration.replicates import Replicate
from calibration.self_weight import statement
from tissue_sim.atomic_write import write_text
from tissue_sim.laws import find_law

if TYPE_CHECKING:
    from calibration.analytical import CalibrationResult

_STYLE = """
:root { color-scheme: light; }
body { font: 15px/1.5 system-ui, -apple-system, "Segoe UI", sans-serif; color: #1b1f24; background: #fff;
       max-width: 76rem; margin: 2rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.55rem; margin: 0 0 .2rem; } h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; }
h3 { font-size: 1rem; margin: 1rem 0 .3rem; } table.narrow { width: auto; }
.verdict { background: #eef4fa; border-left: 4px solid #0072b2; padding: .7rem 1rem; margin: 1rem 0; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { text-align: right; padding: .35rem .6rem; border-bottom: 1px solid #dfe3e8;
         vertical-align: top; white-space: nowrap; }
th:first-child, td:first-child, td.text, th.text { text-align: left; } td.text { white-space: normal; }
thead th { border-bottom: 2px solid #59636e; font-weight: 600; } tr.best td { background: #f3f8f1; }
img { max-width: 100%; height: auto; } img.formula { max-width: none; vertical-align: middle; }
small, .quiet { color: #59636e; } .bad { color: #a33c00; }
"""


def write_report(result: CalibrationResult, replicates: Sequence[Replicate], path: Path, *,
                 figures: bool = True) -> None:
    """Write the page of one campaign; without `figures` it holds the tables only."""
    write_text(path, _page(result, replicates, figures))


def _page(result: CalibrationResult, replicates: Sequence[Replicate], figures: bool) -> str:
    campaign = result.campaign
    title = escape(campaign.name)
    parts = [f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>Calibration of {title}</title>',
             '<meta name="viewport" content="width=device-width, initial-scale=1">',
             f"<style>{_STYLE}</style></head><body>",
             f"<h1>Calibration of {title}</h1>",
             f'<p class="quiet">{len(replicates)} recording{"s" if len(replicates) != 1 else ""} in '
             f"{len(campaign.tests)} test{'s' if len(campaign.tests) != 1 else ''}, {len(result.fits)} "
             f"law{'s' if len(result.fits) != 1 else ''}; least squares on nominal stress</p>",
             f'<p class="verdict">{escape(result.message)}</p>']
    if figures:
        for test in campaign.tests:
            mine = [r for r in replicates if r.test is test]
            held_out = " (held out: predicted, not fitted)" if test.hold_out else ""
            caption = escape(f"{test.name}{held_out}")
            image = as_data_uri(draw_test(result.fits, mine))
            parts.append(f'<h2>{caption}</h2><img src="{image}" alt="Data, curves and residuals of {caption}">')
        parts.append("<p><small>Below: mean residual of all recordings; a law that is far off leaves the frame."
                     + (" Curves are drawn without the fitted offsets, residuals with them."
                        if campaign.fit.offset == "fit" else "") + "</small></p>")
    parts += ["<h2>Ranking</h2>", _ranking_table(result.fits), _remarks(result.fits), "<h2>Parameters</h2>",
              _parameter_table(result.fits, figures), *_correlation_tables(result.fits)]
    if result.predictions:
        parts += ["<h2>Predictions of held-out tests</h2>", _prediction_table(result)]
    if any(fit.nuisances for fit in result.fits):
        parts += [f"<h2>Contact offsets and zeros of {escape(find_law(result.best.law).title)}</h2>",
                  _nuisance_table(result.best)]
    parts += ["<h2>What was assumed</h2><ul>", *(f"<li>{escape(text)}</li>" for text in assumptions(result)), "</ul>",
              _recording_list(replicates), "</body></html>"]
    return "\n".join(parts) + "\n"


def assumptions(result: CalibrationResult) -> list[str]:
    """What the numbers rest on, one sentence each."""
    fit, noise = result.campaign.fit, result.campaign.noise
    kinds = {test.kind for test in result.campaign.tests}
    lines = ["The material is incompressible and elastic: only the loading is fitted, and the rate does not matter."]
    if "lubricated_compression" in kinds:
        lines.append("Lubricated means frictionless: the faces slide freely and every slice deforms homogeneously.")
    lines.append(statement(result.campaign, result.best))
    if fit.offset == "none":
        lines.append("Contact offsets and zeros are taken as they were recorded (offset = \"none\").")
        if noise.contact_jitter or noise.zero_jitter:
            lines.append(f"Standard errors include a jitter between recordings of {noise.contact_jitter * 1e3:g} mm "
                         f"and {noise.zero_jitter:g} N.")
    else:
        lines.append(f"Each recording has a contact offset (prior 0 ± {fit.offset_prior * 1e3:g} mm, bounds "
                     f"± {fit.offset_bound * 1e3:g} mm) and a zero, fitted beside the parameters.")
    source = {"stated": "stated in the campaign", "estimated": "estimated from second differences of the samples",
              "resolution": "the resolution of the sensor, step/√12, because neighbouring samples are mostly equal",
              "mixed": "of different sources for different recordings"}[result.noise_source]
    lines.append(f"The noise of the nominal stress is {format_pressure(result.noise_Pa, 3)} (standard deviation), "
                 f"{source}; AIC and BIC take it as known.")
    if fit.prior or fit.offset == "fit":
        lines.append("AIC and BIC are those of the penalised likelihood: the distance from the priors counts.")
    if fit.strain_points is not None:
        lines.append(f"Each recording was interpolated to {fit.strain_points} evenly spaced strains.")
    return lines


def _ranking_table(fits: Sequence[Fit]) -> str:
    best = fits[0]
    (e_unit, e_size), (mu_unit, mu_size) = pressure_unit(best.E0), pressure_unit(best.mu0)
    r_unit, r_size = pressure_unit(best.RMSE_Pa)
    rows = []
    for i, fit in enumerate(fits):
        # A difference to a law that cannot be used would invite to use it.
        difference = f"{fit.BIC - best.BIC:.4g}" if fit.unusable is None else "-"
        rows.append(
            f'<tr{" class=best" if i == 0 else ""}><td>{escape(find_law(fit.law).title)}</td>'
            f"<td>{fit.E0 / e_size:.4g}</td><td>{fit.mu0 / mu_size:.4g}</td><td>{fit.R2:.5f}</td>"
            f"<td>{_number(fit.RMSE_N, 4)}</td><td>{fit.RMSE_Pa / r_size:.4g}</td><td>{difference}</td>"
            f"<td>{stable_stretches(fit)}</td></tr>")
    head = (f"<th>Law</th><th>E<sub>0</sub> [{e_unit}]</th><th>μ<sub>0</sub> [{mu_unit}]</th><th>R²</th>"
            f"<th>RMSE [N]</th><th>RMSE [{r_unit}]</th><th>ΔBIC</th><th>Stable stretches</th>")
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'


def stable_stretches(fit: Fit) -> str:
    """Drucker-stable stretches in all three modes, such as ``0.3 to 3``."""
    nowhere = fit.mu0 <= 0 or fit.stable_from >= fit.stable_to
    return "nowhere" if nowhere else f"{fit.stable_from:.3g} to {fit.stable_to:.3g}"


def _remarks(fits: Sequence[Fit]) -> str:
    """Drucker stability and the message of each fit, a line each."""
    lines = []
    for fit in fits:
        warn = "" if fit.status == "converged" else ' class="bad"'
        lines.append(f"<li{warn}>{escape(find_law(fit.law).title)}: {escape(fit.message)}; "
                     f"Drucker: {escape(fit.stability)}</li>")
    return f"<ul>{''.join(lines)}</ul>"


def _parameter_table(fits: Sequence[Fit], figures: bool) -> str:
    rows = []
    for fit in fits:
        law = find_law(fit.law)
        png = draw_formula(fit.law) if figures else None
        formula = escape(fit.formula) if png is None else \
            f'<img class="formula" width="{natural_width(png)}" src="{as_data_uri(png)}" alt="{escape(fit.formula)}">'
        for i, (name, value) in enumerate(fit.parameters.items()):
            error, interval = fit.standard_errors[name], fit.intervals95[name]
            unit = "" if law.units[name] == "1" else f" {law.units[name]}"
            doubtful = ' <span class="bad">not determined</span>' if name in fit.not_identifiable else ""
            lead = f'<td rowspan="{len(fit.parameters)}">{escape(law.title)}<br>{formula}</td>' if i == 0 else ""
            held = "on its bound" if name in fit.on_bound else "-"
            spread = held if error is None else "fixed" if error == 0 else f"{error:.3g}{unit}"
            bounds = "-" if interval is None or error == 0 else f"{interval[0]:.5g} to {interval[1]:.5g}"
            rows.append(f'<tr>{lead}<td class="text">{escape(name)}{doubtful}</td><td>{value:.6g}{unit}</td>'
                        f"<td>{spread}</td><td>{bounds}</td></tr>")
    head = ('<th>Law</th><th class="text">Parameter</th><th>Value</th><th>Standard error</th><th>95 % interval</th>')
    return f'<div class="wide"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'


def _correlation_tables(fits: Sequence[Fit]) -> list[str]:
    """How the estimates depend on each other, for every law with more than one free parameter."""
    parts = []
    for fit in fits:
        order = fit.covariance.order
        free = [i for i, name in enumerate(order) if fit.standard_errors[name] not in (None, 0.0)]
        if len(free) < 2:
            continue
        head = "".join(f"<th>{escape(order[i])}</th>" for i in free)
        rows = "".join(
            f"<tr><td>{escape(order[i])}</td>{''.join(f'<td>{fit.correlation[i][j]:.3f}</td>' for j in free)}</tr>"
            for i in free)
        parts.append(f'<h3>{escape(find_law(fit.law).title)}</h3><table class="narrow"><thead><tr><th></th>{head}</tr>'
                     f"</thead><tbody>{rows}</tbody></table>")
    return ["<h2>Correlation of the parameters</h2>", *parts] if parts else []


def _prediction_table(result: CalibrationResult) -> str:
    rows = [f'<tr><td>{escape(p.test)}</td><td class="text">{escape(find_law(p.law).title)}</td>'
            f"<td>{_number(p.RMSE_N, 4)}</td><td>{_number(p.RMSE_Pa, 4)}</td><td>{_number(p.percent, 3)}</td></tr>"
            for p in result.predictions]
    head = ('<th>Test</th><th class="text">Law</th><th>RMSE [N]</th><th>RMSE [Pa]</th>'
            "<th>of the largest stress [%]</th>")
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"


def _nuisance_table(fit: Fit) -> str:
    rows = [f"<tr><td>{escape(n.replicate)}</td><td>{n.contact_offset_mm:.4f}{_error(n.contact_offset_error_mm)}</td>"
            f"<td>{n.zero_offset_N:.4f}{_error(n.zero_offset_error_N)}</td>"
            f'<td class="text bad">{escape(", ".join(n.on_bound))}</td></tr>' for n in fit.nuisances]
    head = '<th>Recording</th><th>Contact offset [mm]</th><th>Zero [N]</th><th class="text">On its bound</th>'
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"


def _number(number: float | None, digits: int) -> str:
    return "-" if number is None else f"{number:.{digits}g}"


def _error(error: float | None) -> str:
    return "" if error is None else f" ± {error:.2g}"


def _recording_list(replicates: Sequence[Replicate]) -> str:
    rows = "".join(f"<li>{escape(r.file.name)} <small>SHA-256 {escape(r.sha256[:16])}…, {r.stress.size} points</small>"
                   "</li>" for r in replicates)
    return f"<h2>Recordings</h2><ul>{rows}</ul>"
