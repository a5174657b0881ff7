"""tissue_sim: hyperelastic soft tissue for surgical simulators, from measured curve to force.

Public names are listed here once and imported on first use, so that ``import tissue_sim`` is instant.
"""

from importlib import import_module as _import_module

__version__ = "0.1.0"

_HOMES = {
    "Bulk": "material", "Material": "material",
    "Experiment": "experiment", "Model": "experiment", "Protocol": "experiment", "Specimen": "experiment",
    "Tool": "experiment",
    "Rig": "rig",
    "Recording": "recording",
    "read_recording": "recording_file", "write_recording": "recording_file",
    "MaterialFile": "material_file", "load_material": "material_file", "read_material_file": "material_file",
    "write_material_file": "material_file",
    "simulate": "simulation", "Fields": "fem.fields",
    "LAWS": "laws", "find_law": "laws", "register": "laws", "check_stability": "laws",
    "ConvergenceError": "errors", "InputError": "errors", "MissingBackendError": "errors",
}

__all__ = ["__version__", *sorted(_HOMES)]


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(_import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__():
    return sorted([*globals(), *_HOMES])
