"""Write the result files of a calibrated campaign."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path

import msgspec
import numpy as np

from calibration.campaign.campaign import Campaign
from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameter_space import ParameterSpace
from calibration.fit.curves import TestCurves
from calibration.fit.fit import Fit
from calibration.fit.result import CalibrationResult, to_json_dictionary
from calibration.fit.self_weight import describe_self_weight
from calibration.fit.typical_material import get_shared_and_population_mean_material
from calibration.output_folder import FIT_FILE
from calibration.report.drawing import FigureEmbedder
from calibration.report.methods import make_plain_methods_text
from calibration.report.page import format_law_title, make_html_page, make_html_table
from calibration.report.report import build_report_page
from calibration.report.units import ReportUnits
from tissue_sim.atomic_write import write_text
from tissue_sim.laws import find_law
from tissue_sim.material.file import MaterialFile, write_material_file

#: Law -> recorded and fitted curves of each test.
Curves = Mapping[str, Sequence[TestCurves]]


def write_calibration_files(result: CalibrationResult, curves: Curves, measured: Mapping[str, Sequence[MeasuredCurve]],
                            method: str, *, figures: bool = True, figures_format: str | None = None) -> None:
    """Write all result files of a calibration.

    ``fit.json`` is written last, because its existence marks the campaign as finished.

    Args:
        result: result of the calibration, fits best first.
        curves: recorded and fitted curves of each test, by law.
        measured: recordings of each test.
        method: description of the fitting method for the material files.
        figures: whether the report includes figures.
        figures_format: ``svg``, ``pdf`` or ``png`` to write each figure also as a file; None: no figure files.
    """
    for fit in result.fits:
        if fit.material_file is not None:
            write_material_file(build_material_file_struct(fit, result, measured, method),
                                result.output / fit.material_file)
    write_text(result.output / "curves.csv", _format_csv_of_all_fitted_curves(curves))
    write_text(result.output / "residuals.csv", _format_residual_table(curves))
    methods = make_plain_methods_text(result, measured, ReportUnits.choose_for_best_fit(result))
    write_text(result.output / "methods.txt", methods)
    pictures = FigureEmbedder(result.output, figures_format) if figures else None
    write_text(result.output / "report.html", build_report_page(result, curves, methods, pictures))
    text = json.dumps(to_json_dictionary([result]), indent=2, ensure_ascii=False, allow_nan=False)
    write_text(result.output / FIT_FILE, text + "\n")


def write_failure_report(campaign: Campaign, failures: Mapping[str, str], folder: Path) -> None:
    """Write the report of a campaign in which no law could be fitted, with the reason for each law."""
    rows: list[list[str | None]] = [[format_law_title(law), escape(reason)] for law, reason in failures.items()]
    write_text(folder / "report.html", make_html_page(f"Calibration of {campaign.name}", [
        "<p>No law has a fit.</p>", make_html_table(["Law", "Reason"], rows, text=(1,))]))


def build_material_file_struct(fit: Fit, result: CalibrationResult, measured: Mapping[str, Sequence[MeasuredCurve]],
                               method: str) -> MaterialFile:
    """Return the content of the material file of a fit: parameters, uncertainty, valid range and provenance.

    Args:
        fit: the fit of one law.
        result: result of the calibration.
        measured: recordings of each test.
        method: description of the fitting method.
    """
    campaign = result.campaign
    law = find_law(fit.law)
    space = ParameterSpace.from_campaign(fit.law, campaign, {name: [curve.name for curve in curves]
                                                             for name, curves in measured.items()})
    # The file format has no standard error for the bulk response. Parameters of experiment and rig are excluded.
    material = get_shared_and_population_mean_material(fit)
    of_material = {each.path for each in space.unknowns if each.is_material_parameter}
    kept = [i for i, path in enumerate(material.parameters) if path in of_material and not path.startswith("bulk.")]
    order = [path for i, path in enumerate(material.parameters) if i in kept]
    errors = {path: error for path, error in material.errors.items() if error is not None and path in order}
    # A parameter at its bound counts as fixed: the covariance of the other parameters remains valid.
    held = {name.partition("@")[0] for name in fit.on_bound}
    complete = all(path in errors or path in held for path in order) and set(law.parameters) <= set(order)
    covariance = material.covariance[np.ix_(kept, kept)] if complete else None
    values = fit.parameters | {each.name: material.parameters[each.path] for each in space.unknowns
                               if each.specimen is not None and each.path in material.parameters}
    population, whose = None, {}
    if fit.material_of:
        whose = {"material_of": fit.material_of, "left_out_specimens": fit.left_out_specimens}
    if fit.population is not None:
        found = fit.population
        population = {"order": found.order, "mean": found.mean, "spread": found.spread,
                      "between_specimens": found.between, "mean_interval95": found.mean_intervals,
                      "spread_interval95": found.spread_intervals,
                      "specimens": dict(zip(found.specimens, found.estimates, strict=True)),
                      "left_out": fit.left_out_specimens}
    residual = {key: value for key, value in (("RMSE_N", fit.RMSE_N), ("RMSE_Pa", fit.RMSE_Pa), ("R2", fit.R2))
                if value is not None}
    fitted = [curve for test in campaign.tests if not test.hold_out for curve in measured[test.name]]
    return MaterialFile.of(
        space.build_material(values, campaign.density, f"{campaign.name} {law.title}"),
        standard_errors=errors, covariance=covariance, others=[name for name in order if name not in law.parameters],
        population=population,
        valid_range={"stretch": list(fit.stretch_range)},
        provenance={
            "recordings": [{"file": curve.file.name, "sha256": curve.sha256} for curve in fitted],
            "method": method, "residual": residual,
            "settings": {"campaign": campaign.path.name, "campaign_sha256": campaign.sha256,
                         "offset": campaign.fit.offset, "noise_Pa": result.noise_Pa,
                         "noise_source": result.noise_source,
                         "tests": [test.name for test in campaign.tests if not test.hold_out],
                         "intervals95": {name: list(pair) for name, pair in fit.intervals95.items()
                                         if pair is not None},
                         "not_identifiable": fit.not_identifiable, "left_out_percent": fit.left_out,
                         "self_weight": describe_self_weight(campaign, fit), "status": fit.status, "BIC": fit.BIC,
                         "unusable": fit.unusable, "alternatives": msgspec.to_builtins(fit.alternatives),
                         "covariance_from": fit.covariance_from, **whose}})


def write_summary_table(results: Sequence[CalibrationResult], path: Path) -> None:
    """Write ``summary.csv`` with one row per law and campaign; cells without a value are empty."""
    units = {name: fit.get_unit_or_empty_if_dimensionless(name) or "-" for result in results for fit in result.fits
             for name in fit.parameters}
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
    write_text(path, format_csv_table(header, rows))


def _format_csv_of_all_fitted_curves(curves: Curves) -> str:
    """Return a CSV table of the fitted curves of all laws and tests, with standard errors and prediction bands.

    The half widths of the 95 % bands are for single samples of a new recording and for its entire curve.
    """
    rows = []
    for law, tests in curves.items():
        for test in tests:
            time = [None] * test.force.size if test.time is None else test.time.tolist()
            columns = (test.displacement, test.force, test.force_error, test.band, test.whole_band)
            rows += [[law, test.test.name, t, *_make_cells_of_abscissa_force_and_stress(test, d, (f,), (e, b, w))]
                     for t, d, f, e, b, w in zip(time, *(column.tolist() for column in columns), strict=True)]
    return format_csv_table(["law", "test", "time [s]", "abscissa", "value", "displacement [mm]", "force [N]",
                             "standard error [N]", "band95 [N]", "whole band95 [N]", "nominal stress [Pa]",
                             "standard error [Pa]", "band95 [Pa]", "whole band95 [Pa]"], rows)


def _format_residual_table(curves: Curves) -> str:
    """Return a CSV table of all samples of all laws and tests: measured force, model and residual.

    The model includes the contact offset and the force zero of each recording.
    """
    rows = []
    for law, tests in curves.items():
        for test in tests:
            for curve, model in zip(test.measured, test.fitted, strict=True):
                time = [None] * model.size if curve.time is None else curve.time.tolist()
                rows += [[law, curve.name, t, *_make_cells_of_abscissa_force_and_stress(test, d, (f, m, m - f))] for t,
                         d, f, m in zip(
                    time, curve.displacement.tolist(), curve.force.tolist(), model.tolist(), strict=True)]
    return format_csv_table(["law", "replicate", "time [s]", "abscissa", "value", "displacement [mm]", "measured [N]",
                             "model [N]", "residual [N]", "measured [Pa]", "model [Pa]", "residual [Pa]"], rows)


def _make_cells_of_abscissa_force_and_stress(test: TestCurves, displacement: float, forces: Sequence[float],
                                             errors: Sequence[float] = ()) -> list[float | str | None]:
    """Return the cells of a row: abscissa (name, value), displacement in mm, forces in N and stresses in Pa.

    Cells that the test does not define are None. A nominal stress is negative in compression, its errors are positive.
    """
    setup, empty = test.test, [None] * (len(forces) + len(errors))
    mechanical = [None, *empty] if setup.specimen is None else [displacement * 1e3, *forces, *errors]
    if test.area is None:
        return [None, None, *mechanical, *empty]
    sign, height = setup.kind.sign, 1.0 if setup.specimen is None else setup.specimen.height
    name = setup.kind.require_closed_form().label
    value = setup.kind.convert_nominal_strain_to_stretch_or_shear_strain(displacement / height)
    if setup.specimen is not None and setup.specimen.specific_weight:
        name = "1 - displacement/height [-]"
    return [name, value, *mechanical, *(sign * force / test.area for force in forces),
            *(error / test.area for error in errors)]


def format_csv_table(header: Sequence[str], rows: Iterable[Sequence]) -> str:
    """Return a CSV table; floats have eight significant digits, None and NaN are empty cells."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    # NaN marks states beyond the largest load that a law can carry.
    writer.writerows(["" if cell is None or cell != cell else f"{cell:.8g}" if isinstance(cell, float) else cell
                      for cell in row] for row in rows)
    return stream.getvalue()
