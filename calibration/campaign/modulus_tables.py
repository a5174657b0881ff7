"""Tables of storage and loss modulus of a rheometer or DMA: the values that a fit compares with the complex modulus.

A table ``[[test]]`` whose columns are moduli gives two tests, one for each modulus. The fit compares logarithms,
because the noise of moduli is proportional to their values.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.statistics.sensor_noise import SensorNoise
from tissue_sim.errors import InputError
from tissue_sim.experiment.kinds.kind import MODULI, TestKind
from tissue_sim.recording.moduli import add_storage_and_loss_modulus
from tissue_sim.recording.recording import MIN_POINTS, Recording

if TYPE_CHECKING:
    from calibration.campaign.schema import TestTable

#: Number of neighbouring frequencies whose logarithms of the modulus are compared with a cubic polynomial.
_NEIGHBOURS = 5
#: Smallest relative noise of a modulus; exact synthetic tables would give zero.
_SMALLEST_NOISE = 1e-9
#: Key of ``[[test]]`` without effect on a table of moduli -> reason, or remedy.
_UNUSED_KEYS = {"specimen": "moduli do not depend on the sizes of the specimen",
                "rig": "state readout.inertia_Pa_s2, readout.compliance_per_Pa or readout.delay_s in [fit.fixed]",
                "protocol": "a table has no motion", "max_strain": "a table has no motion",
                "speed_mm_s": "a table has no motion", "tool": "a table has no tool"}


def list_moduli_of_table(entry: TestTable, columns: Mapping[str, Any] | None, method: str, field: str) -> list[str]:
    """Return the moduli that a table ``[[test]]`` compares with the model; empty for recordings of a motion.

    Args:
        entry: table of the test.
        columns: channel -> column; None: not stated.
        method: method of the fit.
        field: field of the test, for messages.

    Raises:
        InputError: a key without effect on a table of moduli, ``pre_strain`` without such a table, or the analytical
            method.
    """
    if columns is None or "frequency" not in columns:
        if entry.pre_strain is not None:
            raise InputError("pre_strain must be left out for a recording of a motion, because it applies to tables of "
                             "storage and loss modulus. Remove pre_strain", field=f"{field}.pre_strain")
        return []
    if method == "analytical":
        raise InputError("fit.method must be 'inverse_fem' for a table of moduli, because it weights each test by its "
                         "noise; got 'analytical'. Set fit.method = 'inverse_fem'; it also uses closed forms",
                         field=f"{field}.columns.frequency")
    for key, remedy in _UNUSED_KEYS.items():
        if getattr(entry, key) is not None:
            raise InputError(f"{key} must not be given for a table of storage and loss modulus: {remedy}. Remove {key}",
                             field=f"{field}.{key}")
    return list(MODULI)


def convert_pre_strain_to_abscissa(entry: TestTable, kind: TestKind, field: str) -> float:
    """Return the stretch or shear strain about which the specimen oscillates.

    Raises:
        InputError: a pre-strain that is not finite, or 1 or more in compression.
    """
    strain = 0.0 if entry.pre_strain is None else entry.pre_strain
    if not np.isfinite(strain) or (kind.sign < 0 and strain >= 1.0) or (kind.require_closed_form().rest and
                                                                        strain <= -1.0):
        raise InputError(f"pre_strain must be a nominal strain, positive under load and below 1 in compression; got "
                         f"{strain:g}", field=f"{field}.pre_strain")
    return float(kind.convert_nominal_strain_to_stretch_or_shear_strain(strain))


def get_frequency_and_log_modulus(recording: Recording, modulus: str, left_out: Sequence[int],
                                  path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return frequency, Hz, ascending, and the logarithm of a modulus in Pa; shapes (n,).

    Args:
        recording: recording with a frequency and two moduli.
        modulus: channel of the modulus.
        left_out: numbers of the rows, from 1, that are left out.
        path: file of the recording, for messages.

    Raises:
        InputError: a frequency or a modulus that is not positive, or too few rows.
    """
    kept = np.setdiff1d(np.arange(len(recording)), np.array(left_out, dtype=int) - 1)
    recording = add_storage_and_loss_modulus(recording.select(kept))
    for channel in ("frequency", modulus):
        wrong = np.flatnonzero(recording.channel(channel) <= 0.0)
        if wrong.size:
            raise InputError(f"{path.name}: {channel} must be positive, because its noise is proportional to it; "
                             f"got {recording.channel(channel)[wrong[0]]:g} in row {kept[wrong[0]] + 1}. Leave rows "
                             f"out with leave_out = {(kept[wrong] + 1).tolist()}", field="recordings")
    if len(recording) < MIN_POINTS:
        raise InputError(f"{path.name} must have at least {MIN_POINTS} rows; got {len(recording)}", field="recordings")
    order = np.argsort(recording.channel("frequency"), kind="stable")
    return recording.channel("frequency")[order], np.log(recording.channel(modulus)[order])


def estimate_noise_of_moduli(curves: Sequence[tuple[np.ndarray, np.ndarray]], stated: float | None) -> SensorNoise:
    """Return the relative noise of one modulus of a test, the same at all frequencies.

    The estimate is the root mean square of pseudo-residuals. A pseudo-residual is the combination of 5 neighbouring
    values, with the variance of one value, that is zero for cubic polynomials in the logarithm of the frequency.

    Args:
        curves: frequency, ascending, and logarithm of the modulus of each table, shapes (n,).
        stated: stated noise; None: estimated.

    Source: Gasser, Sroka and Jennen-Steinmetz, Biometrika 73 (1986) 625.
    """
    if stated is not None:
        return SensorNoise(stated)
    residuals = []
    for frequency, logarithm in curves:
        position = np.log(frequency)
        for first in range(frequency.size - _NEIGHBOURS + 1):
            part = slice(first, first + _NEIGHBOURS)
            local = position[part] - position[part].mean()
            basis = np.vander(local / (np.ptp(local) or 1.0), _NEIGHBOURS - 1)
            residuals.append(np.linalg.svd(basis.T)[2][-1] @ logarithm[part])
    deviation = float(np.sqrt(np.mean(np.square(residuals))))
    return SensorNoise(max(deviation, _SMALLEST_NOISE), source="estimated")
