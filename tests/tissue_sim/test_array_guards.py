"""Kernels do not write beyond the ends of their arrays, and simulators share no state."""

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.fem.taichi import origins
from tissue_sim.fem.taichi.launch import BoundKernel

#: Byte in the unused memory on both sides of each array.
GUARD = 0xA5
SPECIMEN = ts.Specimen(0.020, 0.015)
PROTOCOL = ts.Protocol.ramp(1e-3, 5)
NEO_HOOKE = ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("bulk_ratio", 1e3))
RELAXING = ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("bulk_ratio", 1e3),
                       viscoelastic=ts.Prony((ts.PronyTerm(0.3, 0.5),)))


def make_model(friction, material=NEO_HOOKE):
    return ts.Model(ts.Experiment(SPECIMEN, PROTOCOL, ts.Tool("flat", radius=5e-3, edge_radius=0.5e-3),
                                  friction=friction), material)


@pytest.fixture
def guarded_maps(monkeypatch):
    """Maps of all arrays that are allocated in a test; after each kernel their guards are checked."""
    maps, map_memory, call = [], origins._map_memory, BoundKernel.__call__

    def map_with_guards(used):
        memory, end = map_memory(used), origins.ALIGNMENT + used
        memory[: origins.ALIGNMENT] = bytes([GUARD]) * origins.ALIGNMENT
        memory[end:] = bytes([GUARD]) * (len(memory) - end)
        maps.append((memory, end))
        return memory

    def call_and_check_guards(kernel):
        call(kernel)
        assert all(set(memory[: origins.ALIGNMENT] + memory[end:]) == {GUARD} for memory, end in maps)

    monkeypatch.setattr(origins, "_map_memory", map_with_guards)
    monkeypatch.setattr(BoundKernel, "__call__", call_and_check_guards)
    return maps


@pytest.mark.parametrize(("friction", "material"), [("bonded", NEO_HOOKE), (0.5, NEO_HOOKE), (0.5, RELAXING)])
def test_kernels_of_a_simulator_write_within_their_arrays(guarded_maps, friction, material):
    simulator = ts.Simulator(make_model(friction, material), inertia="off")
    for depth in (5e-5, 1e-4, 1.5e-4, 1e-4, -5e-5, 5e-5):
        assert simulator.step(depth, 1e-3).status is ts.ForceStatus.CONVERGED
    assert len(guarded_maps) > 60


@pytest.mark.slow
@pytest.mark.parametrize("solver", ["axisymmetric", "solid"])
def test_kernels_of_sensitivities_and_solids_write_within_their_arrays(guarded_maps, solver):
    model = make_model("frictionless" if solver == "solid" else 0.5, RELAXING)
    if solver == "solid":
        recording = ts.simulate(model, solver="solid", resolution="realtime")
    else:
        recording = ts.simulate(model, resolution="realtime")
        ts.sensitivities(model, ["C10"], resolution="realtime")
    assert recording.force[-1] > 0.0 and len(guarded_maps) > 20


def test_interleaved_simulators_have_the_forces_of_each_alone():
    models = [make_model("bonded"), make_model(0.5, RELAXING)]
    depths = (1e-4, 3e-4, 5e-4, 2e-4, -1e-4, 4e-4)
    alone = []
    for model in models:
        simulator = ts.Simulator(model)
        alone.append([simulator.step(depth, 1e-3).force for depth in depths])
    simulators = [ts.Simulator(model) for model in models]
    together = [[simulator.step(depth, 1e-3).force for simulator in simulators] for depth in depths]
    np.testing.assert_array_equal(np.transpose(together), alone)
