"""Sections with sentences: the assumptions, and the methods text of a calibration for a paper.

The methods text states data, model, identification, uncertainty and results.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version

import tissue_sim
from calibration.campaign.campaign import Campaign
from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.sample_selection import format_notes_summary_by_test_and_subject
from calibration.campaign.tables import ROUND_SOLVER
from calibration.diagnosis.diagnosis import join_as_enumeration
from calibration.fit.fit import Fit
from calibration.fit.population import describe_excluded_specimens
from calibration.fit.result import CalibrationResult, describe_aggregate_modulus, describe_self_weight
from calibration.forward.meshes import get_solver_fit_resolutions
from calibration.report.content import Block, Listing, Pasted, Span
from calibration.report.drawing import format_count
from calibration.report.figures import format_percentage_value
from calibration.report.fit_text import (
    are_laws_ranked_by_prediction,
    format_parameter_estimate,
    format_parameter_interval_without_unit,
    format_young_modulus,
)
from calibration.report.quantities import ReportUnits, format_plain_symbol, use_minus_signs
from calibration.report.section import CalibrationReport, DiagnosisReport, Section
from calibration.report.tables import iterate_population_rows
from tissue_sim.laws import find_law
from tissue_sim.specimen.specimen import add_indefinite_article


class MethodsText(Section):
    """Methods text for a paper."""

    name = "methods_text"
    title = ("Methods ", Span("for a paper; also in methods.txt", "small"))

    def iterate_blocks(self, report: CalibrationReport) -> Iterator[Block]:
        """Yield the text."""
        yield Pasted(report.methods)


#: Subject -> (citation in the text, entry in the list of references).
_REFERENCES = {
    "neo_hooke": ("Rivlin 1948a", "Rivlin RS (1948a) Large elastic deformations of isotropic materials. I. Fundamental "
                  "concepts. Phil Trans R Soc A 240:459-490"),
    "mooney_rivlin": ("Rivlin 1948b", "Rivlin RS (1948b) Large elastic deformations of isotropic materials. IV. "
                      "Further developments of the general theory. Phil Trans R Soc A 241:379-397"),
    "reduced_polynomial": ("Yeoh 1993", "Yeoh OH (1993) Some forms of the strain energy function for rubber. Rubber "
                           "Chem Technol 66:754-771"),
    "ogden": ("Ogden 1972", "Ogden RW (1972) Large deformation isotropic elasticity: on the correlation of theory and "
              "experiment for incompressible rubberlike solids. Proc R Soc Lond A 326:565-584"),
    "gent": ("Gent 1996", "Gent AN (1996) A new constitutive relation for rubber. Rubber Chem Technol 69:59-61"),
    "arruda_boyce": ("Arruda and Boyce 1993", "Arruda EM, Boyce MC (1993) A three-dimensional constitutive model for "
                     "the large stretch behavior of rubber elastic materials. J Mech Phys Solids 41:389-412"),
    "fung_demiray": ("Demiray 1972", "Demiray H (1972) A note on the elasticity of soft biological tissues. J Biomech "
                     "5:309-311"),
    "hyperfoam": ("Storåkers 1986", "Storåkers B (1986) On material representation and constitutive branching in "
                  "finite compressible elasticity. J Mech Phys Solids 34:125-145"),
    "fractional_zener": ("Mainardi 2010", "Mainardi F (2010) Fractional Calculus and Waves in Linear Viscoelasticity. "
                         "Imperial College Press, London"),
    "prony": ("Simo 1987", "Simo JC (1987) On a fully three-dimensional finite-strain viscoelastic damage model. "
              "Comput Methods Appl Mech Eng 60:153-173"),
    "descent": ("Branch et al. 1999", "Branch MA, Coleman TF, Li Y (1999) A subspace, interior, and conjugate gradient "
                "method for large-scale bound-constrained minimization problems. SIAM J Sci "
                "Comput 21:1-23"),
    "projection": ("Golub and Pereyra 1973", "Golub GH, Pereyra V (1973) The differentiation of pseudo-inverses and "
                   "nonlinear least squares problems whose variables separate. SIAM J Numer "
                   "Anal 10:413-432"),
    "profiles": ("Raue et al. 2009", "Raue A, Kreutz C, Maiwald T, et al. (2009) Structural and practical "
                 "identifiability analysis of partially observed dynamical models by exploiting "
                 "the profile likelihood. Bioinformatics 25:1923-1929"),
    "BIC": ("Schwarz 1978", "Schwarz G (1978) Estimating the dimension of a model. Ann Statist 6:461-464"),
    "holm": ("Holm 1979", "Holm S (1979) A simple sequentially rejective multiple test procedure. Scand J Statist "
             "6:65-70"),
    "population": ("Harville 1977", "Harville DA (1977) Maximum likelihood approaches to variance component estimation "
                   "and to related problems. J Am Stat Assoc 72:320-338"),
    "numpy": ("Harris et al. 2020", "Harris CR, Millman KJ, van der Walt SJ, et al. (2020) Array programming with "
              "NumPy. Nature 585:357-362"),
    "scipy": ("Virtanen et al. 2020", "Virtanen P, Gommers R, Oliphant TE, et al. (2020) SciPy 1.0: fundamental "
              "algorithms for scientific computing in Python. Nat Methods 17:261-272"),
    "taichi": ("Hu et al. 2019", "Hu Y, Li TM, Anderson L, et al. (2019) Taichi: a language for high-performance "
               "computation on spatially sparse data structures. ACM Trans Graph 38:201"),
}


def make_plain_methods_text(result: CalibrationResult, measured: Mapping[str, Sequence[MeasuredCurve]],
                            units: ReportUnits) -> str:
    """Return the methods section as plain text: data, model, method, noise, results, then the cited references.

    Args:
        result: result of the calibration, fits best first.
        measured: recordings of each test.
        units: display units.
    """
    cited: dict[str, None] = {}

    def cite(*keys: str) -> str:
        """Return the citation of some references, such as ``(Ogden 1972)``, and add them to the list of references."""
        cited.update(dict.fromkeys(keys))
        return f"({'; '.join(_REFERENCES[key][0] for key in keys)})"

    paragraphs = [_format_data_paragraph(result, measured), _format_laws_paragraph(result, cite),
                  _format_method_paragraph(result, cite), _format_noise_paragraph(result, units),
                  _format_results_paragraph(result, units, cite), _format_software_paragraph(cite)]
    references = "\n".join(f"{reference}." for reference in sorted(_REFERENCES[key][1] for key in cited))
    return "\n\n".join([*paragraphs, f"References\n{references}"]) + "\n"


def _format_data_paragraph(result: CalibrationResult, measured: Mapping[str, Sequence[MeasuredCurve]]) -> str:
    """Return the paragraph on the tests, specimens and recordings."""
    parts = []
    for test in result.campaign.tests:
        curves = measured[test.name]
        words = f"{test.name} ({test.kind.title[0].lower()}{test.kind.title[1:]}"
        if test.specimen is not None:
            words += (f", specimen of height {test.specimen.height * 1e3:.4g} mm and cross-section "
                      f"{test.specimen.area * 1e6:.4g} mm2") if test.specimen.is_prism else \
                f", {add_indefinite_article(test.specimen.shape)} ({test.specimen.in_words})"
        if test.experiment is not None and test.experiment.tool.radius is not None:
            words += f", {test.experiment.tool.shape} tool of radius {test.experiment.tool.radius * 1e3:g} mm"
        if test.max_strain is not None:
            words += f", up to a nominal strain of {test.max_strain:g}"
        parts.append(f"{words}; {format_count(len(curves), 'recording')}, {sum(c.force.size for c in curves)} points"
                     f"{'; held out of all fits' if test.hold_out else ''})")
    found = "".join(f" In {format_count(several, 'recording')} of {test} displacement and force were measured from the "
                    "contact point, which was detected as the change point of the force relative to its zero and "
                    "drift."
                    for test, several in _iterate_detected_contact_counts(result, measured))
    notes = format_notes_summary_by_test_and_subject((curve.test.name, curve.name, curve.notes)
                                                     for curves in measured.values() for curve in curves)
    return f"Data. {'; '.join(parts)}.{found}{notes}"


def _iterate_detected_contact_counts(result: CalibrationResult,
                                     measured: Mapping[str, Sequence[MeasuredCurve]]) -> Iterator[tuple[str, int]]:
    """Yield each test with the number of its recordings whose displacement starts at a detected contact."""
    for test in result.campaign.tests:
        shifted = sum(curve.whole is not None and curve.whole.shift != 0.0 for curve in measured[test.name])
        if test.contact == "find" and shifted:
            yield test.name, shifted


def _format_laws_paragraph(result: CalibrationResult, cite) -> str:
    """Return the paragraph on the fitted laws and their formulas."""
    laws = []
    for fit in sorted(result.fits, key=lambda fit: fit.law):
        key = next((key for key in _REFERENCES if fit.law.startswith(key)), None)
        laws.append(f"{find_law(fit.law).title}{f' {cite(key)}' if key else ''}, {fit.formula}")
    text = f"Material. {'; '.join(laws)}."
    names = result.best.parameters
    if any(name.startswith("viscoelastic.fractional_zener.") for name in names):
        text += (" The isochoric second Piola-Kirchhoff stress relaxes by a fractional Zener model "
                 f"{cite('fractional_zener')}, represented by a Prony series {cite('prony')}; moduli are "
                 "instantaneous.")
    elif terms := sum(name.endswith(".g") and "viscoelastic" in name for name in names):
        text += (" The isochoric second Piola-Kirchhoff stress relaxes by a Prony series of "
                 f"{format_count(terms, 'term')} {cite('prony')}; moduli are instantaneous.")
    return text


def _format_method_paragraph(result: CalibrationResult, cite) -> str:
    """Return the paragraph on the forward models, the optimisation, and the ranking of the laws."""
    if result.campaign.fit.method == "analytical":
        text = ("Identification. The closed forms of the homogeneous deformation were fitted to the nominal stress by "
                f"non-linear least squares (trust region reflective, several starts; {cite('descent')[1:-1]}). The "
                f"material is {_describe_volume_in_closed_forms(result.campaign)}.")
        offsets = result.campaign.fit.offset == "fit"
        text += " Contact offset and force zero of each recording were fitted with priors." if offsets else ""
        return f"{text} {_format_ranking_sentence(result, cite)}"
    starts = format_count(result.campaign.fit.starts, "start")
    simulated = [test.solver for test in result.campaign.tests if test.experiment is not None]
    elements = " or ".join(dict.fromkeys(get_solver_fit_resolutions(solver).elements for solver in simulated
                                         or [ROUND_SOLVER]))
    return (f"Identification. All tests were simulated with {elements} (homogeneous tests: "
            "closed forms) under the recorded motion. The parameters were estimated by generalised least squares on "
            f"the force (trust region reflective, {starts}; {cite('descent')[1:-1]}). Contact offset and force zero of "
            f"each recording and the mesh error were marginalised as nuisance parameters {cite('projection')}. "
            f"Intervals are profile-likelihood intervals {cite('profiles')}. Residuals were tested for smooth misfit "
            f"by region, with p adjusted for the number of regions {cite('holm')}. "
            f"{_format_ranking_sentence(result, cite)}")


def _format_ranking_sentence(result: CalibrationResult, cite) -> str:
    """Return the sentence that names the criterion by which the laws are ranked."""
    by = "the prediction error in tests that they were not fitted to" \
        if are_laws_ranked_by_prediction(result.fits) else f"the Bayesian information criterion {cite('BIC')}"
    return f"Laws were ranked by {by}."


def _format_noise_paragraph(result: CalibrationResult, units: ReportUnits) -> str:
    """Return the paragraph on the noise, the scatter between recordings, and the source of the standard errors."""
    tests = {test.name: test for test in result.campaign.tests}
    levels = [f"{units.get_load_unit(tests[n.test]).format_quantity(n.deviation_N, 2)} in {n.test} ({n.source}, " + (
        "white)" if n.correlation_time_s == 0 else f"correlated over {n.correlation_time_s:.2g} s)")
        for n in result.noise]
    if result.noise_Pa is not None:
        levels = [f"{units.pressure.format_quantity(result.noise_Pa, 2)} of nominal stress ({result.noise_source})"]
    jitter = result.best.jitter
    contact, zero = ("", "") if jitter is None else units.format_contact_and_zero_scatter(jitter, result.campaign.tests)
    scatter = f" Between recordings the contact point scatters by {contact} and the force zero by {zero}." \
        if contact else ""
    basis = {"noise": "this noise", "residuals": "the residuals, which exceed this noise",
             "replicates": "the scatter of the replicates"}[result.best.covariance_from]
    return (f"Uncertainty. Standard deviation of the noise: {', '.join(levels)}.{scatter} Standard errors are computed "
            f"from {basis}; numbers are given as estimate ± standard error [95 % interval], rounded by the rule of "
            "the Particle Data Group.")


def _format_results_paragraph(result: CalibrationResult, units: ReportUnits, cite) -> str:
    """Return the paragraph with the parameters of all laws, their populations, and the predictions of the best law."""
    sentences = []
    for fit in result.fits:
        unusable = f" Not usable: {fit.unusable}." if fit.unusable else ""
        sentences.append(f"{find_law(fit.law).title}: {', '.join(_iterate_parameter_estimate_texts(fit, units))}; E0 = "
                         f"{use_minus_signs(format_young_modulus(fit, units))}; R2 = {fit.R2:.4f}, "
                         f"residuals {fit.noise_ratio:.2g} times the noise.{unusable}")
        if fit.population is not None:
            several = ", ".join(use_minus_signs(
                f"{format_plain_symbol(each.symbol)} = {each.mean} [{each.mean_interval}], standard deviation between "
                f"specimens {each.spread} [{each.spread_interval}]")
                for each in iterate_population_rows(fit, fit.population, units))
            left_out = "" if not fit.left_out_specimens else \
                f"; not included: {describe_excluded_specimens(fit.left_out_specimens)}"
            sentences.append(f"Population of {len(fit.population.specimens)} specimens (restricted maximum "
                             f"likelihood {cite('population')}): {several}{left_out}.")
    for p in result.predictions:
        if p.law == result.best.law and p.percent is not None:
            of_mean = f" from the mean of {format_count(len(p.mean_of), 'other specimen')}" if p.mean_of else ""
            sentences.append(f"{find_law(p.law).title} predicts {p.test}, to which it was not fitted,{of_mean} with an "
                             f"error of {format_percentage_value(p.percent)} of the largest load (root mean square).")
    return f"Results. {' '.join(sentences)}"


def _iterate_parameter_estimate_texts(fit: Fit, units: ReportUnits) -> Iterator[str]:
    """Yield for each parameter its symbol, estimate and 95 % interval as text."""
    for name in fit.parameters:
        interval = format_parameter_interval_without_unit(fit, name, units)
        estimate = format_parameter_estimate(fit, name, units)
        yield use_minus_signs(f"{format_plain_symbol(fit.symbols[name])} = {estimate}"
                              f"{f' [{interval}]' if interval else ''}")


def _format_software_paragraph(cite) -> str:
    """Return the paragraph on the software, with versions and references."""
    used = []
    for package in ("taichi", "numpy", "scipy"):
        try:
            used.append(f"{package} {version(package)} {cite(package)}")
        except PackageNotFoundError:
            continue
    return f"Software. tissue_sim {tissue_sim.__version__}, {', '.join(used)}."


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
    return [*lines, *describe_aggregate_modulus(campaign, result.best), describe_self_weight(campaign, result.best)]


def _describe_volume_in_closed_forms(campaign: Campaign) -> str:
    """Return the assumption of closed forms on the change of volume: "incompressible", or the tests and laws without.

    A compressible law states the volumetric response itself; the other laws have one in confined compression only.
    """
    confined = [test.kind.has_lateral_wall for test in campaign.tests]
    volume = ("compressible" if all(confined) else
              "compressible in confined compression and incompressible in the other tests" if any(confined) else
              "incompressible")
    compressible = [name for name in campaign.fit.laws if find_law(name).is_compressible]
    if not compressible or volume == "compressible":
        return volume
    own = f"compressible with the volumetric response of {join_as_enumeration(compressible)}"
    return own if len(compressible) == len(campaign.fit.laws) else f"{own}, and with the other laws {volume}"


def _list_analytical_assumptions(result: CalibrationResult, units: ReportUnits) -> list[str]:
    """Return the assumptions of a fit with closed forms, one sentence each."""
    fit, noise = result.campaign.fit, result.campaign.noise
    volume = _describe_volume_in_closed_forms(result.campaign)
    lines = [f"The material is {volume}. Its viscoelastic parameters are fitted to ramps, holds and unloading."]
    if all(path.startswith("bulk.") for path in fit.stated_non_law_parameter_paths):
        lines = [f"The material is {volume}. It is elastic: only the loading is fitted, and the speed has no "
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
