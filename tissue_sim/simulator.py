"""Old names of `tissue_sim.realtime.simulator`."""

from tissue_sim.public_names import make_getattr_for_old_names

__getattr__ = make_getattr_for_old_names(__name__, {
    name: f"tissue_sim.realtime.simulator:{name}" for name in ("DENSITY", "TOLERANCE", "Simulator", "SimulatorState")})
