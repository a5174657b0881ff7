"""Files of an inverse calibration."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np

from calibration.analytical.outputs import format_table
from calibration.campaign.measured import MeasuredCurve
from calibration.fit.fit import Fit
from calibration.fit.parameters import ParameterSpace
from calibration.fit.result import CalibrationResult, to_json
from calibration.fit.results import TestCurves
from calibration.report.output_folder import FIT_FILE
from calibration.report.report import write_inverse_report
from calibration.report.self_weight import statement
from tissue_sim.atomic_write import write_text
from tissue_sim.laws import find_law
from tissue_sim.material.file import MaterialFile, write_material_file

Curves = Mapping[str, Sequence[TestCurves]]


def write_campaign(result: CalibrationResult, curves: Curves, measured: Mapping[str, Sequence[MeasuredCurve]], *,
                   figures: bool = True) -> None:
    """Write everything; ``fit.json`` last, because it says that the campaign is finished."""
    for fit in result.fits:
        if fit.material_file is not None:
            write_material_file(material_file(fit, result, measured), result.output / fit.material_file)
    write_text(result.output / "curves.csv", _curves(curves))
    write_text(result.output / "residuals.csv", _residuals(curves))
    write_inverse_report(result, curves, result.output / "report.html", figures=figures)
    text = json.dumps(to_json([result]), indent=2, ensure_ascii=False, allow_nan=False)
    write_text(result.output / FIT_FILE, text + "\n")


def material_file(fit: Fit, result: CalibrationResult, measured: Mapping[str, Sequence[MeasuredCurve]]) -> MaterialFile:
    """The material of a fit with its uncertainty, valid range and provenance."""
    campaign = result.campaign
    law, space = find_law(fit.law), ParameterSpace.of(fit.law, campaign)
    # Of the bulk response the schema keeps no standard error.
    kept = [i for i, name in enumerate(fit.covariance.order) if not name.startswith("bulk.")]
    order = [fit.covariance.order[i] for i in kept]
    errors = {name: error for name, error in fit.standard_errors.items() if error is not None and name in order}
    complete = all(name in errors or name in fit.on_bound for name in order)
    covariance = np.array(fit.covariance.matrix)[np.ix_(kept, kept)] if complete else None
    residual = {key: value for key, value in (("RMSE_N", fit.RMSE_N), ("RMSE_Pa", fit.RMSE_Pa), ("R2", fit.R2))
                if value is not None}
    fitted = [curve for test in campaign.tests if not test.hold_out for curve in measured[test.name]]
    return MaterialFile.of(
        space.material(fit.parameters, campaign.density, f"{campaign.name} {law.title}"),
        standard_errors=errors, covariance=covariance, others=[name for name in order if name not in law.parameters],
        valid_range={"stretch": list(fit.stretch_range)},
        provenance={
            "recordings": [{"file": curve.file.name, "sha256": curve.sha256} for curve in fitted],
            "method": "inverse FEM: generalised least squares on force", "residual": residual,
            "settings": {"campaign": campaign.path.name, "campaign_sha256": campaign.sha256,
                         "tests": [test.name for test in campaign.tests if not test.hold_out],
                         "intervals95": {name: list(pair) for name, pair in fit.intervals95.items()
                                         if pair is not None},
                         "not_identifiable": fit.not_identifiable, "left_out_percent": fit.left_out,
                         "self_weight": statement(campaign, fit), "status": fit.status,
                         "covariance_from": fit.covariance_from}})


def _curves(curves: Curves) -> str:
    """Each law along each test, with its standard error and the half width of the 95 % band of a new recording."""
    rows = []
    for law, tests in curves.items():
        for test in tests:
            time = [None] * test.force.size if test.time is None else test.time.tolist()
            rows += [[law, test.test.name, t, *_in_units(test, d, f, e, b)] for t, d, f, e, b in zip(
                time, test.displacement.tolist(), test.force.tolist(), test.force_error.tolist(), test.band.tolist(),
                strict=True)]
    return format_table(["law", "test", "time [s]", "displacement [mm]", "force [N]", "standard error [N]",
                         "band95 [N]", "strain [-]", "nominal stress [Pa]", "standard error [Pa]", "band95 [Pa]"], rows)


def _in_units(test: TestCurves, displacement: float, *forces: float) -> list[float | None]:
    """Displacement in mm and forces in N, or strain and stresses, whichever was recorded; the others are empty."""
    if test.test.specimen is None:
        return [*[None] * (1 + len(forces)), displacement, *forces]
    return [displacement * 1e3, *forces, *[None] * (1 + len(forces))]


def _residuals(curves: Curves) -> str:
    """Every sample: measured, model with its own offset and zero, model minus measured."""
    rows = []
    for law, tests in curves.items():
        for test in tests:
            for curve, model in zip(test.measured, test.fitted, strict=True):
                time = [None] * model.size if curve.time is None else curve.time.tolist()
                rows += [[law, curve.name, t, *_in_units(test, d, f, m, m - f)] for t, d, f, m in zip(
                    time, curve.displacement.tolist(), curve.force.tolist(), model.tolist(), strict=True)]
    return format_table(["law", "replicate", "time [s]", "displacement [mm]", "measured [N]", "model [N]",
                         "residual [N]", "strain [-]", "measured [Pa]", "model [Pa]", "residual [Pa]"], rows)
