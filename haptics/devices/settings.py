"""Parse the settings in the name of a device, such as ``rate_hz=1000,range_N=50``."""

from __future__ import annotations

import sys

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.public_names import make_getattr_for_old_names

__getattr__ = make_getattr_for_old_names(__name__, {
    "read_settings": "parse_number_settings",
    "read_word_settings_and_remaining_text": "parse_word_settings_and_remaining_text"})


def parse_number_settings(text: str, **defaults: float) -> dict[str, float]:
    """Parse ``name=number`` settings, and return the number of every permitted name, given or default.

    Args:
        text: Settings ``name=number``, separated by commas; may be empty.
        defaults: Default of each permitted name; an integer default permits integers only.

    Raises:
        InputError: A name is not permitted (the message names the nearest), or a value is not a finite number.
    """
    settings = dict(defaults)
    for part in filter(None, (part.strip() for part in text.split(","))):
        name, equals, value = (word.strip() for word in part.partition("="))
        if not equals:
            raise InputError(f"a setting must be NAME=NUMBER with NAME one of {', '.join(defaults)}; got {part!r}",
                             field="settings")
        if name not in defaults:
            raise InputError(f"unknown setting{make_hint_with_similar_or_known_words(name, defaults)}", field=name)
        whole = isinstance(defaults[name], int)
        try:
            settings[name] = int(value) if whole else float(value)
        except ValueError:
            raise InputError(f"the value must be a {'whole ' * whole}number; got {value!r}", field=name) from None
        # A comparison instead of math.isfinite, which overflows for integers beyond the range of a float.
        if not abs(settings[name]) <= sys.float_info.max:
            raise InputError(f"the value must be a finite number; got {value!r}", field=name)
    return settings


def split_address_and_settings_text(text: str, quantity: str, example: str) -> tuple[str, str]:
    """Split text into the port, file or number at its beginning and the settings after the first comma.

    Args:
        text: Such as ``/dev/ttyUSB0,baud=9600``.
        quantity: Description of the first part for messages, such as ``"the port of the controller"``.
        example: A complete name for messages.

    Returns:
        The first part, and the unparsed text of the settings, which may be empty.

    Raises:
        InputError: The first part is missing.
    """
    target, _, rest = text.partition(",")
    if not target.strip() or "=" in target:
        raise InputError(f"{quantity} is missing; give it first, as in {example}", field="name")
    return target.strip(), rest


def parse_word_settings_and_remaining_text(text: str, **choices: tuple[str, ...]) -> tuple[dict[str, str], str]:
    """Return the settings whose values are words, by name with defaults, and the other settings as text.

    Args:
        text: Settings ``name=value``, separated by commas.
        choices: Permitted words by name; the first one is the default. An empty first word permits any word.

    Raises:
        InputError: A word is not permitted (the message names the nearest).
    """
    words, rest = {name: allowed[0] for name, allowed in choices.items()}, []
    for part in text.split(","):
        name, equals, value = (word.strip() for word in part.partition("="))
        if not equals or name not in choices:
            rest.append(part)
            continue
        if choices[name][0] and value not in choices[name]:
            raise InputError(f"the value must be one of {', '.join(choices[name])}; got {value!r}"
                             f"{make_hint_with_similar_or_known_words(value, choices[name])}", field=name)
        words[name] = value
    return words, ",".join(rest)
