"""calibration: estimate material parameters with uncertainties from recordings.

Public names are listed in `__init__.pyi` and imported on first use, so that ``import calibration`` is fast.
"""

from tissue_sim.public_names import make_lazy_package_members as _import_on_use

#: Old public names -> new names.
_RENAMED = {"Wishes": "ImportOptions", "Stated": "InterpretationOverrides", "Imported": "ImportResult",
            "read_measured": "read_measured_curves", "ColumnHints": "InterpretationOverrides",
            "to_json": "to_json_dictionary", "design_experiments": "evaluate_planned_experiments"}
_names, __getattr__, __dir__ = _import_on_use(__name__, _RENAMED)
__all__ = _names
