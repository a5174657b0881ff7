"""Virtual bench with a simulated clock: a run of minutes takes no real time, at any load of the computer."""

import itertools

from haptics.devices.contracts import StageLimits
from haptics.devices.virtual.faults import Faults
from haptics.devices.virtual.rig import VirtualRig
from haptics.recorder.plan import BenchTestPlan
from haptics.recorder.recorder import Recorder
from haptics.recorder.run_folder import RunFolder
from haptics.safety.motion_guard import GUARD, MotionLimits
from tissue_sim import Rig
from tissue_sim.experiment.protocol_legs import iterate_motion_legs
from tissue_sim.experiment.protocol_text import parse_protocol

#: Stiffness of the spring, N/m.
STIFFNESS = 400.0
#: Position of the surface of the spring, m.
SURFACE = 2e-3


class Clock:
    """Simulated clock, s; it advances only in `sleep`."""

    def __init__(self):
        self.now = 1000.0

    def __call__(self):
        return self.now

    def sleep(self, seconds):
        self.now += max(seconds, 1e-6)


class Spring:
    """Linear spring without tension.

    Attributes:
        stiffness: N/m.
    """

    def __init__(self, stiffness=STIFFNESS):
        self.stiffness = stiffness

    def advance_and_get_force(self, time, depth):
        return self.stiffness * max(depth, 0.0)


class VirtualBench:
    """Recorder on a virtual rig; a test can change every part."""

    def __init__(self, folder):
        self.folder, self.clock = folder, Clock()
        self.moments = []
        #: Counter that gives the order of halts and stops of the stage.
        self._order = itertools.count()
        self.halts, self.stops = [], []

    def limits(self, **changes):
        return MotionLimits(**{"force": 5.0, "lowest": -5e-3, "highest": 10e-3, "speed": 5e-3, "duration": 600.0,
                               "stiffness": 1000.0, "force_margin": 2.0, **changes})

    def plan(self, protocol="ramp 3mm @2mm/s; hold 0.5s; unload", **changes):
        return BenchTestPlan(**{"name": "spring", "legs": tuple(iterate_motion_legs(parse_protocol(protocol), 1e-3,
                                                                               allows_force=True)),
                                "replicates": 2, "contact_force": 0.05, "approach_speed": 2e-3, **changes})

    def rig(self, specimen=None, rig=None, **options):
        options = {"resolution": 1e-4, "rate": 500.0, "surface": SURFACE, "start_at": -3e-3, **options}
        return VirtualRig(specimen or Spring(), rig or Rig(), clock=self.clock,
                          limits=options.pop("limits", StageLimits(-0.01, 0.02, 0.01)), **options)

    def goals_of(self, rig):
        """Return a list that collects the commanded positions from now on, m."""
        goals, move = [], rig.stage.move
        rig.stage.move = lambda position, speed: (goals.append(position), move(position, speed))[1]
        return goals

    def run(self, *, plan=None, limits=None, rig=None, faults=None, stop_request=lambda: None, digest="a",
            on_progress=None, guard_settings=GUARD, **options):
        plan, limits = plan or self.plan(), limits or self.limits()
        self.virtual = rig or self.rig(faults=faults or Faults(), **options)
        if rig is None:
            stage, halt, stop = self.virtual.stage, self.virtual.stage.halt, self.virtual.stage.stop
            stage.halt = lambda: (self.halts.append(next(self._order)), halt())[1]
            stage.stop = lambda: (self.stops.append(next(self._order)), stop())[1]
        self.run_folder = RunFolder(self.folder, digest)
        with self.run_folder:
            recorder = Recorder(self.virtual.bench, plan, limits, self.run_folder, stop_request=stop_request,
                                on_progress=on_progress or self.moments.append, clock=self.clock,
                                sleep=self.clock.sleep, guard_settings=guard_settings)
            recorder.run()
        return self.run_folder
