"""tissue_sim: hyperelastic soft tissue for surgical simulators, from measured curve to force.

Public names are listed here once and imported on first use, so that ``import tissue_sim`` is instant.
"""

from tissue_sim.public_names import import_on_use as _import_on_use

__version__ = "0.1.0"

_HOMES = {
    "Bulk": "material", "Material": "material",
    "Adhesion": "experiment", "Experiment": "experiment",
    "Model": "experiment", "Protocol": "protocol", "Specimen": "experiment",
    "Tool": "tool",
    "Rig": "rig", "load_rig": "rig_file", "write_rig": "rig_file",
    "Poroelasticity": "viscoelasticity", "Prony": "viscoelasticity", "PronyTerm": "viscoelasticity",
    "Layer": "layer", "Puncture": "puncture", "Softening": "softening",
    "nominal_stress_history": "uniaxial_history", "shear_stress_history": "uniaxial_history",
    "Recording": "recording",
    "read_recording": "recording_file", "read_recordings": "recording_file", "write_recording": "recording_file",
    "MaterialFile": "material_file", "load_material": "material_file", "read_material_file": "material_file",
    "write_material_file": "material_file",
    "Sensitivities": "differentiation", "sensitivities": "differentiation",
    "ForceStatus": "tool_force", "Pose": "tool_force", "ToolForce": "tool_force",
    "Simulator": "simulator", "SimulatorState": "simulator", "DeformedSurface": "deformed_surface",
    "Snapshot": "snapshot",
    "simulate": "simulation", "Fields": "fem.fields",
    "LAWS": "laws", "find_law": "laws", "register": "laws", "check_stability": "laws",
    "ConvergenceError": "errors", "InputError": "errors", "MissingBackendError": "errors",
}

__all__ = ["__version__", *sorted(_HOMES)]
__getattr__, __dir__ = _import_on_use(__name__, _HOMES)
