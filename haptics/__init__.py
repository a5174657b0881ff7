"""Haptics: the 1 kHz loop, what is between the tissue and the hand, and a server for other programs.

Public names are listed once, in `__init__.pyi`, and imported on first use.
"""

from tissue_sim.public_names import make_lazy_package_members as _import_on_use

#: Old public names -> new names.
_RENAMED = {"open_motion": "make_motion", "open_sensor": "make_sensor", "open_stage": "make_stage",
            "open_haptic": "make_haptic_device", "HandMotion": "TargetFollowingMotion", "ForceLimits": "ForceLimiter"}
#: Old names of modules that programs of users import -> new names.
_MOVED = {
    "haptics.emulators.terminal": "haptics.emulators.emulator",
    "haptics.loop.local_model": "tissue_sim.realtime.local_model",
    "haptics.loop.real_time": "haptics.loop.ticker",
    "haptics.loop.snapshot_board": "haptics.loop.shared_slots",
    "haptics.loop.tissue_factory": "haptics.loop.multirate",
    "haptics.safety.force_release": "haptics.safety.limits",
    "haptics.safety.watchdog": "haptics.safety.limits",
    "haptics.server.scene_limits": "haptics.server.steps",
}
_names, __getattr__, __dir__ = _import_on_use(__name__, _RENAMED, _MOVED)
__all__ = _names
