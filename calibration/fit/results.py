"""What a calibration leaves for tables and pictures, beside its fits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calibration.campaign.campaign import Test
from calibration.campaign.measured import MeasuredCurve


@dataclass(frozen=True, eq=False)
class TestCurves:
    """One test as one fitted law sees it.

    Forces in N, displacements in m; Pa and strain where `test.specimen` is None.

    Attributes:
        test: the test. measured: its recordings.
        time: of the model's path, s, shape (k,), or None where the rate does not matter.
        displacement: of the path, shape (k,). force: of the model there, without offset and zero, shape (k,).
        force_error: standard error of that, from the parameters and the mesh, shape (k,).
        band: half width of the 95 % band for a new recording: with noise, offset and zero, shape (k,).
        fitted: of each recording the model's force at its samples, with its own offset and zero.
        area: cross-section of the nominal stress, m2 (1 where stress was recorded); None where that is not homogeneous.
    """

    test: Test
    measured: tuple[MeasuredCurve, ...]
    time: np.ndarray | None
    displacement: np.ndarray
    force: np.ndarray
    force_error: np.ndarray
    band: np.ndarray
    fitted: tuple[np.ndarray, ...]
    area: float | None = None
