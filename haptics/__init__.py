"""Haptics: the 1 kHz loop, what is between the tissue and the hand, and a server for other programs.

Public names are listed here once and imported on first use.
"""

from tissue_sim.public_names import import_on_use as _import_on_use

_HOMES = {
    "VirtualCoupling": "safety.coupling", "ForceLimits": "safety.limits", "PassivityController": "safety.passivity",
    "PassivityObserver": "safety.passivity", "Watchdog": "safety.watchdog", "WatchdogState": "safety.watchdog",
    "LocalModel": "loop.local_model", "LocalModelBlend": "loop.local_model", "SlowSolver": "loop.local_model",
    "ForceRendering": "safety.rendering", "RenderedForce": "safety.rendering", "RenderFlag": "safety.rendering",
    "HapticDevice": "devices.contracts", "ForceSensor": "devices.contracts", "Stage": "devices.contracts",
    "Motion": "devices.contracts", "AxialMotion": "devices.contracts", "DeviceError": "devices.contracts",
    "ForceSample": "devices.contracts", "StageSample": "devices.contracts", "StageLimits": "devices.contracts",
    "SampleStatus": "devices.contracts",
    "open_motion": "devices.back_ends", "open_sensor": "devices.back_ends", "open_stage": "devices.back_ends",
    "open_haptic": "devices.back_ends", "MOTIONS": "devices.back_ends", "FORCE_SENSORS": "devices.back_ends",
    "STAGES": "devices.back_ends", "HAPTIC_DEVICES": "devices.back_ends",
    "ProtocolMotion": "devices.motions", "RandomWalk": "devices.motions", "SineMotion": "devices.motions",
    "HandMotion": "devices.motions",
    "LoopProcess": "loop.process", "LoopError": "loop.process", "LoopReport": "loop.loop", "LoopSettings": "loop.loop",
    "RingReader": "loop.ring", "SnapshotReader": "loop.snapshot_board",
    "TissueServer": "server.server", "TissueClient": "server.client",
}

__all__ = sorted(_HOMES)
__getattr__, __dir__ = _import_on_use(__name__, _HOMES)
