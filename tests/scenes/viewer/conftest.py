"""What tests of the viewer share: the needle in the study's specimen, patience, and stand-ins for slow processes."""

import time
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool

import pytest

import tissue_sim as ts
from scenes.commands.shared.tissue_flags import read_material
from scenes.viewer.scene import Scene
from tissue_sim.experiment.kinds.indentation import NEEDLE


@pytest.fixture(scope="session")
def needle() -> Scene:
    """The needle in the study's specimen, to 4 mm."""
    experiment = NEEDLE.experiment(specimen=ts.Specimen(radius=0.04, height=0.07), protocol=ts.Protocol.ramp(4e-3, 21))
    return Scene(NEEDLE, experiment, read_material(None))


@pytest.fixture(scope="session")
def until():
    """Look again and again until what is seen fits, and return that."""
    def until(look, fits, seconds=600.0):
        deadline = time.monotonic() + seconds
        while not fits(seen := look()):
            assert time.monotonic() < deadline, f"this is still so: {seen}"
            time.sleep(0.005)
        return seen

    return until


class PoolByHand:
    """A pool without processes, whose tasks the test answers: `tasks` are their arguments and futures."""

    death = BrokenProcessPool

    def __init__(self):
        self.tasks: list[tuple[tuple, Future]] = []
        self.stopped = False

    def submit(self, function, arguments):
        self.tasks.append((arguments, Future()))
        return self.tasks[-1][1]

    def stop(self):
        self.stopped = True


@pytest.fixture
def pool(monkeypatch) -> PoolByHand:
    """The pool of every `ModelCurve` that is made."""
    pool = PoolByHand()
    monkeypatch.setattr("scenes.viewer.model_curve.ProcessPool", lambda count: pool)
    return pool
