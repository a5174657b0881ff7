"""The SOFA controller with a model of the four parts of SOFA's interface that it uses; SOFA itself is not installed."""

from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

import tissue_sim as ts
from tissue_sim.realtime.engines.sofa import make_sofa_controller

MATERIAL = ts.Material("neo_hooke", {"C10": 1000.0}, ts.Bulk("bulk_ratio", 1e3))
MODEL = ts.Model(ts.Experiment(ts.Specimen(0.030, 0.020), ts.Protocol.ramp(0.004, 2), tool=ts.Tool("flat", radius=4e-3),
                               friction="bonded"), MATERIAL)


class Data:
    """A data field: ``value``, and ``writeable()`` that yields the array in place."""

    def __init__(self, value):
        self.value = np.array(value, float)

    @contextmanager
    def writeable(self):
        yield self.value


class Controller:
    def __init__(self, *args, **options):
        self.name = options["name"]


SOFA = SimpleNamespace(Core=SimpleNamespace(Controller=Controller))


@pytest.fixture(scope="module")
def simulator():
    one = ts.Simulator(MODEL, resolution="realtime_20")
    one.warm_up()
    return one


def make_scene(depth):
    """Make root, instrument and force field; the instrument points along y, and its tip is 50 mm from its origin."""
    half = 0.5**0.5
    instrument = SimpleNamespace(position=Data([[0.0, 0.05 - depth, 0.0, -half, 0.0, 0.0, half]]),
                                 velocity=Data([[0.0] * 6]))
    return SimpleNamespace(time=SimpleNamespace(value=0.0)), instrument, SimpleNamespace(forces=Data([[0.0] * 6]))


def test_the_controller_writes_force_and_torque_about_the_origin(simulator):
    """SOFA scenes often have y up: the scene is rotated about x by -90 degrees, and so is the tool."""
    simulator.reset()
    half, (root, instrument, field) = 0.5**0.5, make_scene(2e-3)
    controller = make_sofa_controller(root, instrument, field, tissue=simulator, mass=0.1, sofa=SOFA,
                                      scene=ts.Pose((0.0, 0.0, 0.0), (half, -half, 0.0, 0.0)),
                                      tip=ts.Pose((0.0, 0.0, -0.05)))
    for tick in range(20):
        root.time.value = 0.01 * tick
        controller.onAnimateBeginEvent({})
    simulator.reset()
    force = simulator.step(2e-3, 0.0).force
    assert field.forces.value[0] == pytest.approx(np.array([0.0, force, 0.0, 0.0, 0.0, 0.0]), abs=1e-9 * force)


def test_a_reset_of_the_scene_resets_the_tissue(simulator):
    simulator.reset()
    half, (root, instrument, field) = 0.5**0.5, make_scene(2e-3)
    controller = make_sofa_controller(root, instrument, field, tissue=simulator, mass=None, sofa=SOFA,
                                      scene=ts.Pose((0.0, 0.0, 0.0), (half, -half, 0.0, 0.0)),
                                      tip=ts.Pose((0.0, 0.0, -0.05)))
    for root.time.value in (0.0, 0.01, 0.0):
        controller.onAnimateBeginEvent({})
    assert simulator.has_touched and controller.coupling.last.answer.iterations > 0
    instrument.position.value[0, 1] = 0.06  # in the air at time zero
    root.time.value = -1.0
    controller.onAnimateBeginEvent({})
    assert not simulator.has_touched and field.forces.value[0].tolist() == [0.0] * 6


def test_an_instrument_of_another_template_is_refused(simulator):
    root, instrument, field = make_scene(0.0)
    instrument.position = Data([[0.0, 0.0, 0.0]])
    with pytest.raises(ts.InputError, match="must have the template Rigid3d and one particle"):
        make_sofa_controller(root, instrument, field, tissue=simulator, mass=None, sofa=SOFA)


def test_without_sofa_the_remedy_is_named(simulator):
    with pytest.raises(ts.MissingBackendError, match="SofaPython3 is not available"):
        make_sofa_controller(*make_scene(0.0), tissue=simulator, mass=0.1)
