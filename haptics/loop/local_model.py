"""Old names of `tissue_sim.realtime.local_model`."""

from tissue_sim.public_names import make_getattr_for_old_names

__getattr__ = make_getattr_for_old_names(__name__, {
    name: f"tissue_sim.realtime.local_model:{name}" for name in ("LocalModel", "LocalModelBlend", "SlowSolver")})
