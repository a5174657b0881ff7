"""What a relaxation fit is compared with: stress as a function of moduli, exponents and relaxation times."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import combinations_with_replacement

import numpy as np

from calibration.analytical.uniaxial import EXPONENTS
from tissue_sim.closed_form.histories import HomogeneousHistory
from tissue_sim.errors import InputError
from tissue_sim.laws import Law
from tissue_sim.material.viscoelasticity import internal_stress
from tissue_sim.recording.recording import Recording

#: The history is divided less finely than for a prediction: 1e-4 of the largest stress, below what is measured.
LARGEST_STEP = 0.01
#: A hold that moves more than this share of its displacement is not one.
HELD = 0.05


class _Model:
    """P = elastic + sum r_i relaxing_i with long-term moduli and r_i = g_i / (1 - sum g).

    Attributes:
        law_name: None without a law.
        names: parameters. moduli: whether each scales the stress (or is an exponent), bool, shape (m,).
        data: Pa (N), shape (n,). index: number of the recording of each sample, shape (n,).
        time_range: the usual step and the length of the longest record, s.
    """

    law_name: str | None
    names: tuple[str, ...]
    moduli: np.ndarray

    def _take(self, times: Sequence[np.ndarray], data: Sequence[np.ndarray]) -> None:
        self.data = np.concatenate(data)
        self.index = np.repeat(np.arange(len(data)), [values.size for values in data])
        steps = np.concatenate([np.diff(time) for time in times])
        if not (steps > 0).any():
            raise InputError("the time does not advance; relaxation needs samples at different times", field="time")
        self.time_range = float(np.median(steps[steps > 0])), max(float(np.ptp(time)) for time in times)

    def parts(self, values: np.ndarray, tau: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """`elastic`, shape (n,), and `relaxing`, shape (n, terms)."""
        raise TypeError(f"{type(self).__name__} must state its parts")

    def exponents(self) -> Iterator[np.ndarray]:
        """Values to start from, with moduli of 1."""
        places = np.flatnonzero(~self.moduli)
        for grid in combinations_with_replacement(EXPONENTS, places.size):
            if len(set(grid)) >= min(len(grid), 2):
                values = np.ones(self.moduli.size)
                values[places] = grid
                yield values

    def moduli_by_least_squares(self, values: np.ndarray, tau: np.ndarray, shares: np.ndarray) -> np.ndarray:
        """The same exponents with the moduli that fit best at these times and shares."""
        places, columns = np.flatnonzero(self.moduli), []
        for place in places:
            alone = np.where(self.moduli, 0.0, values)
            alone[place] = 1.0
            elastic, relaxing = self.parts(alone, tau)
            columns.append(elastic + relaxing @ shares)
        found, matrix = np.array(values), np.column_stack(columns)
        found[places] = np.linalg.lstsq(matrix, self.data, rcond=1e-9)[0] if np.isfinite(matrix).all() else np.nan
        return found

    def neighbour_correlation(self, residual: np.ndarray) -> float:
        """Correlation of each residual with the next of its recording."""
        same = np.diff(self.index) == 0
        squares = float(residual @ residual)
        return float(residual[:-1][same] @ residual[1:][same]) / squares if squares else 0.0


class LawModel(_Model):
    """Homogeneous tests of a law.

    Raises:
        InputError: a recording without time, nominal stress, and stretch or shear strain.
    """

    def __init__(self, law: Law, recordings: Sequence[Recording]):
        if not recordings:
            raise InputError("no recording; give at least one", field="recordings")
        self.law, self.law_name, self.names = law, law.name, law.parameters
        self.moduli = np.array([law.units[name] != "1" for name in law.parameters])
        self.histories = []
        for recording in recordings:
            strain = "shear strain" if "shear strain" in recording else "stretch"
            self.histories.append(HomogeneousHistory("simple_shear" if strain == "shear strain" else "uniaxial",
                                                     recording.time, recording.channel(strain), LARGEST_STEP))
        self._take([recording.time for recording in recordings],
                   [recording.channel("nominal stress") for recording in recordings])

    def parts(self, values, tau):
        # Wild trial values overflow; the optimiser turns back from what is not finite.
        with np.errstate(all="ignore"):
            parts = [history.parts(self.law, values, tau) for history in self.histories]
        return np.concatenate([elastic for elastic, _ in parts]), np.concatenate([relaxing for _, relaxing in parts])


class HoldModel(_Model):
    """Force at constant displacement after a ramp of a given length, s, of which the elastic force is linear in time.

    Raises:
        InputError: a recording without time and force, a displacement that is not held, a negative ramp.
    """

    law_name = None

    def __init__(self, recording: Recording, ramp: float):
        if not 0 <= ramp < np.inf:
            raise InputError(f"{ramp:g} s is not a duration; give the time that the loading took", field="ramp")
        channel = "nominal stress" if "nominal stress" in recording and "force" not in recording else "force"
        self.names, self.moduli = (channel,), np.array([True])
        if "displacement" in recording and np.ptp(recording.displacement) > HELD * np.abs(recording.displacement).max():
            raise InputError("the displacement moves during the hold; select the samples of the hold, "
                             "recording.select(recording.labels['segment'] == 'hold')", field="displacement")
        self._take([recording.time], [recording.channel(channel)])
        self.dt = np.concatenate([[ramp], np.diff(recording.time)])
        self.elastic = np.ones((self.data.size, 1))

    def parts(self, values, tau):
        relaxing = internal_stress(self.dt, self.elastic, tau)[:, 0]
        return values[0] * self.elastic[:, 0], values[0] * relaxing
