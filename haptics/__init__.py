"""Haptics: the 1 kHz loop, what is between the tissue and the hand, and a server for other programs.

Public names are listed here once and imported on first use.
"""

from tissue_sim.public_names import import_on_use as _import_on_use

_HOMES = {
    "VirtualCoupling": "safety.coupling", "ForceLimits": "safety.limits", "PassivityController": "safety.passivity",
    "PassivityObserver": "safety.passivity", "Watchdog": "safety.watchdog", "WatchdogState": "safety.watchdog",
    "LocalModel": "loop.local_model", "LocalModelBlend": "loop.local_model", "SlowSolver": "loop.local_model",
    "ForceRendering": "safety.rendering", "RenderedForce": "safety.rendering", "RenderFlag": "safety.rendering",
    "MotionSource": "devices.motion_source", "ProtocolMotion": "devices.motion_source",
    "RandomWalk": "devices.motion_source",
    "SineMotion": "devices.motion_source", "HandMotion": "devices.motion_source",
    "LoopProcess": "loop.process", "LoopError": "loop.process", "LoopReport": "loop.loop", "LoopSettings": "loop.loop",
    "RingReader": "loop.ring", "SurfaceReader": "loop.surface_board", "SnapshotReader": "loop.snapshot_board",
    "TissueServer": "server.server", "TissueClient": "server.client",
}

__all__ = sorted(_HOMES)
__getattr__, __dir__ = _import_on_use(__name__, _HOMES)
