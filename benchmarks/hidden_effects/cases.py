"""Hidden effects of the study: forms, sizes with sources, effects outside the catalogue, and pairs.

A case computes the force that a test reads with the effect at one size. The form ``exact`` is that of the catalogue;
``other`` is the same physics in another form. Sizes are drawn between the physical limits `low` and `high`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np

from benchmarks.hidden_effects.truth import (
    C10,
    C20,
    DEPTH,
    FAST,
    HEIGHT,
    NEEDLE,
    RADIUS,
    VirtualTest,
    difference,
    hereditary,
    lubricated,
    moved,
    plain,
    simulated,
)

Force = Callable[[VirtualTest, float], np.ndarray]
#: Path of the relaxing fraction.
_G = "viscoelastic.terms[0].g"
#: Path of the relaxation time.
_TAU = "viscoelastic.terms[0].tau"
#: Stiffness of four specimens: deviations from the first, in units of the size.
SPECIMENS = (0.0, 0.9, -1.3, 0.4)
#: Relaxation time, s.
TAU = 5.0
#: Diffusivity, m2/s: a needle drains in 6 s, a plate in 160 s.
DIFFUSIVITY = 1e-5
#: Depth of the puncture, m.
PUNCTURED = 6e-3
#: Depth at which the stage loses steps, m.
LOST = 4e-3
#: Thickness of a skin, m.
SKIN = 2e-3
_STRIPS = 200


@dataclass(frozen=True)
class Case:
    """Hidden effect in one form.

    Attributes:
        effect: name in the catalogue; empty: the catalogue does not have the effect.
        form: ``exact``, ``other``, or the name of an effect outside the catalogue.
        low, high: limits of the size, in `unit`. source: source of the limits. origin: origin of the curves.
        force: function (test, size) -> force at the samples of the test, N.
    """

    effect: str
    form: str
    low: float
    high: float
    unit: str
    source: str
    origin: Literal["independent", "same solver"]
    force: Force

    @property
    def key(self) -> str:
        return f"{self.effect}/{self.form}"


def _fem(paths: Callable[[float], Mapping[str, float]], kinds: str = "ABC") -> Force:
    """Return the force of an effect that is a parameter of the model, in tests of these kinds."""
    def force(test: VirtualTest, size: float) -> np.ndarray:
        if test.kind not in kinds:
            return plain(test.kind, test.displacement)
        return difference(test, paths(size))
    return force


def _law(name: str) -> Force:
    def force(test: VirtualTest, size: float) -> np.ndarray:
        if test.kind == "A":
            return lubricated(test.displacement, {name: size})
        return difference(test, {}, {name: size})
    return force


def _moved(tool: Callable[[VirtualTest, float], np.ndarray], names: tuple[str, ...] = ()) -> Force:
    """Return the plain force at the true position of the tool, in tests of these names (empty: all tests)."""
    def force(test: VirtualTest, size: float) -> np.ndarray:
        if names and test.name not in names:
            return plain(test.kind, test.displacement)
        return moved(test, tool(test, size))
    return force


def _read(reading: Callable[[VirtualTest, np.ndarray, float], np.ndarray], names: tuple[str, ...] = (),
          kinds: str = "ABC") -> Force:
    """Return the reading of the plain force, in tests of these names (empty: all tests) and kinds."""
    def force(test: VirtualTest, size: float) -> np.ndarray:
        true = plain(test.kind, test.displacement)
        acts = (not names or test.name in names) and test.kind in kinds
        return reading(test, true, size) if acts else true
    return force


def _relaxing(relaxation: Callable[[VirtualTest, float], Callable[[np.ndarray], np.ndarray]]) -> Force:
    """Return the force with relaxation; plates without bond transmit no tension."""
    def force(test: VirtualTest, size: float) -> np.ndarray:
        answer = hereditary(test, plain(test.kind, test.displacement), relaxation(test, size))
        return np.maximum(answer, 0.0) if test.kind == "A" else answer
    return force


def _prony(test: VirtualTest, g: float):
    return lambda t: 1.0 - g * np.mean([1.0 - np.exp(-t / tau) for tau in (1.0, 8.0, 50.0)], axis=0)


def _power(test: VirtualTest, n: float):
    return lambda t: (1.0 + t / 0.5) ** -n


def _drained(test: VirtualTest, phi: float):
    """Relaxation of a poroelastic half-space under a flat punch (Hu, Zhao, Vlassak and Suo 2010); it starts with the
    square root of time."""
    contact = NEEDLE if test.kind == "C" else RADIUS

    def relaxation(t: np.ndarray) -> np.ndarray:
        x = DIFFUSIVITY * t / contact**2
        return 1.0 - phi * (1.0 - 1.304 * np.exp(-np.sqrt(x)) + 0.304 * np.exp(-0.254 * x))
    return relaxation


def _compliant(yields: Callable[[np.ndarray, float], np.ndarray]):
    """Return the position of the tool, m, at the end of a load train that deforms by `yields(force, size)`."""
    def tool(test: VirtualTest, size: float) -> np.ndarray:
        there = test.displacement.copy()
        for _ in range(60):
            there = 0.5 * there + 0.5 * (test.displacement - yields(plain(test.kind, there), size))
        return there
    return tool


def _play(test: VirtualTest, b: float, wind: float = 0.0) -> np.ndarray:
    """Return the displacement with backlash `b` (m) after the reversal, at once or over a distance `wind`, m."""
    back = test.direction < 0
    way = DEPTH - test.displacement
    lost = np.minimum(b, way) if not wind else b * (1.0 - np.exp(-way / wind))
    return np.where(back, test.displacement + lost, test.displacement)


def _strips(test: VirtualTest, tilt: float) -> np.ndarray:
    """Return the force of a tilted face: mean of the plain forces at the local depths of independent strips."""
    angle = (np.arange(_STRIPS) + 0.5) * np.pi / _STRIPS
    x, weight = np.cos(angle), np.sin(angle) ** 2
    behind = 0.5 * tilt * (1.0 - x)
    forces = plain(test.kind, test.displacement[:, None] - behind)
    return forces @ (weight / weight.sum())


def _touching(test: VirtualTest, tilt: float) -> np.ndarray:
    """Return the force of a tilted face from its contact area.

    The stiffness is proportional to the area between plates, and to its square root under a punch on a half-space. The
    depth is the mean over the contact area.
    """
    angle = (np.arange(_STRIPS) + 0.5) * np.pi / _STRIPS
    x, weight = np.cos(angle), np.sin(angle) ** 2
    gap = test.displacement[:, None] - 0.5 * tilt * (1.0 - x)
    inside = (gap > 0) * (weight / weight.sum())
    area = inside.sum(axis=1)
    depth = (inside * gap).sum(axis=1) / np.maximum(area, 1e-12)
    return plain(test.kind, depth) * (np.sqrt(area) if test.kind == "C" else area)


def _slip(gradual: bool) -> Force:
    def force(test: VirtualTest, size: float) -> np.ndarray:
        held = plain(test.kind, test.displacement)
        if test.name != "B":
            return held
        share = size * (test.displacement / DEPTH if gradual else 1.0)
        return held - share * (held - lubricated(test.displacement))
    return force


def _friction(growing: bool) -> Force:
    def force(test: VirtualTest, size: float) -> np.ndarray:
        free = plain(test.kind, test.displacement)
        if test.kind != "A":
            return free
        added = simulated(test, {"experiment.friction": size}) - simulated(test, {})
        # The friction of a lubricant that is squeezed out grows with time.
        return free + added * (np.minimum(test.time / test.ramp, 1.0) if growing else 1.0)
    return force


def _softened(test: VirtualTest, true: np.ndarray, r: float) -> np.ndarray:
    """Return the force of a material that softens during unloading, more with distance from the peak."""
    return np.where(test.direction < 0, true * (1.0 - r * (1.0 - test.displacement / DEPTH)), true)


def _cut(test: VirtualTest, true: np.ndarray, drop: float) -> np.ndarray:
    """Return the force of a needle that cuts below a depth: it falls within 0.2 mm and then rises by shaft friction."""
    below = (test.depth > PUNCTURED) & (test.direction > 0) | (test.direction <= 0)
    level = float(plain("C", np.array([PUNCTURED]))[0])
    ahead = np.maximum(test.depth - PUNCTURED, 0.0)
    lost = drop * level * (1.0 - np.exp(-ahead / 0.1e-3)) + drop * 0.5 * (true - level) * (ahead > 0)
    after = np.where(test.direction <= 0, drop * true, lost)
    return np.where(below, true - after, true)


def _late(test: VirtualTest, true: np.ndarray, dt: float) -> np.ndarray:
    return np.interp(test.time - dt, test.time, true)


def _filtered(test: VirtualTest, true: np.ndarray, time_constant: float) -> np.ndarray:
    """Return the force after a first-order low-pass filter, which replaces the delay."""
    answer, step = np.zeros_like(true), np.diff(test.time)
    for k, (dt, slope) in enumerate(zip(step, np.diff(true) / step, strict=True)):
        # Exact solution for a true force that is linear between samples.
        behind = answer[k] - true[k] + time_constant * slope
        answer[k + 1] = true[k + 1] - time_constant * slope + behind * np.exp(-dt / time_constant)
    return answer


def _lost(test: VirtualTest, s: float, depths: tuple[float, ...]) -> np.ndarray:
    deepest = np.maximum.accumulate(test.displacement)
    return test.displacement - sum((s / len(depths)) * (deepest > depth) for depth in depths)


def _warming(test: VirtualTest, true: np.ndarray, change: float) -> np.ndarray:
    return true * (1.0 + change * test.time / test.time[-1])


def _individuals(test: VirtualTest, size: float) -> np.ndarray:
    """Return the force of specimens whose C20 varies twice as much as C10."""
    true, change = plain(test.kind, test.displacement), size * SPECIMENS[test.specimen]
    by_second = C20 * moduli_change(test)[:, 1]
    return (1 + change) * true + change * by_second


_HYDROGELS = "Prony fits of silicones and soft tissue: 1 to 40 % relax in a minute"
_CELLS = "load cells of 10 to 50 N yield 0.1 to 0.5 mm at full scale; frames of desktop stages the same again"
_STAGES = "data sheets of stepper stages: backlash 5 to 200 um, a full step 5 to 10 um, stalls lose several"
_SENSORS = "data sheets of load cells: creep 0.03 to 0.1 % in 30 min of full scale, zero 1 %, warm-up drifts more"
_RULER = "moulds and calipers: 0.1 to 1 mm of 40 and 70 mm; demoulded gels to some per cent"
_TEMPERATURE = "silicones about 0.2 % a kelvin, gelatine 2 to 4 %"
_SLIPS = "sandpaper and glue hold all to half of a face"
_FIT = "coefficients of the reference study, between its laws and tests"


def _tissue() -> list[Case]:
    shape = {"softening.share": 1.0}
    return [
        Case("strain_stiffening", "exact", 10, 1e5, "Pa", _FIT, "same solver", _law("C30")),
        Case("i2_term", "exact", 5, 750, "Pa", _FIT, "same solver", _law("C01")),
        Case("compressibility", "exact", 2e-4, 0.02, "mu/K", "gels to soft foams: Poisson's ratio 0.4999 to 0.49",
             "same solver", _fem(lambda size: {"bulk.bulk_ratio": 1.0 / size})),
        Case("viscoelasticity", "exact", 5e-4, 0.4, "1", _HYDROGELS, "same solver",
             _fem(lambda g: {_G: g, _TAU: TAU})),
        Case("viscoelasticity", "other", 5e-4, 0.4, "1", f"{_HYDROGELS}; three terms, 1 to 50 s", "independent",
             _relaxing(_prony)),
        Case("viscoelasticity", "other, power law", 1e-4, 0.12, "1", "soft tissue relaxes with powers of 0.01 to 0.2",
             "independent", _relaxing(_power)),
        Case("poroelasticity", "exact", 5e-4, 0.4, "1", "gels drain 1 to 40 % of their stiffness", "same solver",
             _fem(lambda phi: {"poroelasticity.phi": phi, "poroelasticity.diffusivity": DIFFUSIVITY})),
        Case("poroelasticity", "other", 5e-4, 0.4, "1", "gels drain 1 to 40 % of their stiffness", "independent",
             _relaxing(_drained)),
        Case("softening", "exact", 5e-4, 0.4, "1", "Mullins effect of unfilled to filled elastomers", "same solver",
             _fem(lambda r: {"softening.loss": r, **shape})),
        Case("softening", "other", 5e-4, 0.4, "1", "Mullins effect of unfilled to filled elastomers", "independent",
             _read(_softened)),
        Case("layer", "exact", 0.01, 5.0, "ratio - 1", "skins of cast silicone and of organs", "same solver",
             _fem(lambda k: {"layers[0].ratio": 1 + k, "layers[0].thickness": SKIN})),
        Case("layer", "other", 0.01, 5.0, "ratio - 1", "a graded skin, of two layers", "same solver",
             _fem(lambda k: {"layers[0].ratio": 1 + k, "layers[0].thickness": 1.0e-3,
                             "layers[1].ratio": 1 + 0.4 * k, "layers[1].thickness": 2.5e-3})),
        Case("puncture", "exact", 0.002, 0.5, "1", "needles lose some per cent to half of their force", "independent",
             _read(lambda test, true, s: np.where(np.maximum.accumulate(test.depth) > PUNCTURED,
                                                  (1 - s) * true, true), kinds="C")),
        Case("puncture", "other", 0.002, 0.5, "1", "needles lose some per cent to half of their force", "independent",
             _read(_cut, kinds="C")),
        Case("session_scale", "exact", 5e-4, 0.1, "1", _TEMPERATURE, "independent",
             _read(lambda test, true, k: (1 + k) * true, ("C",))),
        Case("session_scale", "other", 5e-4, 0.1, "1", f"{_TEMPERATURE}; it warms while it is measured", "independent",
             _read(_warming, ("C",))),
        Case("population", "exact", 1e-3, 0.3, "1", "animals and batches of silicone differ by some to 30 per cent",
             "independent", _read(lambda test, true, s: (1 + s * SPECIMENS[test.specimen]) * true)),
        Case("population", "other", 1e-3, 0.3, "1", "C20 differs too, twice as much", "independent", _individuals)]


def _around() -> list[Case]:
    return [
        Case("plate_friction", "exact", 5e-4, 0.3, "1", "oil on steel to dry silicone", "same solver",
             _friction(False)),
        Case("plate_friction", "other", 5e-4, 0.3, "1", "a lubricant that is squeezed out", "same solver",
             _friction(True)),
        Case("partial_slip", "exact", 0.003, 0.5, "1", _SLIPS, "independent", _slip(False)),
        Case("partial_slip", "other", 0.003, 0.5, "1", f"{_SLIPS}; little by little", "independent", _slip(True)),
        Case("self_weight", "exact", 0.05, 9.81, "m/s2", "gravity; less in a bath, in which the tissue floats",
             "same solver", _fem(lambda g: {"experiment.specimen.gravity": g})),
        Case("edge_rounding", "exact", 0.05e-3, 2e-3, "m", "turned and worn punches", "same solver",
             _fem(lambda r: {"experiment.tool.edge_radius": r}, "C")),
        Case("radius_error", "exact", 5e-4, 0.05, "1", _RULER, "same solver",
             _fem(lambda e: {"radius": RADIUS * (1 + e)})),
        Case("height_error", "exact", 5e-4, 0.05, "1", _RULER, "same solver",
             _fem(lambda e: {"height": HEIGHT * (1 + e)})),
        Case("tilt", "exact", 0.02e-3, 1.5e-3, "m", "0.05 to 1 degree across a face", "independent",
             lambda test, size: _strips(test, size) if test.name == "A" else plain(test.kind, test.displacement)),
        Case("tilt", "other", 0.02e-3, 1.5e-3, "m", "0.05 to 1 degree across a face", "independent",
             lambda test, size: _touching(test, size) if test.name == "A" else plain(test.kind, test.displacement)),
        Case("contact_offset", "exact", 0.02e-3, 0.5e-3, "m", "a touch found at 1 to 10 times the noise", "independent",
             _moved(lambda test, d0: test.displacement - d0, ("B",))),
        Case("machine_compliance", "exact", 1e-6, 1e-4, "m/N", _CELLS, "independent",
             _moved(_compliant(lambda force, c: c * force))),
        Case("machine_compliance", "other", 1e-6, 1e-4, "m/N", f"{_CELLS}; joints that seat with 2 N", "independent",
             _moved(_compliant(lambda force, c: c * 2.0 * (1 - np.exp(-np.maximum(force, 0) / 2.0))))),
        Case("displacement_gain", "exact", 5e-4, 0.05, "1", _STAGES, "independent",
             _moved(lambda test, eps: (1 - eps) * test.displacement)),
        Case("backlash", "exact", 2e-6, 0.2e-3, "m", _STAGES, "independent", _moved(_play)),
        Case("backlash", "other", 2e-6, 0.2e-3, "m", f"{_STAGES}; wound up over 0.3 mm", "independent",
             _moved(lambda test, b: _play(test, b, 0.3e-3))),
        Case("step_loss", "exact", 5e-6, 0.5e-3, "m", _STAGES, "independent",
             _moved(lambda test, s: _lost(test, s, (LOST,)), ("B",))),
        Case("step_loss", "other", 5e-6, 0.5e-3, "m", f"{_STAGES}; in three goes", "independent",
             _moved(lambda test, s: _lost(test, s, (3.5e-3, LOST, 4.5e-3)), ("B",))),
        Case("zero_offset", "exact", 0.002, 0.3, "N", _SENSORS, "independent", _read(lambda _, true, F0: true + F0)),
        Case("sensor_drift", "exact", 5e-6, 3e-3, "N/s", _SENSORS, "independent",
             _read(lambda test, true, r: true + r * test.time)),
        Case("sensor_drift", "other", 1e-3, 0.2, "N", f"{_SENSORS}; with the logarithm of time", "independent",
             _read(lambda test, true, r: true + r * np.log1p(test.time / 5.0))),
        Case("sensor_gain", "exact", 1e-3, 0.05, "1", _SENSORS, "independent",
             _read(lambda _, true, eps: (1 + eps) * true)),
        Case("latency", "exact", 1e-3, 0.5, "s", "filters and buses: 1 ms to some tenths of a second", "independent",
             _read(_late)),
        Case("latency", "other", 1e-3, 0.5, "s", "a low-pass filter", "independent", _read(_filtered)),
        Case("guide_friction", "exact", 5e-4, 0.2, "N", "linear guides and seals", "independent",
             _read(lambda test, true, F: true + F * test.direction)),
        Case("guide_friction", "other", 5e-4, 0.2, "N", "half of it with the turns of the screw, 5 mm", "independent",
             _read(lambda test, true, F: true + F * test.direction
                   * (1 + 0.5 * np.sin(2 * np.pi * test.displacement / 5e-3)))),
        Case("rate_damping", "exact", 0.2, 100.0, "N s/m", "seals and cables; 0.2 N at 2.48 mm/s", "independent",
             _read(lambda test, true, eta: true + eta * test.speed * test.direction)),
        Case("rate_damping", "other", 0.2, 100.0, "N s/m", "with the root of the speed", "independent",
             _read(lambda test, true, eta: true + eta * np.sqrt(test.speed * FAST) * test.direction))]


def hidden() -> dict[str, Case]:
    """Return all cases of effects of the catalogue, by key.

    Not among them, because no protocol could show them: adhesion (no tool goes back past its touch) and inertia
    (10 mm/s would be slow). A separate protocol has the scatter between specimens.
    """
    return {case.key: case for case in (*_tissue(), *_around())}


def _ripple(test: VirtualTest, true: np.ndarray, size: float) -> np.ndarray:
    """Return the force with stick-slip on the shaft of the tool: a sawtooth during loading and unloading."""
    tooth = (test.displacement / 0.7e-3) % 1.0
    return true + size * (tooth - 0.5) * test.direction


def _stalled(test: VirtualTest, size: float) -> np.ndarray:
    """Return the displacement of a stage that stops without a report and catches up later, m."""
    at, way = 5e-3, np.maximum.accumulate(test.displacement)
    behind = np.clip(way - at, 0.0, size) - 3.0 * np.clip(way - at - size, 0.0, size / 3.0)
    return test.displacement - np.where(test.direction > 0, behind, 0.0)


def outside() -> dict[str, Case]:
    """Return the cases whose effects are in no catalogue."""
    none = "no physical range: as large as needed"
    saturated = 6.0
    cases = [
        Case("", "stick-slip ripple", 1e-3, 1.0, "N", none, "independent", _read(_ripple)),
        Case("", "stage stall", 1e-6, 3e-3, "m", none, "independent", _moved(_stalled, ("B",))),
        Case("", "zero wave", 1e-3, 1.0, "N", none, "independent",
             _read(lambda test, true, a: true + a * np.sin(2 * np.pi * test.time / 17.0))),
        Case("", "drying specimen", 1e-5, 1e-1, "1", none, "independent",
             _read(lambda test, true, a: true * (1 + a * (test.time / 40.0) ** 2))),
        Case("", "sensor that saturates", 1e-3, 0.9, "1", none, "independent",
             _read(lambda test, true, a: true - a * np.maximum(true - saturated, 0.0))),
        Case("", "hard inclusion", 1e-3, 1.0, "N", none, "independent",
             _read(lambda test, true, a: true + a * np.exp(-((test.displacement - 5e-3) / 0.6e-3) ** 2), ("C",)))]
    return {case.key: case for case in cases}


#: Pairs of effects that act in different regions of the curve.
PAIRS = (("viscoelasticity/exact", "machine_compliance/exact"), ("viscoelasticity/exact", "contact_offset/exact"),
         ("poroelasticity/exact", "zero_offset/exact"), ("sensor_drift/exact", "step_loss/exact"),
         ("softening/exact", "tilt/exact"), ("latency/exact", "partial_slip/exact"),
         ("guide_friction/exact", "session_scale/exact"), ("backlash/exact", "strain_stiffening/exact"))


def both(first: Case, second: Case, sizes: tuple[float, float]) -> Callable[[VirtualTest], np.ndarray]:
    """Return the force of a test with two additive effects, N."""
    def force(test: VirtualTest) -> np.ndarray:
        true = plain(test.kind, test.displacement)
        return first.force(test, sizes[0]) + second.force(test, sizes[1]) - true
    return force


def moduli_change(test: VirtualTest) -> np.ndarray:
    """Return the derivatives of the force with respect to C10 and C20, N/Pa, shape (n, 2).

    The force is linear in both moduli, so that it is the sum of modulus times derivative.
    """
    step = 0.05 * C20
    if test.kind == "A":
        by_second = (lubricated(test.displacement, {"C20": C20 + step}) - lubricated(test.displacement)) / step
    else:
        by_second = (simulated(test, {}, {"C20": C20 + step}) - simulated(test, {})) / step
    return np.column_stack([(plain(test.kind, test.displacement) - C20 * by_second) / C10, by_second])
