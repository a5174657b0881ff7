"""calibration: estimate material parameters with uncertainties from recordings.

Public names are listed in `__init__.pyi` and imported on first use, so that ``import calibration`` is fast.
"""

from tissue_sim.public_names import make_lazy_package_members as _import_on_use

#: Old public names -> new names.
_RENAMED = {"Wishes": "ImportOptions", "Stated": "InterpretationOverrides", "Imported": "ImportResult",
            "read_measured": "read_measured_curves", "ColumnHints": "InterpretationOverrides",
            "to_json": "to_json_dictionary", "design_experiments": "evaluate_planned_experiments"}
#: Old names of modules that programs of users import -> new names.
_MOVED = {
    "calibration.diagnosis.decision_limits": "calibration.diagnosis.settings",
    "calibration.diagnosis.refit_settings": "calibration.diagnosis.settings",
    "calibration.diagnosis.result": "calibration.diagnosis.diagnosis",
    "calibration.effects.situation": "calibration.effects.effect",
    "calibration.fit.hold": "calibration.fit.ordinary",
    "calibration.fit.usability_settings": "calibration.fit.usability",
}
_names, __getattr__, __dir__ = _import_on_use(__name__, _RENAMED, _MOVED)
__all__ = _names
