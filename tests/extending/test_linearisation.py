"""The linearised bulk of a plug-in, in multirate simulation in this process and in another one."""

import pytest

import tissue_sim as ts
from haptics.loop.multirate import MultiRateTissue, make_real_time_tissue_factory
from tissue_sim.fem.condensed.model import LINEARISATIONS
from tissue_sim.pose import Pose
from tissue_sim.tool_force import ForceStatus

MODULUS = 3000.0
MODEL = ts.Model(ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.ramp(3e-3, 3), friction="frictionless",
                               tool=ts.Tool("flat", radius=8e-3, edge_radius=1e-3)),
                 ts.Material("neo_hooke", {"C10": 0.5 * MODULUS}, ts.Bulk("bulk_ratio", 1e3)))


@pytest.fixture
def bed(plugin, registers):
    module = plugin("winkler_bed")
    registers(LINEARISATIONS, module.WinklerBed, "winkler")
    return module


@pytest.mark.slow
def test_force_of_a_flat_punch_on_a_bed_of_springs(bed):
    """All nodes below the flat face move with the tool: F = n k d."""
    tissue = make_real_time_tissue_factory(MODEL, solver="winkler", resolution="realtime", budget=None)()
    assert isinstance(tissue, MultiRateTissue)
    tissue.waits = True
    try:
        for depth, factor in ((1e-4, 1.0), (3e-4, 1.0), (2e-4, 1.0), (2e-4, 2.0), (1e-4, 2.0)):
            modulus = factor * MODULUS
            tissue.set_parameters(C10=0.5 * modulus)
            answer = tissue.step(Pose.at_depth(depth), 1e-3)
            assert answer.status is ForceStatus.CONVERGED
            assert answer.force == pytest.approx(bed.GRID.size**2 * bed.STIFFNESS * modulus * depth, rel=1e-3, abs=1e-9)
    finally:
        tissue.close()
