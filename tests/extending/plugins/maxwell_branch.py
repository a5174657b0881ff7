"""An effect at the points in one file: a Maxwell branch parallel to the law, an isochoric neo-Hooke spring in series
with a dashpot (Simo, CMAME 60 (1987) 153, with the recursion of Taylor, Pister and Goudreau, IJNME 2 (1970) 45)."""

from dataclasses import dataclass

import numpy as np

from tissue_sim.material.effect import PointEffect
from tissue_sim.parameters import parameter

#: Rows and columns of 11, 22, 33, 12, 13, 23.
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
UNIT = (1.0, 1.0, 1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class MaxwellBranch(PointEffect):
    """Stress of the branch Q' = S' - Q / tau, S = mu J^(-2/3) (1 - I1/3 C^-1).

    The state is Q, then S at the start of the step.
    """

    name = "maxwell_branch"
    title = "Maxwell branch"
    is_time_dependent = True
    rest = (0.0,) * 12

    mu: float = parameter("mu_m", "Pa", key="mu_Pa", bounds=(0.0, 1e6), absent=0.0)
    tau: float = parameter("tau_m", "s", key="tau_s", bounds=(1e-3, 1e4))

    def response(self, C, state, dt):
        S, D = spring(C, self.mu)
        share = dt / self.tau
        decay = np.exp(-share)
        # Within the step S changes linearly in time; a sudden one (dt = 0) takes all of it.
        gain = np.where(share > 1e-6, (1.0 - decay) / np.maximum(share, 1e-6), 1.0 - 0.5 * share)
        Q = [decay * state[i] + gain * (S[i] - state[6 + i]) for i in range(6)]
        return Q, [[gain * entry for entry in row] for row in D], [*Q, *S]


def spring(C, mu):
    """Second Piola-Kirchhoff stress and tangent of the isochoric neo-Hooke spring."""
    a, b, c, d, e, f = C
    det = a * (b * c - f * f) - d * (d * c - f * e) + e * (d * f - b * e)
    K = [(b * c - f * f) / det, (a * c - e * e) / det, (a * b - d * d) / det,
         (e * f - d * c) / det, (d * f - b * e) / det, (d * e - a * f) / det]
    scale = mu * np.exp(-np.log(det) / 3.0)
    third = (a + b + c) / 3.0
    S = [scale * (UNIT[i] - third * K[i]) for i in range(6)]
    full = [[K[0], K[3], K[4]], [K[3], K[1], K[5]], [K[4], K[5], K[2]]]

    def entry(m, n):
        (i, j), (k, o) = PAIRS[m], PAIRS[n]
        swapped = 0.5 * (full[i][k] * full[j][o] + full[i][o] * full[j][k])
        return 2.0 / 3.0 * scale * (third * (3.0 * swapped + K[m] * K[n]) - UNIT[m] * K[n] - K[m] * UNIT[n])

    return S, [[entry(m, n) for n in range(6)] for m in range(6)]
