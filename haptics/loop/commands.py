"""Commands to a running loop by name."""

from __future__ import annotations

from collections.abc import Callable

from haptics.loop.loop import Loop

#: Name of a command -> method that executes it between two ticks with the values of the command as arguments.
COMMANDS: dict[str, Callable[..., None]] = {
    "pause": Loop.pause,
    "resume": Loop.resume,
    "reset": Loop.reset,
    "advance": Loop.advance_paused_motion,
    "switch_device": Loop.switch_device,
    "aim": Loop.aim,
    "set_parameters": Loop.set_parameters,
    "stop": Loop.stop,
}
