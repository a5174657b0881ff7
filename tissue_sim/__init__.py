"""tissue_sim: hyperelastic soft tissue for surgical simulators, from measured curve to force.

Public names are listed here once and imported on first use, so that ``import tissue_sim`` is instant.
"""

from tissue_sim.public_names import import_on_use as _import_on_use
from tissue_sim.version import __version__

_HOMES = {
    "Bulk": "material.material", "Material": "material.material",
    "Adhesion": "experiment.adhesion", "CONTACT_LAWS": "experiment.contact_law",
    "ContactLaw": "experiment.contact_law", "Traction": "experiment.contact_law", "Experiment": "experiment.experiment",
    "Model": "model", "Protocol": "experiment.protocol", "Specimen": "specimen",
    "Tool": "experiment.tools.tool", "TOOLS": "experiment.tools.tool",
    "TestKind": "experiment.kinds.kind", "KINDS": "experiment.kinds.kind",
    "Rig": "rig.rig", "RigFault": "rig.fault", "FAULTS": "rig.fault", "load_rig": "rig.file", "write_rig": "rig.file",
    "Poroelasticity": "material.poroelasticity", "Prony": "material.viscoelasticity",
    "PronyTerm": "material.viscoelasticity",
    "TissueEffect": "material.effect", "ReducedEffect": "material.effect",
    "PointEffect": "material.effect", "ToolHistory": "material.effect",
    "EFFECTS": "material.effect",
    "parameter": "parameters", "with_values": "parameters",
    "Registry": "registry",
    "Layer": "material.layer", "Puncture": "material.puncture", "Softening": "material.softening",
    "nominal_stress_history": "closed_form.histories", "shear_stress_history": "closed_form.histories",
    "Recording": "recording.recording",
    "read_recording": "recording.file", "read_recordings": "recording.file", "write_recording": "recording.file",
    "MaterialFile": "material.file", "load_material": "material.file", "read_material_file": "material.file",
    "write_material_file": "material.file",
    "Sensitivities": "differentiation", "sensitivities": "differentiation",
    "ForceStatus": "tool_force", "Pose": "pose", "ToolForce": "tool_force",
    "SOLVERS": "fem.solver", "Solver": "fem.solver", "Step": "fem.solver", "StepStatus": "fem.solver",
    "Simulator": "simulator", "SimulatorState": "simulator", "DeformedSurface": "fem.axisymmetric.surface",
    "Snapshot": "snapshot",
    "simulate": "simulation", "Fields": "fem.axisymmetric.fields",
    "FORMATS": "recording.formats", "LAWS": "laws", "find_law": "laws", "register": "laws", "check_stability": "laws",
    "ConvergenceError": "errors", "InputError": "errors", "MissingBackendError": "errors",
}

__all__ = ["__version__", *sorted(_HOMES)]
__getattr__, __dir__ = _import_on_use(__name__, _HOMES)
