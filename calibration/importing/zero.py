"""Decide what a load at zero displacement means: a preload, or a load cell that was not zeroed.

Both explanations have one unknown: the distance between contact and the zero of the displacement, or the load of the
unloaded cell. Laws that are linear in their parameters are fitted with each. The explanation with the smaller residuals
is taken if the difference is beyond chance and the residuals are those of the noise; else the user decides.
A force against the direction of loading is a preload only where the specimen is gripped or glued, and may be shortened.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.importing.imported import Part, Zero
from calibration.importing.motion import Motion
from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import KINDS, TestKind
from tissue_sim.frozen_mapping import read_only
from tissue_sim.laws import LAWS, find_law
from tissue_sim.recording.formats.assumption import Alternative, Assumption
from tissue_sim.recording.preload import LoadAtZero, load_at_zero
from tissue_sim.recording.recording import Recording
from tissue_sim.recording.segments import loading_of
from tissue_sim.units import quantity_of, to_si


@dataclass(frozen=True)
class ZeroSettings:
    """Settings of `with_zero`.

    Attributes:
        decides: difference of the Bayesian information criterion above which the curve decides.
        describes: largest residual of a law that describes the curve, in standard deviations of the noise.
        alike: largest relative scatter of the load at zero between replicates with one common offset.
        unloaded: largest reading of an unloaded and zeroed load cell, as a fraction of the load at zero displacement.
    """

    decides: float = 10.0
    describes: float = 2.0
    alike: float = 0.1
    unloaded: float = 0.02


#: Settings that the functions of this module use.
_SETTINGS = ZeroSettings()
#: Trial shifts of contact, relative to the first estimate of the shift.
_SHIFTS = np.linspace(0.0, 3.0, 121)
PRELOAD = "preload"
SENSOR = "sensor"
_WORDS = {PRELOAD: "the displacement was zeroed at a preload, and contact was before it",
          SENSOR: "the load cell was not zeroed, and contact is at zero displacement"}
#: Words of `PRELOAD` where the force at zero displacement is against the direction of loading.
_AGAINST = "the specimen was strained against the direction of loading, and its force is zero after zero displacement"


@dataclass(frozen=True)
class _Explanation:
    """One explanation: Bayesian information criterion, residual (N), initial shear modulus (Pa), shift (m)."""

    criterion: float
    residual: float
    modulus: float
    shift: float


def with_zero(parts: Sequence[Part], sizes: Mapping[str, float], laws: Sequence[str], stated: str | None
              ) -> tuple[tuple[Part, ...], Zero | None]:
    """Add the assumption about the zero to the replicates of a test, and return the zero; None: the load starts at 0.

    Args:
        parts: of one test. sizes: ``height_mm`` and ``radius_mm`` or ``area_mm2``, as far as known.
        laws: that will be fitted. stated: `PRELOAD` or `SENSOR` by the user; None: the curve decides.
    """
    reading = parts[0].reading
    kind = KINDS[reading.kind.kind] if reading.kind.kind else None
    found = [(curve, start) for part in parts for recording, motion in zip(part.reading.recordings, part.motions,
                                                                          strict=True)
             if (curve := _loading(recording, motion, kind)) is not None
             and (start := load_at_zero(*curve)) is not None]
    if not found or any(column.missing for column in reading.columns):
        return tuple(parts), None
    shift, load = (float(np.mean([getattr(start, name) for _, start in found])) for name in ("shift", "load"))
    explanations = [_explain(curve, start, kind, sizes, laws) for curve, start in found]
    jump = _jump(parts, load)
    assumption, value, best = _decide([each for each in explanations if each], found[0][1], kind, stated, jump)
    zero = Zero(value, best or shift, load)
    loads = [start.load for _, start in found]
    same = np.ptp(loads) <= _SETTINGS.alike * abs(load)
    return tuple(_settled(part, assumption, zero, constant=bool(same)) for part in parts), zero


def _loading(recording: Recording, motion: Motion, kind: TestKind | None) -> tuple[np.ndarray, np.ndarray] | None:
    """Displacement and force of the first loading, positive under load; None where there is air or stress."""
    if motion.channel != "displacement" or "force" not in recording or motion.found.has_air:
        return None
    if motion.screening.control is not None and motion.screening.control.pattern == "oscillation":
        return None
    kept = recording if motion.kept is None else recording.select(motion.kept)
    way, load, _ = loading_of(kept, kind)
    end = int(np.argmax(way)) + 1
    if motion.failure is not None:
        end = min(end, motion.failure.index + 1)
    return way[:end], load[:end]


def _jump(parts: Sequence[Part], load: float) -> str | None:
    """Return the evidence that the load rises from zero within one sample; None: no such evidence.

    A first sample that was left out and reads zero load may be right. Then the load cell was zeroed, the specimen was
    unloaded, and the load jumps, as in a peel test or where static friction holds. No elastic law describes a jump.

    Args:
        parts: of one test. load: load at zero displacement, extrapolated from the samples that are kept, N.
    """
    for part in parts:
        for recording, motion in zip(part.reading.recordings, part.motions, strict=True):
            is_left_out = any(1 in each.samples and each.channel == "force" for each in motion.screening.left_out)
            if is_left_out and abs(recording.force[0]) <= _SETTINGS.unloaded * abs(load):
                return (f"sample 1, which is left out, reads {recording.force[0]:.3g} N: if it is right, the load cell "
                        "was zeroed and the force jumps, which no elastic law describes. Check the kind of test")
    return None


def _explain(curve: tuple[np.ndarray, np.ndarray], start: LoadAtZero, kind: TestKind | None,
             sizes: Mapping[str, float], laws: Sequence[str]) -> tuple[dict[str, _Explanation], float] | None:
    """Explanation of each value, and the noise of the force, N; None where the stress is not known."""
    area = sizes.get("area_mm2", np.pi * sizes["radius_mm"]**2 if "radius_mm" in sizes else None)
    if kind is None or kind.closed_form is None or area is None or "height_mm" not in sizes:
        return None
    way, load = curve
    height, area = 1e-3 * sizes["height_mm"], 1e-6 * area
    bend = (load[1:-1] - 0.5 * (load[:-2] + load[2:])) / np.sqrt(1.5)
    noise = float(np.median(np.abs(bend))) / 0.6745
    best: dict[str, _Explanation] = {}
    for name in laws:
        for value in (PRELOAD, SENSOR):
            found = _fit(value, way, load, start.shift, height, area, kind, name)
            if found is not None and (value not in best or found.criterion < best[value].criterion):
                best[value] = found
    return (best, noise) if len(best) == len(_WORDS) else None


def _fit(value: str, way: np.ndarray, load: np.ndarray, shift: float, height: float, area: float, kind: TestKind,
         name: str) -> _Explanation | None:
    """Least squares of one law with one explanation; None where the law is not linear or has no positive modulus."""
    law, form = find_law(name), kind.require_closed_form()
    ones = np.ones(len(law.parameters))

    def solved(moved: float) -> tuple[float, np.ndarray]:
        strain = kind.abscissa((way + moved) / height)
        design = kind.sign * area * form.derivatives(law, strain, ones)
        if value == SENSOR:
            design = np.column_stack([design, np.ones(way.size)])
        coefficients = np.linalg.lstsq(design, load, rcond=None)[0]
        return float(np.sum((load - design @ coefficients)**2)), coefficients

    if way[-1] + _SHIFTS[-1] * shift >= height and not kind.gripped:
        return None
    moved = 0.0 if value == SENSOR else float(min(_SHIFTS * shift, key=lambda each: solved(each)[0]))
    squares, coefficients = solved(moved)
    values = coefficients[:ones.size]
    modulus = law.mu0(values)
    if modulus <= 0:
        return None
    criterion = way.size * np.log(max(squares / way.size, 1e-300)) + (ones.size + 1) * np.log(way.size)
    return _Explanation(float(criterion), float(np.sqrt(squares / way.size)), modulus, moved)


def linear_laws(names: Sequence[str]) -> tuple[str, ...]:
    """Those of the laws whose stress is linear in their parameters; the Neo-Hooke law where there is none."""
    strain = np.array([0.9, 0.95])

    def is_linear(name: str) -> bool:
        law = find_law(name)
        one, two = (law.nominal_stress_derivatives(strain, np.full(len(law.parameters), value)) for value in (1.0, 2.0))
        return bool(np.allclose(one, two))

    return tuple(name for name in names if name in LAWS and is_linear(name)) or ("neo_hooke",)


def _decide(explanations: Sequence[tuple[dict[str, _Explanation], float]], start: LoadAtZero,
            kind: TestKind | None, stated: str | None, jump: str | None) -> tuple[Assumption, str, float | None]:
    """Return the assumption, its value, and the fitted shift of contact, m.

    Args:
        explanations: of the recordings. start: load at zero of the first one. kind: of the test.
        stated: value that the user states. jump: see `_jump`; with a jump the curve does not decide.
    """
    if start.load < 0 and kind is not None and not kind.can_pull:
        return _against_the_load(start, stated), SENSOR, None
    words = {**_WORDS, PRELOAD: _AGAINST} if start.load < 0 else _WORDS
    evidence = [f"the force at zero displacement is {start.load:.3g} N, {100 * start.fraction:.0f} % of its range"]
    against = [jump] if jump else []
    value, ratio, shift = stated or PRELOAD, None, None
    decided = False
    if explanations:
        criteria = {each: sum(found[each].criterion for found, _ in explanations) for each in _WORDS}
        better = min(criteria, key=lambda each: criteria[each])
        value = stated or better
        other = SENSOR if value == PRELOAD else PRELOAD
        ratio = float(np.mean([found[other].modulus / found[value].modulus for found, _ in explanations]))
        shift = float(np.mean([found[PRELOAD].shift for found, _ in explanations]))
        describes = all(found[better].residual <= _SETTINGS.describes * noise for found, noise in explanations)
        decided = jump is None and describes and max(criteria.values()) - min(criteria.values()) > _SETTINGS.decides
        residuals = {each: np.mean([found[each].residual for found, _ in explanations]) for each in _WORDS}
        said = f"residuals of {residuals[value]:.2g} N, with the other explanation {residuals[other]:.2g} N"
        (evidence if criteria[value] <= criteria[other] else against).append(said)
    other = SENSOR if value == PRELOAD else PRELOAD
    alternatives = () if decided else (Alternative(words[other], ratio, f"--zero {other}"),)
    assumption = Assumption("zero of displacement and force", words[value], tuple(evidence), tuple(against),
                            alternatives, f"--zero {value}", stated is not None)
    return assumption, value, shift


def _against_the_load(start: LoadAtZero, stated: str | None) -> Assumption:
    """The load cell was not zeroed, because a tool that does not adhere to the specimen cannot pull it.

    Raises:
        InputError: the user stated a preload.
    """
    if stated == PRELOAD:
        raise InputError(f"--zero must be {SENSOR}; got {PRELOAD}. The force at zero displacement is {start.load:.3g} "
                         "N, against the direction of loading, and a preload is along it.", field="zero")
    evidence = (f"the force at zero displacement is {start.load:.3g} N, {100 * start.fraction:.0f} % of its range",
                "a tool that does not adhere to the specimen cannot pull it")
    return Assumption("zero of displacement and force", _WORDS[SENSOR], evidence, (), (), f"--zero {SENSOR}",
                      stated is not None)


def _settled(part: Part, assumption: Assumption, zero: Zero, *, constant: bool) -> Part:
    """The part with the assumption; of a load cell that was not zeroed with an offset of its column."""
    note = f"{assumption.evidence[0]}: {assumption.value}"
    motions = tuple(replace(motion, assumptions=(*motion.assumptions, assumption), warnings=(*motion.warnings, note))
                    for motion in part.motions)
    reading = part.reading
    if zero.value == SENSOR:
        reading = replace(reading, columns=tuple(
            replace(column, offset=_offset(column.unit, zero.load) if constant else "start",
                    reason=f"{column.reason}; {_WORDS[SENSOR]}")
            if column.channel == "force" and column.offset is None else column for column in reading.columns))
        recordings = tuple(each.with_channels(force=each.force - zero.load) for each in reading.recordings)
        reading = replace(reading, recordings=recordings, options=read_only(
            {**reading.options, "columns": {column.channel: column.entry() for column in reading.columns}}))
    return replace(part, reading=reading, motions=motions)


def _offset(unit: str | None, load: float) -> float:
    """Offset of the force in the unit of its column that takes `load` (N) off."""
    factor = 1.0 if unit is None or quantity_of(unit) == "signal" else to_si(unit)[0]
    return float(f"{-load / factor:.4g}")
