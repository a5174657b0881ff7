"""Result of a calibration, its JSON and material files, and its statements on methods and on self-weight.

The estimates of different methods from the same recordings are compared. The sag of the specimens under self-weight
decides whether the calibration must account for gravity. A material file contains parameters, uncertainty, valid range
and provenance of a fitted law.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from calibration.campaign.campaign import Campaign
from calibration.campaign.measured import MeasuredCurve
from calibration.campaign.parameter_space import ParameterSpace
from calibration.fit.fit import Fit, Prediction, SensorNoiseRecord, get_shared_and_population_mean_material
from tissue_sim.closed_form.column import Column
from tissue_sim.errors import InputError
from tissue_sim.laws import find_law
from tissue_sim.material.file import MaterialFile, write_material_file
from tissue_sim.material.material import make_material_from_numbers
from tissue_sim.public_names import make_getattr_for_old_names
from tissue_sim.specimen import STANDARD_GRAVITY, Specimen

#: Campaign with its fits.
Fits = tuple[Campaign, Sequence[Fit]]


def compare_method_intervals_in_sentences(results: Sequence[Fits]) -> list[str]:
    """Compare campaigns of different methods that were fitted to the same recordings.

    Args:
        results: campaigns with their fits.

    Returns:
        For each law a sentence: the parameters whose 95 % intervals do not overlap, with possible reasons, or the
        statement that all intervals overlap.
    """
    return [sentence for one, other in combinations(results, 2)
            if one[0].fit.method != other[0].fit.method
            and _collect_fitted_recording_paths(one) == _collect_fitted_recording_paths(other)
            for sentence in _iterate_law_comparison_sentences(one, other)]


def _collect_fitted_recording_paths(fits: Fits) -> frozenset:
    """Return the paths of all fitted recordings."""
    return frozenset(path.resolve() for test in fits[0].tests if not test.hold_out for path in test.recordings)


def _iterate_law_comparison_sentences(one: Fits, other: Fits) -> Iterator[str]:
    """Yield a sentence for each law that both campaigns fit."""
    by_law = {fit.law: fit for fit in other[1]}
    for mine in one[1]:
        if mine.law not in by_law:
            continue
        fit, apart, compared = by_law[mine.law], [], 0
        for name in (name for name in mine.parameters if name in fit.parameters):
            left, right = mine.intervals95.get(name), fit.intervals95.get(name)
            if left is None or right is None or left[0] == left[1] or right[0] == right[1]:
                continue
            compared += 1
            if left[1] < right[0] or right[1] < left[0]:
                apart.append(f"{mine.symbols[name]} {_format_interval(mine, name)} and {_format_interval(fit, name)}")
        names = f"{mine.law}: {_format_campaign_and_method(one[0])} and {_format_campaign_and_method(other[0])}"
        if apart:
            why = _explain_interval_disagreement(mine, fit, one[0], other[0])
            yield f"{names} have 95 % intervals that do not overlap: {'; '.join(apart)}. {why}"
        elif compared:
            yield f"{names} agree within their 95 % intervals."


def _format_campaign_and_method(campaign: Campaign) -> str:
    """Return name and method of a campaign, such as ``study (inverse FEM)``."""
    return f"{campaign.name} ({campaign.fit.method.replace('_fem', ' FEM')})"


def _format_interval(fit: Fit, name: str) -> str:
    """Return the 95 % interval of a parameter with its unit, such as ``1390 to 1420 Pa``."""
    low, high = fit.intervals95[name] or (float("nan"), float("nan"))
    return f"{low:.4g} to {high:.4g} {fit.get_unit_or_empty_if_dimensionless(name)}".rstrip()


def _explain_interval_disagreement(mine: Fit, fit: Fit, one: Campaign, other: Campaign) -> str:
    """Describe the different assumptions of two methods, the most likely reason of a disagreement first."""
    reasons = []
    inverse, plain = (mine, fit) if one.fit.method == "inverse_fem" else (fit, mine)
    closed = one if plain is mine else other
    if inverse.jitter is not None and closed.fit.offset == "none":
        contact, zero = inverse.jitter.contact_and_zero_jitter_texts
        reasons.append(f"the inverse method assumes a contact offset ({contact}) and a zero ({zero}) of each "
                       'recording, and the analytical one uses the recorded values unless offset = "fit"')
    if max(mine.noise_ratio, fit.noise_ratio) > 1.5:
        reasons.append(f"the residuals are {max(mine.noise_ratio, fit.noise_ratio):.2g} times the noise, so the "
                       "intervals do not include the error of the law, which the methods weight differently")
    if plain.covariance_from == "noise" or inverse.covariance_from == "noise":
        reasons.append("intervals from the noise alone do not include the scatter between recordings")
    return f"Why: {'; '.join(reasons)}." if reasons else "Compare their windows, contacts and bulk response."


#: Density of water, kg/m3, assumed for the sag of a specimen of unknown density.
WATER_DENSITY = 1000.0


def compute_specimen_sags_mm(fit: Fit, campaign: Campaign) -> dict[str, float]:
    """Return specimen with self-weight -> its sag with the fitted law, mm.

    Specimens without equilibrium under their weight are omitted.
    """
    found = {specimen.name: _compute_sag_or_none_without_equilibrium(specimen, fit, campaign)
             for specimen in _list_specimens_in_frictionless_compression(campaign) if specimen.specific_weight}
    return {name: 1e3 * sag for name, sag in found.items() if sag is not None}


def describe_self_weight(campaign: Campaign, fit: Fit) -> str:
    """Describe the assumptions of a campaign about gravity, with the sag of compressed columns for a fit."""
    alike: dict[str, dict[str, float | None]] = {}
    columns = _list_specimens_in_frictionless_compression(campaign)
    for specimen in dict.fromkeys([*columns, *(test.specimen for test in campaign.tests if test.specimen is not None
                                               and test.specimen.specific_weight)]):
        words, sag = _make_self_weight_sentence_and_sag_mm(specimen, fit, campaign, column=specimen in columns)
        alike.setdefault(words, {})[specimen.name] = sag
    several = sum(map(len, alike.values())) > 1
    sentences = [f"Self-weight{' of ' if several else ''}{', '.join(found) if several else ''}"
                 f"{words.format(*(_format_sag_range(found.values(), digits) for digits in (2, 3)))}"
                 for words, found in alike.items()]
    return " ".join(sentences) or "Self-weight is not included."


def compute_aggregate_modulus_or_none(campaign: Campaign, fit: Fit) -> float | None:
    """Return K + 4/3 mu0 of the law's parameters, Pa; None without a test in confined compression."""
    if not any(test.kind.has_lateral_wall for test in campaign.tests):
        return None
    numbers = get_shared_and_population_mean_material(fit).parameters
    law = find_law(fit.law)
    others = {path: value for path, value in numbers.items() if path.startswith("bulk.")}
    material = make_material_from_numbers(fit.law, {path: numbers[path] for path in law.parameters}, others,
                                          campaign.fit.bulk)
    return material.bulk_modulus + 4.0 / 3.0 * material.mu0


def describe_aggregate_modulus(campaign: Campaign, fit: Fit) -> Iterator[str]:
    """Yield a sentence about the aggregate modulus if the campaign has a test in confined compression."""
    modulus = compute_aggregate_modulus_or_none(campaign, fit)
    if modulus is None:
        return
    alone = all(test.kind.has_lateral_wall for test in campaign.tests)
    yield (f"Aggregate modulus K + 4/3 mu0: {1e-3 * modulus:.4g} kPa." + (
        " Confined compression determines this sum; mu0 follows from the stated bulk response." if alone else ""))


def _make_self_weight_sentence_and_sag_mm(specimen: Specimen, fit: Fit, campaign: Campaign, *,
                                          column: bool) -> tuple[str, float | None]:
    """Return the sentence after "Self-weight of NAME", with placeholders for the sag in two or three digits.

    Args:
        specimen: specimen.
        fit: fit.
        campaign: campaign.
        column: whether plates compress the specimen between frictionless faces, so that its sag has a closed form.

    Returns:
        Sentence, and the sag, mm; None: unknown.
    """
    height = f"{specimen.height * 1e3:.4g} mm as {specimen.height_is}"
    if specimen.specific_weight:
        sag = fit.sag_mm.get(specimen.name)
        # Other boundary conditions have no closed form of the sag.
        settled = ", sag {1} mm" if sag is not None else f", which {fit.law} does not carry" if column else ""
        return (f": {specimen.density:g} kg/m3 at {specimen.gravity:g} m/s2, settled before the "
                f"test; height {height}{settled}."), sag
    density = specimen.density or WATER_DENSITY
    sag = _compute_sag_or_none_without_equilibrium(replace(specimen, density=density, gravity=STANDARD_GRAVITY), fit,
                                                   campaign)
    of_water = "" if specimen.density else " (water)"
    would = "" if sag is None else f"; standing at {density:g} kg/m3{of_water} it would sag {{0}} mm"
    return (f" is not included: the height, {height}, is taken for the undeformed one{would}.",
            None if sag is None else 1e3 * sag)


def _format_sag_range(sags: Collection[float | None], digits: int) -> str:
    """Format the sags of several specimens, such as ``2.8`` or ``2.5 to 3.1``."""
    known = sorted(sag for sag in sags if sag is not None)
    return " to ".join(dict.fromkeys(f"{sag:.{digits}g}" for sag in known[:1] + known[-1:]))


def _list_specimens_in_frictionless_compression(campaign: Campaign) -> list[Specimen]:
    """Return the specimens that a plate compresses between frictionless faces, without repetition."""
    return list(dict.fromkeys(test.specimen for test in campaign.tests
                              if test.kind.has_closed_form_with_weight and test.specimen is not None
                              and test.specimen.is_prism))


def _compute_sag_or_none_without_equilibrium(specimen: Specimen, fit: Fit, campaign: Campaign) -> float | None:
    """Return the sag of a specimen, m; None without equilibrium or with unknown parameters."""
    law, material = find_law(fit.law), get_shared_and_population_mean_material(fit)
    values = {path: _find_specimen_law_parameter_or_typical(path, specimen, fit, campaign,
                                                            material.parameters.get(path))
              for path in law.parameters}
    try:
        if None in values.values():
            return None
        return Column(specimen).settle(law, law.convert_parameters_to_array(values)).sag
    except InputError:
        return None


def _find_specimen_law_parameter_or_typical(path: str, specimen: Specimen, fit: Fit, campaign: Campaign,
                                            typical: float | None) -> float | None:
    """Return a parameter of the law for a specimen: its own, that of its first test or recording, or the shared one."""
    tests = [test.name for test in campaign.tests if test.specimen is not None and test.specimen.name == specimen.name]
    for mark in (specimen.name, *tests):
        if f"{path}@{mark}" in fit.parameters:
            return fit.parameters[f"{path}@{mark}"]
    return next((value for name, value in fit.parameters.items()
                 if any(name.startswith(f"{path}@{test}/") for test in tests)), typical)


__getattr__ = make_getattr_for_old_names(__name__, {"to_json": "to_json_dictionary"})


@dataclass(frozen=True)
class CalibrationResult:
    """Result of the calibration of one campaign.

    Attributes:
        campaign: campaign.
        fits: fits of all laws, best first: usable fits before others, then by prediction error, or by BIC without
            predictions.
        predictions: for each law predictions of the held-out tests and of each test by a fit to the others.
        message: explanation of the ranking.
        output: output folder.
        digest: hash of all inputs of the result.
        noise_Pa: pooled noise of the nominal stress, Pa; None for an inverse fit.
        noise_source: ``"stated"``, ``"estimated"``, ``"resolution"`` (of the sensor) or ``"mixed"``.
        noise: noise of each test of an inverse fit.
        failures: law -> reason why it has no fit.
        usability_settings: name -> value of the limits of the usability rule that differ from the defaults.
        resumed: whether the result was read from an earlier run.
    """

    campaign: Campaign
    fits: tuple[Fit, ...]
    predictions: tuple[Prediction, ...]
    message: str
    output: Path
    digest: str
    noise_Pa: float | None = None
    noise_source: str = "stated"
    noise: tuple[SensorNoiseRecord, ...] = ()
    failures: Mapping[str, str] = field(default_factory=dict)
    usability_settings: Mapping[str, float] = field(default_factory=dict)
    resumed: bool = False

    @property
    def best(self) -> Fit:
        """First fit of the ranking; this fit may be unusable if no law is usable."""
        return self.fits[0]


def list_method_agreement_sentences(results: Sequence[CalibrationResult]) -> list[str]:
    """Return a sentence for each law on the agreement of the methods that were fitted to the same recordings."""
    return compare_method_intervals_in_sentences([(result.campaign, result.fits) for result in results])


def to_json_dictionary(results: Sequence[CalibrationResult]) -> dict[str, Any]:
    """Return the JSON object of ``calibrate --json`` and ``fit.json``.

    Several campaigns are a list under the key ``campaigns``. ``output`` is the output folder as given by the caller.
    Each ``material_file`` is relative to it, so that ``fit.json`` remains valid if the folder moves.
    """
    if len(results) != 1:
        return {"campaigns": [to_json_dictionary([result]) for result in results],
                "agreement": list_method_agreement_sentences(results)}
    result = results[0]
    return {
        "campaign": result.campaign.name, "method": result.campaign.fit.method,
        "fits": list(msgspec.to_builtins(result.fits)), "best": result.best.law, "failures": dict(result.failures),
        "predictions": list(msgspec.to_builtins(result.predictions)), "noise_Pa": result.noise_Pa,
        "noise_source": result.noise_source, "noise": list(msgspec.to_builtins(result.noise)),
        "message": result.message, "self_weight": describe_self_weight(result.campaign, result.best),
        "aggregate_modulus_Pa": compute_aggregate_modulus_or_none(result.campaign, result.best),
        "usability_settings": dict(result.usability_settings),
        "output": str(result.output), "work": result.digest,
    }


def decode_calibration_result(found: Mapping[str, Any], campaign: Campaign, folder: Path) -> CalibrationResult:
    """Return the result of an earlier run from the content of ``fit.json``.

    Args:
        found: content of the file.
        campaign: campaign.
        folder: output folder.

    Raises:
        KeyError, TypeError, msgspec.ValidationError: the content is incomplete or invalid.
    """
    return CalibrationResult(
        campaign, msgspec.convert(tuple(found["fits"]), tuple[Fit, ...]),
        msgspec.convert(tuple(found["predictions"]), tuple[Prediction, ...]), found["message"], folder, found["work"],
        found["noise_Pa"], found["noise_source"],
        msgspec.convert(tuple(found["noise"]), tuple[SensorNoiseRecord, ...]),
        msgspec.convert(found.get("failures", {}), dict[str, str]),
        msgspec.convert(found.get("usability_settings", {}), dict[str, int | float]), resumed=True)


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
