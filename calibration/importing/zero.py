"""Explain a load at zero displacement: the displacement was zeroed at a preload, or the load cell was not zeroed.

Each explanation has one unknown: the distance between contact and zero displacement, or the reading of the unloaded
load cell. Laws that are linear in their parameters are fitted with each explanation by linear least squares. The
explanation with the smaller Bayesian information criterion is used if the difference exceeds
`LoadAtZeroExplanationSettings.decisive_difference` and the residuals are comparable to the noise. Otherwise, the
explanation is a question to the user. A force against the direction of loading can be a preload only if the specimen is
gripped or glued.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.importing.imported import LoadAtZeroInterpretation, ReplicateFile
from calibration.importing.motion import RecordedMotion
from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import KINDS, TestKind
from tissue_sim.laws import LAWS, find_law
from tissue_sim.recording.formats.assumption import AlternativeValue, Assumption
from tissue_sim.recording.recording import Recording
from tissue_sim.recording.screening import LoadAtZeroAndContactShift, estimate_load_at_zero_displacement
from tissue_sim.recording.segments import get_positive_motion_load_and_units
from tissue_sim.settings import make_shallow_read_only_copy
from tissue_sim.units import find_quantity_of_unit_or_none, get_si_factor_and_offset


@dataclass(frozen=True)
class LoadAtZeroExplanationSettings:
    """Limits for the choice between the two explanations of a load at zero displacement.

    Attributes:
        decisive_difference: difference of the Bayesian information criteria above which no question is asked (10: very
            strong evidence, Kass and Raftery 1995). A larger value asks more questions.
        largest_residual: largest root mean square residual of a law that describes the curve, in standard deviations
            of the noise. A smaller value asks more questions.
        largest_scatter: largest scatter of the load at zero displacement between replicates with one common offset,
            relative to the mean load. A larger value assigns a common offset to more replicates.
        unloaded: largest reading of an unloaded and zeroed load cell, as a fraction of the load at zero displacement.
            A larger value asks more questions.
    """

    decisive_difference: float = 10.0
    largest_residual: float = 2.0
    largest_scatter: float = 0.1
    unloaded: float = 0.02


#: Settings that the functions of this module use.
_SETTINGS = LoadAtZeroExplanationSettings()
#: Trial values of the shift of contact, relative to the first estimate.
_SHIFTS = np.linspace(0.0, 3.0, 121)
#: Explanation: the displacement was zeroed at a preload.
PRELOAD = "preload"
#: Explanation: the load cell was not zeroed.
SENSOR = "sensor"
#: Explanation -> sentence for the user.
_EXPLANATIONS = {PRELOAD: "the displacement was zeroed at a preload, and contact is at a negative displacement",
                 SENSOR: "the load cell was not zeroed, and contact is at zero displacement"}
#: Sentence of `PRELOAD` if the force at zero displacement is against the direction of loading.
_PRELOAD_AGAINST_LOADING = ("the specimen was strained against the direction of loading, and the force is zero at a "
                            "positive displacement")


@dataclass(frozen=True)
class _ExplanationFit:
    """Fit of one explanation of the load at zero displacement (preload, or load cell not zeroed) to a first loading.

    Attributes:
        criterion: Bayesian information criterion.
        residual: root mean square residual, N.
        modulus: initial shear modulus, Pa.
        shift: distance between contact and zero displacement, m.
    """

    criterion: float
    residual: float
    modulus: float
    shift: float


def interpret_and_correct_load_at_zero(parts: Sequence[ReplicateFile], sizes: Mapping[str, float],
                                       laws: Sequence[str], stated: str | None
                                       ) -> tuple[tuple[ReplicateFile, ...], LoadAtZeroInterpretation | None]:
    """Return the replicates of a test with the assumption about their load at zero displacement; also interpret it.

    If the load cell was not zeroed, its offset is also subtracted from the recorded forces.

    Args:
        parts: replicates of the test.
        sizes: known sizes of the specimen: ``height_mm`` and ``radius_mm`` or ``area_mm2``.
        laws: names of the laws that will be fitted.
        stated: `PRELOAD` or `SENSOR` as the user states; None: the explanation is found from the curve.

    Returns:
        Replicates with the assumption, and the interpretation of the load; None: the load is zero at zero displacement.
    """
    reading = parts[0].reading
    kind = KINDS[reading.kind.kind] if reading.kind.kind else None
    found = [(curve, start) for part in parts for recording, motion in zip(part.reading.recordings, part.motions,
                                                                           strict=True)
             if (curve := _get_first_loading_curve_or_none(recording, motion, kind)) is not None
             and (start := estimate_load_at_zero_displacement(*curve)) is not None]
    if not found or any(column.missing_information_text_or_none for column in reading.columns):
        return tuple(parts), None
    shift, load = (float(np.mean([getattr(start, name) for _, start in found])) for name in ("shift", "load"))
    explanations = [_find_best_fits_and_noise_or_none(curve, start, kind, sizes, laws) for curve, start in found]
    jump = _describe_load_jump_or_none(parts, load)
    assumption, value, best = _choose_load_at_zero_explanation([each for each in explanations if each], found[0][1],
                                                               kind, stated, jump)
    zero = LoadAtZeroInterpretation(value, best or shift, load)
    loads = [start.load for _, start in found]
    has_common_offset = bool(np.ptp(loads) <= _SETTINGS.largest_scatter * abs(load))
    return tuple(_apply_load_at_zero_interpretation(part, assumption, zero, is_constant=has_common_offset)
                 for part in parts), zero


def _get_first_loading_curve_or_none(recording: Recording, motion: RecordedMotion, kind: TestKind | None
                                     ) -> tuple[np.ndarray, np.ndarray] | None:
    """Return displacement (m) and force (N) of the first loading, both positive under load, shapes (n,).

    Returns:
        The two arrays; None for a recording without displacement and force, with motion in air before contact, or of an
        oscillation.
    """
    if motion.channel != "displacement" or "force" not in recording or motion.found.has_air:
        return None
    if motion.screening.control is not None and motion.screening.control.pattern == "oscillation":
        return None
    kept = recording if motion.kept is None else recording.select(motion.kept)
    displacement, load, _ = get_positive_motion_load_and_units(kept, kind)
    end = int(np.argmax(displacement)) + 1
    if motion.failure is not None:
        end = min(end, motion.failure.index + 1)
    return displacement[:end], load[:end]


def _describe_load_jump_or_none(parts: Sequence[ReplicateFile], load: float) -> str | None:
    """Return a sentence with the evidence that the load rises from zero within one sample; None without evidence.

    A first sample that was left out and reads zero load may be right. Then the load cell was zeroed, the specimen was
    unloaded, and the load jumps, as in a peel test or where static friction holds. No elastic law describes a jump.

    Args:
        parts: replicates of one test.
        load: load at zero displacement, extrapolated from the samples that are kept, N.
    """
    for part in parts:
        for recording, motion in zip(part.reading.recordings, part.motions, strict=True):
            is_left_out = any(1 in each.samples and each.channel == "force" for each in motion.screening.left_out)
            if is_left_out and abs(recording.force[0]) <= _SETTINGS.unloaded * abs(load):
                return (f"sample 1, which is left out, reads {recording.force[0]:.3g} N: if it is right, the load cell "
                        "was zeroed and the force jumps, which no elastic law describes. Check the kind of test")
    return None


def _find_best_fits_and_noise_or_none(curve: tuple[np.ndarray, np.ndarray], start: LoadAtZeroAndContactShift,
                                      kind: TestKind | None,
                                      sizes: Mapping[str, float],
                                      laws: Sequence[str]) -> tuple[dict[str, _ExplanationFit], float] | None:
    """Fit all laws with each explanation to the first loading of one recording; return the best fit for each.

    Args:
        curve: displacement, m, and force, N, of the first loading, each of shape (n,).
        start: estimated load at zero displacement.
        kind: kind of test; None: unknown.
        sizes: known sizes of the specimen by key, in the units of the keys.
        laws: names of laws that are linear in their parameters.

    Returns:
        (`PRELOAD` or `SENSOR` -> fit with the smallest criterion, standard deviation of the noise of the force, N);
        None: a size or the closed form is unknown, so that the force gives no stress, or no fit has a positive modulus.
    """
    area = sizes.get("area_mm2", np.pi * sizes["radius_mm"]**2 if "radius_mm" in sizes else None)
    if kind is None or kind.closed_form is None or area is None or "height_mm" not in sizes:
        return None
    displacement, load = curve
    height, area = 1e-3 * sizes["height_mm"], 1e-6 * area
    midpoint_deviation = (load[1:-1] - 0.5 * (load[:-2] + load[2:])) / np.sqrt(1.5)
    noise = float(np.median(np.abs(midpoint_deviation))) / 0.6745
    best: dict[str, _ExplanationFit] = {}
    for name in laws:
        for value in (PRELOAD, SENSOR):
            found = _fit_explanation_or_none(value, displacement, load, start.shift, height, area, kind, name)
            if found is not None and (value not in best or found.criterion < best[value].criterion):
                best[value] = found
    return (best, noise) if len(best) == len(_EXPLANATIONS) else None


def _fit_explanation_or_none(value: str, displacement: np.ndarray, load: np.ndarray, shift: float, height: float,
                             area: float, kind: TestKind, name: str) -> _ExplanationFit | None:
    """Fit one law with one explanation by linear least squares.

    Args:
        value: `PRELOAD` or `SENSOR`.
        displacement: displacement, m, shape (n,).
        load: force, N, shape (n,).
        shift: first estimate of the distance between contact and zero displacement, m.
        height: height of the specimen, m.
        area: cross-section of the specimen, m2.
        kind: kind of test.
        name: name of a law that is linear in its parameters.

    Returns:
        None: the modulus is not positive, the trial shifts compress the specimen to zero height, or the law alone does
            not determine the stress.
    """
    law, form = find_law(name), kind.require_closed_form()
    if form.needs_bulk:
        return None
    ones = np.ones(len(law.parameters))

    def get_squares_and_coefficients_at_shift(trial_shift: float) -> tuple[float, np.ndarray]:
        """Return the sum of squared residuals, N2, and the fitted coefficients for a shift of contact, m."""
        strain = kind.convert_nominal_strain_to_stretch_or_shear_strain((displacement + trial_shift) / height)
        design = kind.sign * area * form.stress_parameter_derivatives(law, strain, ones)
        if value == SENSOR:
            design = np.column_stack([design, np.ones(displacement.size)])
        coefficients = np.linalg.lstsq(design, load, rcond=None)[0]
        return float(np.sum((load - design @ coefficients)**2)), coefficients

    if displacement[-1] + _SHIFTS[-1] * shift >= height and not kind.has_gripped_ends:
        return None
    trial_shift = 0.0 if value == SENSOR \
        else float(min(_SHIFTS * shift, key=lambda each: get_squares_and_coefficients_at_shift(each)[0]))
    squares, coefficients = get_squares_and_coefficients_at_shift(trial_shift)
    values = coefficients[:ones.size]
    modulus = law.mu0(values)
    if modulus <= 0:
        return None
    count = displacement.size
    criterion = count * np.log(max(squares / count, 1e-300)) + (ones.size + 1) * np.log(count)
    return _ExplanationFit(float(criterion), float(np.sqrt(squares / count)), modulus, trial_shift)


def select_laws_linear_in_parameters_or_neo_hooke(names: Sequence[str]) -> tuple[str, ...]:
    """Return those of the given laws whose stress is linear in the parameters; ``("neo_hooke",)`` if there is none."""
    strain = np.array([0.9, 0.95])

    def is_linear_in_parameters(name: str) -> bool:
        """Return whether the derivatives of the stress with respect to the parameters are constant."""
        law = find_law(name)
        one, two = (law.nominal_stress_parameter_derivatives(strain, np.full(len(law.parameters), value))
                    for value in (1.0, 2.0))
        return bool(np.allclose(one, two))

    return tuple(name for name in names if name in LAWS and is_linear_in_parameters(name)) or ("neo_hooke",)


def _choose_load_at_zero_explanation(explanations: Sequence[tuple[dict[str, _ExplanationFit], float]],
                                     start: LoadAtZeroAndContactShift,
                                     kind: TestKind | None, stated: str | None, jump: str | None
                                     ) -> tuple[Assumption, str, float | None]:
    """Return the assumption about the load at zero displacement that fits all replicates of a test better.

    If the curves do not decide, the assumption is a question: it states the other explanation as an alternative.

    Args:
        explanations: explanations and noise of each replicate.
        start: load at zero of the first replicate.
        kind: kind of test.
        stated: value that the user states.
        jump: evidence of a jump of the load; with a jump the curve does not decide.

    Returns:
        Assumption, its value (`PRELOAD` or `SENSOR`), and fitted shift of contact, m; None: no fit.
    """
    if start.load < 0 and kind is not None and not kind.allows_reversed_load:
        return _make_unzeroed_load_cell_assumption(start, stated), SENSOR, None
    words = {**_EXPLANATIONS, PRELOAD: _PRELOAD_AGAINST_LOADING} if start.load < 0 else _EXPLANATIONS
    evidence = [f"the force at zero displacement is {start.load:.3g} N, {100 * start.fraction:.0f} % of its range"]
    against = [jump] if jump else []
    value, ratio, shift = stated or PRELOAD, None, None
    decided = False
    if explanations:
        criteria = {each: sum(found[each].criterion for found, _ in explanations) for each in _EXPLANATIONS}
        better = min(criteria, key=lambda each: criteria[each])
        value = stated or better
        other = SENSOR if value == PRELOAD else PRELOAD
        ratio = float(np.mean([found[other].modulus / found[value].modulus for found, _ in explanations]))
        shift = float(np.mean([found[PRELOAD].shift for found, _ in explanations]))
        describes = all(found[better].residual <= _SETTINGS.largest_residual * noise for found, noise in explanations)
        difference = max(criteria.values()) - min(criteria.values())
        decided = jump is None and describes and difference > _SETTINGS.decisive_difference
        residuals = {each: np.mean([found[each].residual for found, _ in explanations]) for each in _EXPLANATIONS}
        comparison = f"residuals of {residuals[value]:.2g} N, with the other explanation {residuals[other]:.2g} N"
        (evidence if criteria[value] <= criteria[other] else against).append(comparison)
    other = SENSOR if value == PRELOAD else PRELOAD
    alternatives = () if decided else (AlternativeValue(words[other], ratio, f"--zero {other}"),)
    assumption = Assumption("zero of displacement and force", words[value], tuple(evidence), tuple(against),
                            alternatives, f"--zero {value}", stated is not None)
    return assumption, value, shift


def _make_unzeroed_load_cell_assumption(start: LoadAtZeroAndContactShift, stated: str | None) -> Assumption:
    """Return the assumption that the load cell was not zeroed, for a tensile force of a tool without adhesion.

    Raises:
        InputError: the user stated a preload.
    """
    if stated == PRELOAD:
        raise InputError(f"--zero must be {SENSOR}; got {PRELOAD}. The force at zero displacement is {start.load:.3g} "
                         "N, against the direction of loading, but a preload has the direction of loading.",
                         field="zero")
    evidence = (f"the force at zero displacement is {start.load:.3g} N, {100 * start.fraction:.0f} % of its range",
                "a tool without adhesion cannot pull the specimen")
    return Assumption("zero of displacement and force", _EXPLANATIONS[SENSOR], evidence, (), (), f"--zero {SENSOR}",
                      stated is not None)


def _apply_load_at_zero_interpretation(part: ReplicateFile, assumption: Assumption, zero: LoadAtZeroInterpretation, *,
                                       is_constant: bool) -> ReplicateFile:
    """Return a copy of a file's replicates with the assumption and a warning.

    If the load cell was not zeroed, its offset is subtracted from the forces and stated in the column of the force.

    Args:
        part: replicates of a test in one file.
        assumption: assumption about the load at zero displacement.
        zero: interpretation of the load.
        is_constant: whether one offset applies to all replicates; otherwise, the force of each starts at zero.
    """
    note = f"{assumption.evidence[0]}: {assumption.value}"
    motions = tuple(replace(motion, assumptions=(*motion.assumptions, assumption), warnings=(*motion.warnings, note))
                    for motion in part.motions)
    reading = part.reading
    if zero.value == SENSOR:
        reading = replace(reading, columns=tuple(
            replace(column, offset=_convert_to_offset_of_column(column.unit, zero.load) if is_constant else "start",
                    reason=f"{column.reason}; {_EXPLANATIONS[SENSOR]}")
            if column.channel == "force" and column.offset is None else column for column in reading.columns))
        recordings = tuple(each.with_channels(force=each.force - zero.load) for each in reading.recordings)
        reading = replace(reading, recordings=recordings, options=make_shallow_read_only_copy(
            {**reading.options, "columns": {column.channel: column.to_campaign_entry() for column in reading.columns}}))
    return replace(part, reading=reading, motions=motions)


def _convert_to_offset_of_column(unit: str | None, load: float) -> float:
    """Return the offset of the force column, which is minus `load` (N), in the unit of the column, with four digits."""
    factor = 1.0 if unit is None or find_quantity_of_unit_or_none(unit) == "signal" \
        else get_si_factor_and_offset(unit)[0]
    return float(f"{-load / factor:.4g}")
