"""``report.html``: one page, pictures inside, that a reader can judge the fits from."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from calibration.analytical.figures import draw_test
from calibration.analytical.replicates import Replicate
from calibration.fit.fit import Fit
from calibration.report.drawing import counted
from calibration.report.page import (
    correlation_tables,
    html_figure,
    html_list,
    html_page,
    html_table,
    nuisance_table,
    number,
    parameter_table,
    recording_list,
    remark_list,
    stable_stretches,
    title_of,
)
from calibration.report.pressure import format_pressure, pressure_unit
from calibration.report.self_weight import statement
from tissue_sim.atomic_write import write_text

if TYPE_CHECKING:
    from calibration.fit.result import CalibrationResult

def write_report(result: CalibrationResult, replicates: Sequence[Replicate], path: Path, *,
                 figures: bool = True) -> None:
    """Write the page of one campaign; without `figures` it holds the tables only."""
    write_text(path, _page(result, replicates, figures))


def _page(result: CalibrationResult, replicates: Sequence[Replicate], figures: bool) -> str:
    campaign = result.campaign
    parts = [f'<p class="quiet">{counted(len(replicates), "recording")} in {counted(len(campaign.tests), "test")}, '
             f"{counted(len(result.fits), 'law')}; least squares on nominal stress</p>",
             f'<p class="verdict">{escape(result.message)}</p>']
    if figures:
        for test in campaign.tests:
            mine = [r for r in replicates if r.test is test]
            caption = f"{test.name}{' (held out: predicted, not fitted)' if test.hold_out else ''}"
            parts += [f"<h2>{escape(caption)}</h2>",
                      html_figure(draw_test(result.fits, mine), f"Data, curves and residuals of {caption}")]
        parts.append("<p><small>Below: mean residual of all recordings; a law that is far off leaves the frame."
                     + (" Curves are drawn without the fitted offsets, residuals with them."
                        if campaign.fit.offset == "fit" else "") + "</small></p>")
    parts += ["<h2>Ranking</h2>", _ranking_table(result.fits), remark_list(result.fits), "<h2>Parameters</h2>",
              parameter_table(result.fits, figures), *correlation_tables(result.fits)]
    if result.predictions:
        parts += ["<h2>Predictions of held-out tests</h2>", _prediction_table(result)]
    if any(fit.nuisances for fit in result.fits):
        parts += [f"<h2>Contact offsets and zeros of {title_of(result.best.law)}</h2>", nuisance_table(result.best)]
    parts += ["<h2>What was assumed</h2>", html_list(map(escape, assumptions(result))), "<h2>Recordings</h2>",
              recording_list((r.file.name, r.sha256, r.stress.size) for r in replicates)]
    return html_page(f"Calibration of {campaign.name}", parts)


def assumptions(result: CalibrationResult) -> list[str]:
    """What the numbers rest on, one sentence each."""
    fit, noise = result.campaign.fit, result.campaign.noise
    lines = ["The material is incompressible and elastic: only the loading is fitted, and the rate does not matter."]
    if any(test.kind.settles for test in result.campaign.tests):
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
    for fit in fits:
        # A difference to a law that cannot be used would invite to use it.
        difference = f"{fit.BIC - best.BIC:.4g}" if fit.unusable is None else "-"
        rows.append([title_of(fit.law), f"{fit.E0 / e_size:.4g}", f"{fit.mu0 / mu_size:.4g}", f"{fit.R2:.5f}",
                     number(fit.RMSE_N, 4), f"{fit.RMSE_Pa / r_size:.4g}", difference, stable_stretches(fit)])
    labels = ["Law", f"E<sub>0</sub> [{e_unit}]", f"μ<sub>0</sub> [{mu_unit}]", "R²", "RMSE [N]", f"RMSE [{r_unit}]",
              "ΔBIC", "Stable stretches"]
    return html_table(labels, rows, best=True)


def _prediction_table(result: CalibrationResult) -> str:
    rows = [[escape(p.test), title_of(p.law), number(p.RMSE_N, 4), number(p.RMSE_Pa, 4), number(p.percent, 3)]
            for p in result.predictions]
    return html_table(["Test", "Law", "RMSE [N]", "RMSE [Pa]", "of the largest stress [%]"], rows, text=(1,))
