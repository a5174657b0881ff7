"""Section with the assumptions behind the numbers of a calibration or diagnosis."""

from __future__ import annotations

from collections.abc import Iterator

from calibration.diagnosis.diagnosis import join_as_enumeration
from calibration.fit.result import CalibrationResult, describe_self_weight
from calibration.report.content import Block, Listing
from calibration.report.drawing import format_count
from calibration.report.section import CalibrationReport, DiagnosisReport, Section
from calibration.report.units import ReportUnits


class Assumptions(Section):
    """Assumptions, one sentence each."""

    name = "assumptions"
    title = "Assumptions"
    reports = ("calibration", "diagnosis")

    def iterate_blocks(self, report: CalibrationReport | DiagnosisReport) -> Iterator[Block]:
        """Yield the list of the assumptions."""
        yield Listing(_list_calibration_assumptions(report.result, report.units)
                      if isinstance(report, CalibrationReport) else [*_iterate_diagnosis_assumptions(report)])


def _list_calibration_assumptions(result: CalibrationResult, units: ReportUnits) -> list[str]:
    """Return the assumptions of a calibration, one sentence each."""
    campaign = result.campaign
    lines = _list_analytical_assumptions(result, units) if campaign.fit.method == "analytical" \
        else _list_simulation_assumptions(result, units)
    if campaign.fit.fixed:
        lines.append(f"Fixed: {', '.join(f'{name} = {value:g}' for name, value in campaign.fit.fixed.items())}.")
    lines += [f"Prior of {name}: {mean:g} ± {deviation:g}." for name, (mean, deviation) in campaign.fit.prior.items()]
    return [*lines, describe_self_weight(campaign, result.best)]


def _list_analytical_assumptions(result: CalibrationResult, units: ReportUnits) -> list[str]:
    """Return the assumptions of a fit with closed forms, one sentence each."""
    fit, noise = result.campaign.fit, result.campaign.noise
    lines = ["The material is incompressible; its viscoelastic parameters are fitted to ramps, holds and unloading."]
    if not fit.stated_non_law_parameter_paths:
        lines = ["The material is incompressible and elastic: only the loading is fitted, and the speed has no "
                 "influence."]
    if any(test.kind.has_closed_form_with_weight for test in result.campaign.tests):
        lines.append("Lubricated means frictionless: the faces slide freely and every slice deforms homogeneously.")
    if fit.offset == "none":
        lines.append("Contact offsets and force zeros are not fitted: the recorded values are used "
                     "(offset = \"none\").")
        if noise.contact_jitter or noise.zero_jitter:
            contact = 1e3 * (noise.contact_jitter or 0.0)
            lines.append(f"Standard errors include a jitter between recordings of {contact:g} mm "
                         f"and {noise.zero_jitter or 0:g} N.")
    else:
        lines.append(f"Each recording has a contact offset (prior 0 ± {fit.offset_prior * 1e3:g} mm, bounds "
                     f"± {fit.offset_bound * 1e3:g} mm) and a force zero, fitted together with the parameters.")
    source = {"stated": "stated in the campaign", "estimated": "estimated from second differences of the samples",
              "resolution": "the resolution of the sensor, step/√12, because most neighbouring samples are equal",
              "mixed": "of different sources for different recordings"}[result.noise_source]
    level = units.pressure.format_quantity(result.noise_Pa or 0.0, 2)
    lines.append(f"The noise of the nominal stress is {level} (standard deviation), "
                 f"{source}; AIC and BIC take it as known.")
    if fit.prior or fit.offset == "fit":
        lines.append("AIC and BIC use the penalised likelihood, which includes the distance from the priors.")
    if fit.strain_points is not None:
        lines.append(f"Each recording was interpolated to {fit.strain_points} evenly spaced strains.")
    return lines


def _list_simulation_assumptions(result: CalibrationResult, units: ReportUnits) -> list[str]:
    """Return the assumptions of an inverse fit with finite elements, one sentence each."""
    best, campaign = result.best, result.campaign
    shared = "All tests have the same material" if not best.material_of else "Each specimen has a separate material"
    lines = [f"{shared}. Each recording has a separate contact offset and force zero; both are unknown and "
             "marginalised."]
    if best.jitter is not None:
        freedom = best.jitter.freedom
        source = "stated in the campaign, or the default prior" if freedom is None else \
            f"estimated with {freedom} degrees of freedom" if freedom else \
            "assumed, because no test has two recordings"
        contact, zero = units.format_contact_and_zero_scatter(best.jitter, campaign.tests)
        lines.append(f"Between recordings the contact point scatters by {contact} and the force zero by {zero} "
                     f"(standard deviations), {source}.")
    tests = {test.name: test for test in campaign.tests}
    alike: dict[str, list[str]] = {}
    for noise in result.noise:
        colour = "white" if noise.correlation_time_s == 0 else f"correlated over {noise.correlation_time_s:.3g} s"
        deviation = units.get_load_unit(tests[noise.test]).format_quantity(noise.deviation_N, 2)
        alike.setdefault(f"{deviation} (standard deviation, {noise.source}), {colour}", []).append(f"Noise of "
                                                                                                   f"{noise.test}")
    for mesh in best.mesh:
        if mesh.largest_percent is None:
            words = (f"the simulation on the accurate mesh does not converge; the error of the fast mesh, "
                     f"{mesh.remainder_percent:.2g} % of the force, is included in the covariance")
        else:
            words = (f"the accurate mesh differs from the fast mesh by up to {mesh.largest_percent:.2g} %, and the "
                     f"difference is corrected ({format_count(mesh.refreshes, 'time')}); the remaining error of the "
                     f"accurate mesh, {mesh.remainder_percent:.2g} % of the force, is included in the covariance")
        alike.setdefault(words, []).append(f"Mesh of {mesh.test}")
    lines += [f"{', '.join(names)}: {words}." for words, names in alike.items()]
    source = {"noise": "the stated or estimated noise", "residuals": "the residuals, which exceed the noise",
              "replicates": "the scatter of the replicates"}[best.covariance_from]
    lines.append(f"Standard errors and intervals are computed from {source}; the intervals are profile-likelihood "
                 "intervals inside the bounds.")
    lines.append("Laws are ranked by the prediction error in tests that they were not fitted to, not by R².")
    return lines


def _iterate_diagnosis_assumptions(report: DiagnosisReport) -> Iterator[str]:
    """Yield the assumptions of a diagnosis, one sentence each."""
    diagnosis, before, units = report.diagnosis, report.before, report.units
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
