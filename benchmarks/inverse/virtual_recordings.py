"""Virtual recordings: contact after air with preload, drift and noise; failing and intact specimens.

Their laws are not the ones that are fitted: closed forms of strain energies, curves of finite elements, contact of a
ball by Sneddon (International Journal of Engineering Science 3 (1965) 47), of a ball on a thin layer by Dimitriadis et
al. (Biophysical Journal 82 (2002) 2798) and of a cone on one by Gavara and Chadwick (Nature Nanotechnology 7 (2012)
733); ramps relax, noise is white, coloured, a hum or the rounding of the sensor.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

import tissue_sim as ts
from benchmarks import ROOT

REFERENCE = ROOT / "tests" / "reference"
#: Range of the noise, as a fraction of the force at full depth.
NOISE = (1e-4, 3e-3)
#: Range of the number of samples from contact to full depth.
SAMPLES = (100, 1000)
COLOURS = ("white", "white", "coloured", "hum", "rounded")
#: Largest correlation time of the noise, samples.
MEMORY = 6.0
#: Largest rounding step, in standard deviations of the noise.
ROUNDING = 4.0

Shape = Callable[[np.ndarray], np.ndarray]


def _scaled(force: Shape) -> Shape:
    top = float(force(np.array([1.0]))[0])
    return lambda depth: force(depth) / top


def _compression(law: str, parameters: dict[str, float], strain: float) -> Shape:
    found = ts.find_law(law)
    return _scaled(lambda depth: -found.nominal_stress(1 - strain * depth, parameters))


def _finite_elements(name: str) -> Shape:
    depth, force = np.loadtxt(REFERENCE / name, delimiter=",").T
    return _scaled(CubicSpline(depth / depth[-1], force))


def _ball(reach: float) -> Shape:
    """Return force over depth of a rigid ball of radius 1, up to a depth of `reach`."""
    radius = np.geomspace(1e-2, 0.95, 4000)
    depth = 0.5 * radius * np.log((1 + radius) / (1 - radius))
    force = 0.5 * (radius**2 + 1) * np.log((1 + radius) / (1 - radius)) - radius
    beyond = PchipInterpolator(depth, force)
    return _scaled(lambda way: np.where(way * reach > depth[0], beyond(np.maximum(way * reach, depth[0])),
                                        4 / 3 * (way * reach)**1.5))


def _series(power: float, step: float, terms: tuple[float, ...]) -> Shape:
    return _scaled(lambda way: way**power * sum(term * way**(k * step) for k, term in enumerate(terms)))


def shapes() -> dict[str, Shape]:
    """Return force over depth, both scaled to 1."""
    return {
        "plates, neo-Hooke": _compression("neo_hooke", {"C10": 1e3}, 0.5),
        "plates, Yeoh": _compression("reduced_polynomial_3", {"C10": 7.7e3, "C20": -60.0, "C30": 250.0}, 0.66),
        "plates, Ogden": _compression("ogden_1", {"mu1": 3e3, "alpha1": 14.8}, 0.3),
        "bonded plates, FEM": _finite_elements("bonded_RP.csv"),
        "dry plates, FEM": _finite_elements("friction0.7_30mm_RP.csv"),
        "flat needle, FEM": _finite_elements("punch_bonded_face_side_wall_RP.csv"),
        "rounded needle, FEM": _finite_elements("punch_friction0.7_edge0.25mm_RP.csv"),
        "ball, Hertz": _series(1.5, 1.0, (1.0,)),
        "ball, Sneddon": _ball(0.8),
        "ball, thin layer": _series(1.5, 0.5, (1.0, 1.133, 1.283, 0.769, 0.0975)),
        "cone": _series(2.0, 1.0, (1.0,)),
        "cone, thin layer": _series(2.0, 1.0, (1.0, 0.36, 0.16, 0.061, 0.014)),
    }


@dataclass(frozen=True, eq=False)
class Virtual:
    """A virtual recording: SI, shapes (n,). truth: place of the contact, m, or index of the failure (-1: intact).

    step: between samples, m. words: what it is, for tables.
    """

    time: np.ndarray
    displacement: np.ndarray
    force: np.ndarray
    truth: float
    step: float
    words: dict[str, str]


def relax(force: np.ndarray, step: float, share: float, tau: float) -> np.ndarray:
    """Return the force of a material with one Prony term.

    Args:
        force: elastic force, N. step: time between samples, s. share: relaxing fraction. tau: relaxation time, s.
    """
    kept, memory, answer = np.exp(-step / tau), 0.0, np.empty_like(force)
    for k, gain in enumerate(np.diff(force, prepend=force[0])):
        memory = memory * kept + gain
        answer[k] = memory
    return (1 - share) * (force - force[0]) + share * answer + force[0]


def noise(rng: np.random.Generator, samples: int, colour: str) -> np.ndarray:
    """Draw noise of standard deviation 1: white, correlated (``coloured``), or with a sine (``hum``)."""
    white = rng.standard_normal(samples)
    if colour == "coloured":
        kept = np.exp(-1 / rng.uniform(1, MEMORY))
        for k in range(1, samples):
            white[k] = kept * white[k - 1] + np.sqrt(1 - kept**2) * white[k]
    if colour == "hum":
        return np.sqrt(0.5) * white + np.sin(2 * np.pi * (rng.uniform(0.05, 0.4) * np.arange(samples) + rng.uniform()))
    return white


def _read(rng: np.random.Generator, force: np.ndarray, deviation: float, colour: str) -> np.ndarray:
    """Return the reading of a sensor: force with zero offset, drift, noise and rounding, N."""
    time = np.linspace(0, 1, force.size)
    drift = 5 * deviation * rng.normal() if rng.uniform() < 0.7 else 0.0
    read = force + 20 * deviation * rng.normal() + drift * time + deviation * noise(rng, force.size, colour)
    if colour == "rounded":
        step = deviation * rng.uniform(1, ROUNDING)
        return np.round(read / step) * step
    return read


def touch(seed: int, number: int) -> Virtual:
    """Draw a test that begins in air: three in four have a single loading, one in four a stop under a preload."""
    rng = np.random.default_rng([seed, number])
    names = shapes()
    name = list(names)[rng.integers(len(names))]
    colour, level = str(rng.choice(COLOURS)), np.exp(rng.uniform(*np.log(NOISE)))
    samples = int(np.exp(rng.uniform(*np.log(SAMPLES))))
    depth, top = rng.uniform(1e-3, 12e-3), np.exp(rng.uniform(np.log(0.05), np.log(100.0)))
    step = depth / samples
    beat = step / rng.uniform(0.05e-3, 2e-3)
    # Air is long in four of five; in the others a few samples.
    air = int(rng.uniform(0.05, 1.0) * samples if rng.uniform() < 0.8 else rng.uniform(8, 0.05 * samples + 8))
    displacement = (np.arange(air + samples) + rng.uniform()) * step
    contact = (air + rng.uniform()) * step
    preload = rng.uniform() < 0.25
    if preload:
        stop = int(air + samples * rng.uniform(0.1, 0.3))
        displacement = np.insert(displacement, stop, np.full(rng.integers(20, 100), displacement[stop - 1]))
    if rng.uniform() < 0.5:  # the recorder runs before the motor
        displacement = np.insert(displacement, 0, np.full(rng.integers(1, 40), displacement[0]))
    force = names[name](np.clip((displacement - contact) / depth, 0.0, None))
    relaxes = rng.uniform() < 0.4
    if relaxes:
        force = relax(force, beat, rng.uniform(0.1, 0.5), rng.uniform(0.02, 0.5) * samples * beat)
    read = top * _read(rng, force, level, colour)
    shift = rng.uniform(-5e-3, 5e-3) if rng.uniform() < 0.5 else 0.0
    strength = "below 0.05 %" if level < 5e-4 else "0.05 to 0.3 %"
    return Virtual(np.arange(displacement.size) * beat, displacement + shift, read, contact + shift, step, {
        "shape": name, "noise": colour, "noise of largest force": strength, "preload": "stop" if preload else "none",
        "material": "relaxes" if relaxes else "elastic"})


def _extension(law: str, parameters: dict[str, float], strain: float) -> Shape:
    found = ts.find_law(law)
    return _scaled(lambda way: found.nominal_stress(1 + strain * way, parameters))


def solids() -> dict[str, Shape]:
    """Return force over displacement, both scaled to 1, of intact specimens; rubber in tension has a plateau."""
    return shapes() | {
        "rubber in tension, Ogden": _extension("ogden_3", {
            "mu1": 0.62e6, "alpha1": 1.3, "mu2": 0.118e4, "alpha2": 5.0, "mu3": -0.981e4, "alpha3": -2.0}, 5.0),
        "tension, neo-Hooke": _extension("neo_hooke", {"C10": 1e3}, 3.0),
        # The tangent falls to a tenth.
        "plateau": _scaled(lambda way: np.tanh(6 * way) + 0.6 * way + 0.6 * way**8),
    }


def break_or_not(seed: int, number: int, *, fails: bool) -> Virtual:
    """Draw a test up to a failure, or one of an intact specimen, with cycles, holds and changes of speed."""
    rng = np.random.default_rng([seed, number, int(fails)])
    names = solids()
    name = list(names)[rng.integers(len(names))]
    colour, level = str(rng.choice(COLOURS)), np.exp(rng.uniform(*np.log(NOISE)))
    samples = int(np.exp(rng.uniform(*np.log(SAMPLES))))
    depth, top = rng.uniform(1e-3, 50e-3), np.exp(rng.uniform(np.log(0.05), np.log(100.0)))
    # The way as a share of the depth, one number a sample.
    motions: dict[str, list[np.ndarray]] = {
        "ramp": [np.linspace(0, 1, samples)],
        "ramp, hold, unload": [np.linspace(0, 1, samples), np.ones(samples // 2), np.linspace(1, 0, samples)],
        "cycles": [part for end in (0.6, 0.6, 0.6, 1.0) for part in (
            np.linspace(0, end, samples // 2), np.linspace(end, 0, samples // 2))],
        "steps": [part for k in range(4) for part in (
            np.linspace(k / 4, (k + 1) / 4, samples // 4 + 5), np.full(samples // 4 + 5, (k + 1) / 4))],
        "fast, then slow": [np.linspace(0, 0.6, samples // 8 + 8), np.linspace(0.6, 1, samples)],
        "sine": [0.5 - 0.5 * np.cos(np.linspace(0, 6 * np.pi, 3 * samples))],
    }
    motion = "ramp" if fails else str(rng.choice(list(motions)))
    way = np.concatenate(motions[motion])
    force = names[name](way)
    beat, share = 1.0, 0.0
    if rng.uniform() < 0.5:
        share = rng.uniform(0.1, 0.5)
        force = relax(force, beat, share, rng.uniform(0.02, 0.5) * samples)
    back = np.diff(way, prepend=0.0) < 0
    if not fails and rng.uniform() < 0.5:  # hysteresis: less force during unloading
        peak = np.maximum.accumulate(way)
        force = np.where(back, force * (1 - rng.uniform(0.1, 0.6) * (1 - way / peak.clip(1e-9))), force)
    truth, how = -1, "intact"
    if fails:
        how = str(rng.choice(["at once", "tear", "puncture", "little by little"]))
        truth = int(samples * rng.uniform(0.5, 0.9))
        after = np.arange(samples - truth - 1)
        lost = {"at once": rng.uniform(0.7, 1.0) * np.ones(after.size),
                "tear": rng.uniform(0.15, 0.5) * np.ones(after.size),
                "puncture": rng.uniform(0.15, 0.6) * np.exp(-after / (0.3 * samples)),
                "little by little": rng.uniform(0.4, 1.0) * np.minimum(after / (0.1 * samples), 1.0)**1.5}[how]
        spread = int(rng.integers(1, 4))  # samples that a sudden drop takes
        lost = lost * (np.minimum((after + 1) / spread, 1.0) if how != "little by little" else 1.0)
        force = force.copy()
        force[truth + 1:] = np.where(how == "little by little", force[truth], force[truth + 1:]) * (1 - lost)
    read = top * _read(rng, force, level, colour)
    return Virtual(np.arange(way.size) * beat, depth * way, read, truth, depth / samples, {
        "failure": how, "shape": name, "noise": colour, "motion": motion,
        "material": "relaxes" if share else "elastic"})
