"""Find the finest mesh that this computer can step at 1 kHz."""

from __future__ import annotations

import time

from scenes.doctor.check import CheckResult
from tissue_sim.errors import MissingBackendError

#: Name of the check.
_NAME = "real-time mesh"
#: Name of the coarsest real-time resolution.
COARSEST = "realtime_20"


def report_selected_realtime_resolution() -> CheckResult:
    """Report the mesh that `resolution="realtime"` selects here for the needle of the reference study, with inertia."""
    import numpy as np

    import tissue_sim as ts
    from haptics.loop.tissue_factory import STEP_BUDGET

    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
    experiment = ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(10e-3, 2), tool=ts.Tool("flat", 8e-3))
    start = time.perf_counter()
    try:
        simulator = ts.Simulator(ts.Model(experiment, material), budget=STEP_BUDGET, inertia="on")
        simulator.warm_up()
    except MissingBackendError as error:
        return CheckResult(_NAME, "warn", str(error),
                           "use Linux x86-64, Windows or a Mac with Apple silicon for finite elements")
    elements, percent = len(simulator.mesh.connectivity), 100 * float(simulator.force_error or np.nan)
    finding = (f"{simulator.resolution}, {elements} elements for the needle of the study with inertia, in "
               f"{STEP_BUDGET * 1e3:g} ms per step: force error at most {percent:.2g} %; selected in "
               f"{time.perf_counter() - start:.1f} s")
    values = {"resolution": simulator.resolution, "elements": elements, "force_error_percent": percent,
              "budget_us": STEP_BUDGET * 1e6}
    if simulator.resolution == COARSEST:
        return CheckResult(_NAME, "warn", finding, "a finer mesh needs a faster or less busy processor: close other "
                           "programs and run the check again; offline simulation is not affected", values)
    return CheckResult(_NAME, "ok", finding, values=values)
