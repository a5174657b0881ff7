"""Read-only mappings for frozen dataclasses, with support for pickle, which `MappingProxyType` lacks."""

from __future__ import annotations

import copyreg
from collections.abc import Mapping
from types import MappingProxyType


def make_shallow_read_only_copy(mapping: Mapping) -> MappingProxyType:
    """Return a read-only shallow copy of a mapping; the values are not copied."""
    return MappingProxyType(dict(mapping))


copyreg.pickle(MappingProxyType, lambda view: (make_shallow_read_only_copy, (dict(view),)))
