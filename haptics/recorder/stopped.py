"""The error that ends a supervised motion, and the reason that it carries."""

from __future__ import annotations

from haptics.devices.contracts import DeviceError
from haptics.safety.motion_guard import StopReason
from tissue_sim.errors import InputError


class StoppedError(RuntimeError):
    """Error: a motion was stopped before its end.

    Attributes:
        reason: cause and message of the stop.
    """

    def __init__(self, reason: StopReason):
        super().__init__(reason.message)
        self.reason = reason


def get_stop_reason(error: BaseException) -> StopReason:
    """Convert an exception that was raised during a motion into the reason of the stop."""
    match error:
        case StoppedError():
            return error.reason
        case KeyboardInterrupt():
            return StopReason("asked", "stopped by Ctrl-C")
        case DeviceError() | InputError():
            return StopReason("device", str(error))
    return StopReason("device", f"{type(error).__name__}: {error}")
