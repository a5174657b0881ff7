"""An adapter of a physics engine from one file."""

import pytest

import tissue_sim as ts
from tissue_sim.tool_force import ForceStatus

MATERIAL = ts.Material("neo_hooke", {"C10": 2000.0}, ts.Bulk("bulk_ratio", 1e3))
MODEL = ts.Model(ts.Experiment(ts.Specimen(0.030, 0.020), ts.Protocol.ramp(0.004, 2), tool=ts.Tool("flat", radius=4e-3),
                               friction="bonded"), MATERIAL)


def test_a_body_falls_on_tissue_which_carries_its_weight(plugin):
    engine = plugin("falling_body_engine")
    simulator = ts.Simulator(MODEL, resolution="realtime_20")
    body = engine.FallingBody(mass=0.02, height=5e-4, damping=0.5)
    tissue = engine.FallingBodyTissue(body, simulator)
    statuses = set()
    for _ in range(1500):
        wrench = tissue.apply()
        statuses.add(wrench.status)
        body.step(1e-3)
    weight = 0.02 * 9.81
    assert wrench.force == pytest.approx((0.0, weight, 0.0), rel=1e-4, abs=1e-6)
    assert wrench.status is ForceStatus.CONVERGED and statuses <= {ForceStatus.CONVERGED, ForceStatus.LATE}
    simulator.reset()
    assert simulator.step(-body.position[1], 0.0).force == pytest.approx(weight, rel=1e-4)
