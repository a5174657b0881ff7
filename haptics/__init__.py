"""Haptics: the 1 kHz loop, what is between the tissue and the hand, and a server for other programs.

Public names are listed here once and imported on first use.
"""

from tissue_sim.public_names import import_on_use as _import_on_use

_HOMES = {
    "VirtualCoupling": "coupling", "ForceLimits": "limits", "PassivityController": "passivity",
    "PassivityObserver": "passivity", "Watchdog": "watchdog", "WatchdogState": "watchdog",
    "LocalModel": "local_model", "LocalModelBlend": "local_model", "SlowSolver": "local_model",
    "ForceRendering": "rendering", "RenderedForce": "rendering", "RenderFlag": "rendering",
    "MotionSource": "motion_source", "ProtocolMotion": "motion_source", "RandomWalk": "motion_source",
    "SineMotion": "motion_source", "HandMotion": "motion_source",
    "LoopProcess": "loop_process", "LoopError": "loop_process", "LoopReport": "loop", "LoopSettings": "loop",
    "RingReader": "ring", "SurfaceReader": "surface_board", "SnapshotReader": "snapshot_board",
    "TissueServer": "server", "TissueClient": "client",
}

__all__ = sorted(_HOMES)
__getattr__, __dir__ = _import_on_use(__name__, _HOMES)
