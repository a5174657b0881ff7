"""tissue_sim: hyperelastic soft tissue for surgical simulators, from measured curve to force.

Public names are listed once, in `__init__.pyi`, and imported on first use, so that ``import tissue_sim`` is instant.
"""

import sys as _sys

from tissue_sim.public_names import MovedModules as _MovedModules
from tissue_sim.public_names import make_lazy_package_members as _import_on_use
from tissue_sim.version import __version__

#: Old public names -> new names.
_RENAMED = {"register": "register_law", "check_stability": "find_stability_range",
            "ReducedEffect": "ForceScalingEffect"}
#: Old names of modules that programs of users import -> new names.
_MOVED = {
    "tissue_sim.simulator": "tissue_sim.realtime.simulator",
    "tissue_sim.experiment.protocol_text": "tissue_sim.experiment.protocol",
    "tissue_sim.experiment.tools.sizes": "tissue_sim.experiment.tools.outline",
    "tissue_sim.fem.free_tool": "tissue_sim.fem.solver",
    "tissue_sim.mesh.block": "tissue_sim.mesh.solid",
    "tissue_sim.mesh.element_conversion": "tissue_sim.mesh.solid_file",
    "tissue_sim.mesh.hexahedra": "tissue_sim.mesh.solid_element",
    "tissue_sim.realtime.bulk_link": "tissue_sim.realtime.multirate",
}
_sys.meta_path.append(_MovedModules(_MOVED))
_names, __getattr__, __dir__ = _import_on_use(__name__, _RENAMED)
__all__ = ["__version__", *_names]
