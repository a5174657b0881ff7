"""What a loop that runs may be asked for, by name."""

from __future__ import annotations

from collections.abc import Callable

from haptics.loop.loop import Loop

#: Name -> what is done with the loop, between two ticks; the values of a command are its arguments.
COMMANDS: dict[str, Callable[..., None]] = {
    "pause": Loop.pause,
    "resume": Loop.resume,
    "reset": Loop.reset,
    "advance": Loop.advance,
    "follow": Loop.follow,
    "aim": Loop.aim,
    "set_parameters": Loop.set_parameters,
    "stop": Loop.stop,
}
