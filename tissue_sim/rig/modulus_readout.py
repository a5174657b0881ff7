"""Effects of a rheometer or DMA on measured storage and loss moduli: inertia, compliance in series, and delay."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tissue_sim.parameters import parameter


@dataclass(frozen=True)
class ModulusReadout:
    """Complex modulus that the instrument reads, for a true complex modulus E* of the specimen.

    The reading is (1 / (1 / E* + compliance) - inertia omega^2) exp(-i omega delay), with omega = 2 pi frequency. A
    value of 0 means that an effect is absent or that the instrument corrects it.

    Attributes:
        inertia: inertia of the moving parts over the shape factor of the specimen, Pa s2. In torsion of a cylinder it
            is I 2 h / (pi a^4) with the moment of inertia I, kg m2, the height h and the radius a, m; in tension,
            compression and shear m h / A with the moving mass m, kg, and the cross-section A, m2.
        compliance: compliance of the load train times the same factor, 1/Pa: C pi a^4 / (2 h) with C in rad/(N m), or
            C A / h with C in m/N.
        delay: delay of the load with respect to the motion, s.

    Source: inertia and compliance of oscillatory rheometers: Walters, Rheometry (1975), chapter 6.

    Examples:
        >>> ideal, heavy = ModulusReadout(), ModulusReadout(inertia=1.0)
        >>> true = np.array([2000.0 + 100.0j])
        >>> ideal.compute_reading(true, np.array([5.0])).round(1), heavy.compute_reading(true, np.array([5.0])).round(1)
        (array([2000.+100.j]), array([1013.+100.j]))
    """

    inertia: float = parameter("I", "Pa s2", key="inertia_Pa_s2", bounds=(0.0, 1e9), absent=0.0, default=0.0)
    compliance: float = parameter("c", "1/Pa", key="compliance_per_Pa", bounds=(0.0, 1.0), absent=0.0, default=0.0)
    delay: float = parameter("t_d", "s", key="delay_s", bounds=(-1.0, 1.0), absent=0.0, default=0.0)

    def compute_reading(self, modulus: np.ndarray, frequency: np.ndarray) -> np.ndarray:
        """Return the reading for true complex moduli, Pa, at frequencies, Hz; shapes (n,)."""
        omega = 2.0 * np.pi * frequency
        in_series = modulus / (1.0 + self.compliance * modulus)
        return (in_series - self.inertia * omega**2) * np.exp(-1j * omega * self.delay)
