"""Haptics: the 1 kHz loop, what is between the tissue and the hand, and a server for other programs.

Public names are listed once, in `__init__.pyi`, and imported on first use.
"""

from tissue_sim.public_names import make_lazy_package_members as _import_on_use

_names, __getattr__, __dir__ = _import_on_use(__name__)
__all__ = _names
