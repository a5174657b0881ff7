"""The part of a device's name that says how it is set: ``rate_hz=1000,range_N=50``."""

from __future__ import annotations

import sys

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
        # A comparison, which whole numbers beyond any float stand.
        if not abs(settings[name]) <= sys.float_info.max:
            raise InputError(f"{value!r} is not a finite number", field=name)
    return settings


def split_place(text: str, what: str, example: str) -> tuple[str, str]:
    """The port, file or number that stands before the settings, and the settings.

    Args:
        text: ``/dev/ttyUSB0,baud=9600``.
        what: the first part is, in messages: ``"the port of the controller"``.
        example: of the whole.

    Raises:
        InputError: the first part is missing.
    """
    place, _, rest = text.partition(",")
    if not place.strip() or "=" in place:
        raise InputError(f"{what} is missing; give it first, as in {example}", field="name")
    return place.strip(), rest


def take_words(text: str, **choices: tuple[str, ...]) -> tuple[dict[str, str], str]:
    """Settings that are words, and the rest of the text, for `read_settings`.

    Args:
        text: ``name=value``, with commas between.
        choices: name -> words that it may be, the first of them where it is left out; a first word that is empty:
            any word.

    Raises:
        InputError: another word (names the nearest).
    """
    words, rest = {name: allowed[0] for name, allowed in choices.items()}, []
    for part in text.split(","):
        name, equals, value = (word.strip() for word in part.partition("="))
        if not equals or name not in choices:
            rest.append(part)
            continue
        if choices[name][0] and value not in choices[name]:
            raise InputError(f"{value!r} is none of them{nearest(value, choices[name])}", field=name)
        words[name] = value
    return words, ",".join(rest)
