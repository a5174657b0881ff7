"""The part of a device's name that says how it is set: ``rate_hz=1000,range_N=50``."""

from __future__ import annotations

import math

from tissue_sim.errors import InputError, nearest


def read_settings(text: str, **defaults: float) -> dict[str, float]:
    """Numbers by name.

    Args:
        text: ``name=number``, with commas between; may be empty.
        defaults: all names, with what counts where one is left out; where that is a whole number, one is wanted.

    Raises:
        InputError: a name that is not among them (names the nearest), or no finite number.
    """
    settings = dict(defaults)
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, equals, value = (word.strip() for word in part.partition("="))
        if not equals:
            raise InputError(f"{part!r} sets nothing; give NAME=NUMBER, with a name of {', '.join(defaults)}",
                             field="settings")
        if name not in defaults:
            raise InputError(f"unknown setting{nearest(name, defaults)}", field=name)
        whole = isinstance(defaults[name], int)
        try:
            settings[name] = int(value) if whole else float(value)
        except ValueError:
            raise InputError(f"{value!r} is not a {'whole ' * whole}number", field=name) from None
        if not math.isfinite(settings[name]):
            raise InputError(f"{value!r} is not a finite number", field=name)
    return settings
