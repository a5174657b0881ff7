"""Read-only mappings that another process can be sent: frozen data holds them, and pickle does not know them."""

from __future__ import annotations

import copyreg
from collections.abc import Mapping
from types import MappingProxyType


def read_only(mapping: Mapping) -> MappingProxyType:
    """A view of a copy that nobody can change."""
    return MappingProxyType(dict(mapping))


copyreg.pickle(MappingProxyType, lambda view: (read_only, (dict(view),)))
