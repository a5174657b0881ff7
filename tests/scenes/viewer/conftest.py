"""Shared fixtures of the viewer tests: a needle scene, a wait function, and a process pool without processes."""

from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool

import pytest
from waiting import wait_for_value

import tissue_sim as ts
from scenes.commands.shared.experiment_flags import load_material_or_study_silicone
from scenes.viewer.scene import Scene
from tissue_sim.experiment.kinds.standard_tests import NEEDLE


@pytest.fixture(scope="session")
def needle() -> Scene:
    """Needle scene with the specimen of the reference study and a depth of 4 mm."""
    experiment = NEEDLE.experiment(specimen=ts.Specimen(radius=0.04, height=0.07), protocol=ts.Protocol.ramp(4e-3, 21))
    return Scene(NEEDLE, experiment, load_material_or_study_silicone(None))


@pytest.fixture(scope="session")
def until():
    """Return `waiting.wait_for_value`."""
    return wait_for_value


class ManualPool:
    """Process pool without processes: the test sets the futures in `tasks`, a list of (arguments, future)."""

    death = BrokenProcessPool

    def __init__(self):
        self.tasks: list[tuple[tuple, Future]] = []
        self.stopped = False

    def submit(self, function, arguments):
        self.tasks.append((arguments, Future()))
        return self.tasks[-1][1]

    def abandon_tasks(self):
        self.stopped = True


@pytest.fixture
def pool(monkeypatch) -> ManualPool:
    """Manual pool that each new `ModelCurveWorker` uses."""
    pool = ManualPool()
    monkeypatch.setattr("scenes.viewer.background_simulation.ProcessPool", lambda count: pool)
    return pool
