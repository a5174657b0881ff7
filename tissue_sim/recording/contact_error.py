"""Estimate the error of a modulus by the uncertainty of contact: its displacement, and the drift of the force."""

from __future__ import annotations

import numpy as np

from tissue_sim.recording.contact import Contact

#: Half width of a 95 % interval in standard deviations of a normal distribution.
INTERVAL_DEVIATIONS = 1.96


def relative_modulus_error_from_contact(motion: np.ndarray, load: np.ndarray, time: np.ndarray | None,
                                        contact: Contact) -> float:
    """Return the relative half width of the 95 % interval of a modulus that the uncertainty of contact causes.

    A model force k f(x) is fitted by least squares to F(x). A contact that is d farther changes the model by -d F'(x)
    and the factor k by d <F, F'> / <F, F>, where the integral of F F' over the displacement is half of the change of
    F^2. A force error e changes k by <F, e> / <F, F>.

    Args:
        motion: displacement of the fitted samples from contact, m, positive under load, shape (n,).
        load: force, N, shape (n,).
        time: time, s, shape (n,); None: even steps.
        contact: result of `find_contact`; a status other than ``"found"`` gives 0.
    """
    if not contact.has_air_before_contact:
        return 0.0
    low, high = contact.interval
    return relative_modulus_error_from_contact_range(motion, load, time, 0.5 * (high - low), contact.drift_error)


def relative_modulus_error_from_contact_range(motion: np.ndarray, load: np.ndarray, time: np.ndarray | None,
                                              half_width: float, drift_error: float = 0.0) -> float:
    """Return the relative half width of the range of a modulus; see `relative_modulus_error_from_contact`.

    Args:
        motion: displacement of the fitted samples from contact, m, positive under load, shape (n,).
        load: force, N, shape (n,).
        time: time, s, shape (n,); None: even steps.
        half_width: half of the range in which contact may be, m.
        drift_error: standard error of the drift of the force, N/s (N per sample without time).
    """
    if motion.size < 2:
        return 0.0
    end = int(np.argmax(motion)) + 1
    motion, load = motion[:end], load[:end]
    squared = float(np.sum(0.5 * (load[1:] ** 2 + load[:-1] ** 2) * np.diff(motion)))
    if end < 2 or not squared > 0:
        return 0.0
    by_place = half_width * float(np.max(load) ** 2) / (2.0 * squared)
    clock = np.arange(end, dtype=float) if time is None else time[:end]
    drifted = INTERVAL_DEVIATIONS * drift_error * (clock - clock[0])
    return float(np.hypot(by_place, float(load @ drifted) / float(load @ load)))
