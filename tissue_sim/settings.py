"""Values of frozen dataclasses: checks of settings, changed settings, and read-only mappings."""

from __future__ import annotations

import copyreg
import math
from collections.abc import Mapping, Sequence
from dataclasses import Field, fields
from types import MappingProxyType
from typing import Any, ClassVar, Protocol

from tissue_sim.errors import InputError


def make_shallow_read_only_copy(mapping: Mapping) -> MappingProxyType:
    """Return a read-only shallow copy of a mapping; the values are not copied."""
    return MappingProxyType(dict(mapping))


copyreg.pickle(MappingProxyType, lambda view: (make_shallow_read_only_copy, (dict(view),)))


class Settings(Protocol):
    """A dataclass of numbers in which every field has a default."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]


def require_all_settings_positive(settings: Settings) -> None:
    """Check that every number of a settings object is positive and finite; a setting may be a sequence of numbers.

    Args:
        settings: settings of one algorithm.

    Raises:
        InputError: a number is not positive and finite, a count is not a whole number, or a sequence is empty; the
            error names the field.
    """
    for entry in fields(settings):
        value = getattr(settings, entry.name)
        numbers = value if isinstance(value, Sequence) else (value,)
        if not numbers:
            raise InputError(f"{entry.name} must contain a number; got none", field=entry.name)
        for number in numbers:
            if not number > 0:
                raise InputError(f"{entry.name} must be positive; got {number:g}", field=entry.name)
            if math.isinf(number):
                raise InputError(f"{entry.name} must be finite; got {number:g}", field=entry.name)
            if isinstance(entry.default, int) and number != int(number):
                raise InputError(f"{entry.name} must be a whole number; got {number:g}", field=entry.name)


def get_changed_settings_by_name(settings: Settings) -> dict[str, Any]:
    """Return name -> value of the settings that differ from the defaults.

    Args:
        settings: settings of one algorithm.

    Examples:
        >>> from tissue_sim import PathSettings
        >>> get_changed_settings_by_name(PathSettings(largest_part=0.1))
        {'largest_part': 0.1}
    """
    return {entry.name: getattr(settings, entry.name) for entry in fields(settings)
            if getattr(settings, entry.name) != entry.default}
