"""Files of a calibrated campaign."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path

from calibration.analytical.assess import residual_of
from calibration.analytical.replicates import Replicate, loading_path
from calibration.analytical.report import write_report
from calibration.fit.fit import Fit
from calibration.fit.result import CalibrationResult, to_json
from calibration.report.output_folder import FIT_FILE
from calibration.report.page import parameter_unit
from calibration.report.self_weight import statement
from tissue_sim.atomic_write import write_text
from tissue_sim.laws import find_law
from tissue_sim.material.file import MaterialFile, write_material_file
from tissue_sim.material.material import Material

CURVE_POINTS = 101


def write_campaign(result: CalibrationResult, replicates: Sequence[Replicate], *, figures: bool = True) -> None:
    """Write everything; ``fit.json`` last, because it says that the campaign is finished."""
    fitted = [r for r in replicates if not r.test.hold_out]
    for fit in result.fits:
        if fit.material_file is not None:
            write_material_file(material_file(fit, result, fitted), result.output / fit.material_file)
    write_text(result.output / "curves.csv", _curves(result, replicates))
    write_text(result.output / "residuals.csv", _residuals(result, replicates))
    write_report(result, replicates, result.output / "report.html", figures=figures)
    text = json.dumps(to_json([result]), indent=2, ensure_ascii=False, allow_nan=False)
    write_text(result.output / FIT_FILE, text + "\n")


def material_file(fit: Fit, result: CalibrationResult, fitted: Sequence[Replicate]) -> MaterialFile:
    """The material of a fit with its uncertainty, valid range and provenance."""
    campaign = result.campaign
    law = find_law(fit.law)
    errors = {name: error for name, error in fit.standard_errors.items() if error is not None}
    # The covariance of the others holds for a parameter that stays on its bound, as it does for a fixed one.
    complete = all(name in errors or name in fit.on_bound for name in fit.standard_errors)
    residual = {"RMSE_Pa": fit.RMSE_Pa, "R2": fit.R2}
    if fit.RMSE_N is not None:
        residual["RMSE_N"] = fit.RMSE_N
    return MaterialFile.of(
        Material(fit.law, fit.parameters, campaign.fit.bulk, density=campaign.density,
                 name=f"{campaign.name} {law.title}"),
        standard_errors=errors, covariance=fit.covariance.matrix if complete else None,
        valid_range={"stretch": list(fit.stretch_range)},
        provenance={
            "recordings": [{"file": r.file.name, "sha256": r.sha256} for r in fitted],
            "method": "analytical: least squares on nominal stress", "residual": residual,
            "settings": {"campaign": campaign.path.name, "campaign_sha256": campaign.sha256,
                         "offset": campaign.fit.offset, "noise_Pa": result.noise_Pa,
                         "noise_source": result.noise_source, "self_weight": statement(campaign, fit),
                         "status": fit.status, "BIC": fit.BIC, "covariance_from": fit.covariance_from}})


def write_summary(results: Sequence[CalibrationResult], path: Path) -> None:
    """One row for each law of each campaign; a cell is empty where the method has no such figure."""
    laws = [(fit.law, name) for result in results for fit in result.fits for name in fit.parameters]
    units = {name: parameter_unit(find_law(law), name) or "-" for law, name in laws}
    header = ["campaign", "rank", "law", "status", "E0 [Pa]", "mu0 [Pa]", "R2", "RMSE [N]", "RMSE [Pa]", "AIC", "BIC",
              "left_out [%]", "noise_ratio", "stable_from", "stable_to", "not_identifiable", "fem_solves", "cpu [s]"]
    for name, unit in units.items():
        header += [f"{name} [{unit}]", f"{name} standard error [{unit}]", f"{name} low95 [{unit}]",
                   f"{name} high95 [{unit}]"]
    rows = []
    for result in results:
        for rank, fit in enumerate(result.fits, start=1):
            row = [result.campaign.name, rank, fit.law, fit.status, fit.E0, fit.mu0, fit.R2, fit.RMSE_N, fit.RMSE_Pa,
                   fit.AIC, fit.BIC, fit.left_out, fit.noise_ratio, fit.stable_from, fit.stable_to,
                   " ".join(fit.not_identifiable), fit.fem_solves, fit.cpu_s]
            for name in units:
                low, high = fit.intervals95.get(name) or (None, None)
                row += [fit.parameters.get(name), fit.standard_errors.get(name), low, high]
            rows.append(row)
    write_text(path, format_table(header, rows))


def _curves(result: CalibrationResult, replicates: Sequence[Replicate]) -> str:
    """Each law along each test, from rest (shear that goes both ways: from one end) to the end of the data."""
    rows = []
    for test in result.campaign.tests:
        mine = [r for r in replicates if r.test is test]
        abscissa = loading_path(mine, CURVE_POINTS)
        for fit in result.fits:
            stress = mine[0].model.stress(find_law(fit.law), abscissa, fit.parameters)
            for a, p in zip(abscissa, stress, strict=True):
                rows.append([fit.law, test.name, mine[0].model.abscissa, a, p, *_rig_units(a, p, mine[0])])
    return format_table(["law", "test", "abscissa", "value", "nominal stress [Pa]", "displacement [mm]", "force [N]"],
                        rows)


def _residuals(result: CalibrationResult, replicates: Sequence[Replicate]) -> str:
    """Every sample: measured, model, model minus measured; offsets and zeros taken into account."""
    rows = []
    for fit in result.fits:
        for replicate in replicates:
            residual = residual_of(fit, replicate)
            area = replicate.area
            for a, p, r in zip(replicate.abscissa, replicate.stress, residual, strict=True):
                rows.append([fit.law, replicate.name, replicate.model.abscissa, a, p, p + r, r,
                             None if area is None else replicate.force_sign * area * r])
    return format_table(["law", "replicate", "abscissa", "value", "measured [Pa]", "model [Pa]", "residual [Pa]",
                   "residual [N]"], rows)


def _rig_units(abscissa: float, stress: float, replicate: Replicate) -> tuple[float | None, float | None]:
    """Displacement in mm and force in N, where there is a specimen."""
    if replicate.test.specimen is None:
        return None, None
    sign = replicate.force_sign
    return sign * (abscissa - replicate.rest) * replicate.test.specimen.height * 1e3, sign * stress * replicate.area


def format_table(header: Sequence[str], rows: Iterable[Sequence]) -> str:
    """CSV with eight digits; None and NaN are empty cells."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    # NaN is where a law carries no more.
    writer.writerows(["" if cell is None or cell != cell else f"{cell:.8g}" if isinstance(cell, float) else cell
                      for cell in row] for row in rows)
    return stream.getvalue()
