"""tissue_sim: hyperelastic soft tissue for surgical simulators, from measured curve to force.

Public names are listed once, in `__init__.pyi`, and imported on first use, so that ``import tissue_sim`` is instant.
"""

from tissue_sim.public_names import make_lazy_package_members as _import_on_use
from tissue_sim.version import __version__

#: Old public names -> new names.
_RENAMED = {"register": "register_law", "check_stability": "find_stability_range",
            "ReducedEffect": "ForceScalingEffect"}
_names, __getattr__, __dir__ = _import_on_use(__name__, _RENAMED)
__all__ = ["__version__", *_names]
