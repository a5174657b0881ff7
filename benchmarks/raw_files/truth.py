"""Mechanical tests with a known modulus: closed forms of an incompressible neo-Hookean solid, numpy only.

Written independently of the package, which the raw files of `raw_files.py` test. lambda is the stretch along the load:

    uniaxial     P = mu (lambda - lambda^-2)      Treloar 1975, The Physics of Rubber Elasticity, chapter 4
    planar       P = mu (lambda - lambda^-3)
    equibiaxial  P = mu (lambda - lambda^-5)
    simple shear tau = mu gamma
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

#: Name of the kind of test.
COMPRESSION = "lubricated_compression"
#: Name of the kind of test.
TENSION = "uniaxial_tension"
#: Name of the kind of test.
SHEAR = "simple_shear"
KINDS = (COMPRESSION, TENSION, SHEAR)


def uniaxial_stress(mu: float, stretch: np.ndarray) -> np.ndarray:
    """Return the nominal stress of tension or compression, Pa."""
    return mu * (stretch - stretch**-2)


def planar_stress(mu: float, stretch: np.ndarray) -> np.ndarray:
    """Return the nominal stress of planar tension (pure shear), Pa."""
    return mu * (stretch - stretch**-3)


def equibiaxial_stress(mu: float, stretch: np.ndarray) -> np.ndarray:
    """Return the nominal stress of equibiaxial tension, Pa."""
    return mu * (stretch - stretch**-5)


def shear_stress(mu: float, strain: np.ndarray) -> np.ndarray:
    """Return the nominal shear stress of simple shear, Pa."""
    return mu * strain


@dataclass(frozen=True)
class Specimen:
    """Sizes, m: a cylinder (diameter, height) or a strip (width, thickness, length).

    In tension `length` is the gauge length. In shear `length` and `width` are the sides of the sheared face.
    """

    diameter: float = 0.0
    width: float = 0.0
    thickness: float = 0.0
    length: float = 0.0

    @property
    def is_cylinder(self) -> bool:
        return self.diameter > 0

    def area(self, kind: str) -> float:
        """Area that carries the force, m2."""
        if self.is_cylinder:
            return np.pi * self.diameter**2 / 4
        return self.width * (self.length if kind == SHEAR else self.thickness)

    def height(self, kind: str) -> float:
        """Length to which the displacement is referred, m."""
        return self.thickness if kind == SHEAR else self.length


@dataclass(frozen=True)
class Test:
    """Motion of a test and the readings of an ideal machine.

    Attributes:
        kind: of test. mu: shear modulus, Pa. specimen: its sizes.
        time: s. motion: displacement, m, and force, N: of equal length, positive under load.
    """

    kind: str
    mu: float
    specimen: Specimen
    time: np.ndarray
    motion: np.ndarray
    force: np.ndarray

    @property
    def stretch(self) -> np.ndarray:
        """Stretch along the load."""
        sign = -1.0 if self.kind == COMPRESSION else 1.0
        return 1.0 + sign * self.motion / self.specimen.height(self.kind)

    @property
    def nominal_stress(self) -> np.ndarray:
        """Force over undeformed area, Pa, negative in compression."""
        sign = -1.0 if self.kind == COMPRESSION else 1.0
        return sign * self.force / self.specimen.area(self.kind)

    def elastic_force(self, motion: np.ndarray) -> np.ndarray:
        """Return the force at displacements (m), N; zero before contact, or while a strip is slack."""
        height, area = self.specimen.height(self.kind), self.specimen.area(self.kind)
        if self.kind == SHEAR:
            return area * shear_stress(self.mu, motion / height)
        sign = -1.0 if self.kind == COMPRESSION else 1.0
        pressed = np.maximum(motion, 0.0)
        return area * sign * uniaxial_stress(self.mu, 1.0 + sign * pressed / height)

    def with_motion(self, time: np.ndarray, motion: np.ndarray) -> Test:
        """Return the elastic test with another motion."""
        return replace(self, time=time, motion=motion, force=self.elastic_force(motion))

    def with_force(self, time: np.ndarray, force: np.ndarray) -> Test:
        """Return the elastic test with another force."""
        return replace(self, time=time, force=force, motion=self.motion_at(force))

    def motion_at(self, force: np.ndarray) -> np.ndarray:
        """Return the displacement at elastic forces (N), m, by interpolation in 20,001 points."""
        limit = 0.85 if self.kind == COMPRESSION else 6.0
        grid = np.linspace(0.0, limit * self.specimen.height(self.kind), 20_001)
        return np.interp(force, self.elastic_force(grid), grid)


def relaxing_force(time: np.ndarray, elastic: np.ndarray, fraction: float, tau: float) -> np.ndarray:
    """Return the force of a solid that loses `fraction` of its stiffness with the time constant `tau` (s), N.

    Quasi-linear viscoelasticity (Fung 1993) with one term; exact for an elastic force that is linear between samples.
    """
    memory, force = 0.0, np.empty_like(elastic)
    force[0] = elastic[0]
    for i in range(1, time.size):
        decay = np.exp(-(time[i] - time[i - 1]) / tau)
        mean = (1 - decay) * tau / max(time[i] - time[i - 1], 1e-12)
        memory = decay * memory + fraction * mean * (elastic[i] - elastic[i - 1])
        force[i] = (1 - fraction) * elastic[i] + memory
    return force


def fitted_modulus(test: Test, first: int, last: int) -> float:
    """Return the least-squares shear modulus of samples `first` to `last`, Pa: the correct result of an elastic fit."""
    unit = replace(test, mu=1.0).elastic_force(test.motion[first:last])
    return float(unit @ test.force[first:last] / (unit @ unit))


def with_noise(test: Test, rng: np.random.Generator, relative: float) -> Test:
    """Return the test with normal noise on the force; its deviation is relative to the largest force."""
    return replace(test, force=test.force + rng.normal(0.0, relative * np.abs(test.force).max(), test.force.size))


def draw_specimen(kind: str, rng: np.random.Generator) -> Specimen:
    """Draw a specimen of usual sizes, rounded to 0.1 mm."""
    def mm(low: float, high: float) -> float:
        return round(float(rng.uniform(low, high)), 1) * 1e-3

    if kind == COMPRESSION:
        diameter = mm(10, 50)
        return Specimen(diameter=diameter, length=round(diameter * rng.uniform(0.4, 1.3), 4))
    if kind == TENSION:
        return Specimen(width=mm(5, 25), thickness=mm(0.8, 4), length=mm(30, 80))
    return Specimen(width=mm(15, 40), length=mm(20, 50), thickness=mm(3, 10))


def draw_test(rng: np.random.Generator, kind: str | None = None) -> Test:
    """Draw a test with a ramp, and for some a return, a hold or cycles; without noise."""
    kind = kind or str(rng.choice(KINDS, p=(0.55, 0.3, 0.15)))
    mu = float(np.exp(rng.uniform(np.log(2e3), np.log(500e3))))
    specimen = draw_specimen(kind, rng)
    reach = {COMPRESSION: (0.15, 0.4), TENSION: (0.2, 1.0), SHEAR: (0.3, 1.0)}[kind]
    depth = float(rng.uniform(*reach)) * specimen.height(kind)
    points = int(rng.integers(60, 141))
    speed = float(rng.choice((0.1, 0.2, 0.5, 1.0, 2.0))) * 1e-3
    empty = np.zeros(1)
    test = Test(kind, mu, specimen, empty, empty, empty)
    ramp = np.linspace(0.0, depth, points)
    motion = _PROTOCOLS[str(rng.choice(tuple(_PROTOCOLS), p=(0.55, 0.2, 0.1, 0.15)))](ramp)
    return test.with_motion(depth / (points - 1) / speed * np.arange(motion.size), motion)


_PROTOCOLS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "ramp": lambda ramp: ramp,
    "return": lambda ramp: np.concatenate([ramp, ramp[-2::-1]]),
    "hold": lambda ramp: np.concatenate([ramp, np.full(ramp.size // 3, ramp[-1])]),
    "cycles": lambda ramp: np.concatenate([ramp[::2], ramp[-3::-2], ramp[2::2], ramp[-3::-2]]),
}
