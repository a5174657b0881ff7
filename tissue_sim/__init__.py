"""tissue_sim: hyperelastic soft tissue for surgical simulators, from measured curve to force.

Public names are listed once, in `__init__.pyi`, and imported on first use, so that ``import tissue_sim`` is instant.
"""

from tissue_sim.public_names import make_lazy_package_members as _import_on_use
from tissue_sim.version import __version__

#: Old public names -> new names.
_RENAMED = {"register": "register_law", "check_stability": "find_stability_range",
            "ReducedEffect": "ForceScalingEffect"}
#: Old names of modules that programs of users import -> new names.
_MOVED = {
    "tissue_sim.atomic_write": "tissue_sim.files",
    "tissue_sim.experiment.approach": "tissue_sim.experiment.experiment",
    "tissue_sim.experiment.kinds.compression": "tissue_sim.experiment.kinds.standard_tests",
    "tissue_sim.experiment.kinds.gripped": "tissue_sim.experiment.kinds.standard_tests",
    "tissue_sim.experiment.kinds.indentation": "tissue_sim.experiment.kinds.standard_tests",
    "tissue_sim.experiment.tools.cone": "tissue_sim.experiment.tools.shapes",
    "tissue_sim.experiment.tools.flat": "tissue_sim.experiment.tools.shapes",
    "tissue_sim.experiment.tools.outline": "tissue_sim.experiment.tools.tool",
    "tissue_sim.experiment.tools.plate": "tissue_sim.experiment.tools.shapes",
    "tissue_sim.experiment.tools.round": "tissue_sim.experiment.tools.shapes",
    "tissue_sim.experiment.tools.sizes": "tissue_sim.experiment.tools.tool",
    "tissue_sim.experiment.tools.sphere": "tissue_sim.experiment.tools.shapes",
    "tissue_sim.fem.free_tool": "tissue_sim.fem.solver",
    "tissue_sim.force_error": "tissue_sim.simulation",
    "tissue_sim.kernel_owner": "tissue_sim.fem.taichi.launch",
    "tissue_sim.laws.biderman": "tissue_sim.laws.polynomials",
    "tissue_sim.laws.mooney_rivlin": "tissue_sim.laws.polynomials",
    "tissue_sim.laws.neo_hooke": "tissue_sim.laws.polynomials",
    "tissue_sim.laws.reduced_polynomial": "tissue_sim.laws.polynomials",
    "tissue_sim.material.layer": "tissue_sim.material.material",
    "tissue_sim.material.parts": "tissue_sim.material.material",
    "tissue_sim.material.poroelasticity": "tissue_sim.material.viscoelasticity",
    "tissue_sim.material.puncture": "tissue_sim.material.force_scaling",
    "tissue_sim.material.stiffness_scale": "tissue_sim.material.force_scaling",
    "tissue_sim.mesh.block": "tissue_sim.mesh.solid",
    "tissue_sim.mesh.element_conversion": "tissue_sim.mesh.solid_file",
    "tissue_sim.mesh.hexahedra": "tissue_sim.mesh.solid_element",
    "tissue_sim.motion_limits": "tissue_sim.realtime.tissue",
    "tissue_sim.packing": "tissue_sim.bounded",
    "tissue_sim.realtime.bulk_link": "tissue_sim.realtime.multirate",
    "tissue_sim.realtime.path_settings": "tissue_sim.realtime.inertia_limits",
    "tissue_sim.rig.inertia": "tissue_sim.rig.fault",
    "tissue_sim.simulator": "tissue_sim.realtime.simulator",
}
_names, __getattr__, __dir__ = _import_on_use(__name__, _RENAMED, _MOVED)
__all__ = ["__version__", *_names]
