"""How fine a mesh this computer steps a thousand times a second."""

from __future__ import annotations

import time

from scenes.doctor.check import Check
from tissue_sim.errors import MissingBackendError

#: Wall time of a step, as `tissue-sim loop` and `serve` have it, s.
BUDGET = 0.8e-3
_NAME, COARSEST = "real-time mesh", "realtime_20"


def reached() -> Check:
    """The mesh that `resolution="realtime"` comes to under the study's needle, the mass of the tissue counted."""
    import numpy as np

    import tissue_sim as ts

    material = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
    experiment = ts.Experiment(ts.Specimen(0.040, 0.070), ts.Protocol.ramp(10e-3, 2), tool=ts.Tool("flat", 8e-3))
    start = time.perf_counter()
    try:
        simulator = ts.Simulator(ts.Model(experiment, material), budget=BUDGET, inertia="on")
        simulator.warm_up()
    except MissingBackendError as error:
        return Check(_NAME, "warn", str(error), "use one of these platforms for finite elements")
    elements, percent = len(simulator.mesh.connectivity), 100 * float(simulator.force_error or np.nan)
    finding = (f"{simulator.resolution}, {elements} elements under the study's needle, inertia counted, in "
               f"{BUDGET * 1e3:g} ms a step: its force errs by {percent:.2g} % at most; chosen after "
               f"{time.perf_counter() - start:.1f} s")
    values = {"resolution": simulator.resolution, "elements": elements, "force_error_percent": percent,
              "budget_us": BUDGET * 1e6}
    if simulator.resolution == COARSEST:
        return Check(_NAME, "warn", finding, "a finer one needs a faster processor, or one with nothing else to do: "
                     "close other programs and ask again; offline simulation is not touched by this", values)
    return Check(_NAME, "ok", finding, values=values)
