"""Write the fitted laws as material files: parameters, uncertainty, valid range and provenance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameter_space import ParameterSpace
from calibration.fit.fit import Fit, get_shared_and_population_mean_material
from calibration.fit.result import CalibrationResult, describe_self_weight
from tissue_sim.laws import find_law
from tissue_sim.material.file import MaterialFile, write_material_file


def write_material_files(result: CalibrationResult, measured: Mapping[str, Sequence[MeasuredCurve]],
                         method: str) -> None:
    """Write the material file of each fit that has a name for one in `material_file`.

    Args:
        result: result of the calibration; the files are written to its folder.
        measured: recordings of each test.
        method: description of the fitting method.
    """
    for fit in result.fits:
        if fit.material_file is not None:
            write_material_file(make_material_file_of_fit(fit, result, measured, method),
                                result.output / fit.material_file)


def make_material_file_of_fit(fit: Fit, result: CalibrationResult, measured: Mapping[str, Sequence[MeasuredCurve]],
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
