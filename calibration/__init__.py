"""calibration: estimate material parameters with uncertainties from recordings.

Public names are listed in `__init__.pyi` and imported on first use, so that ``import calibration`` is fast.
"""

from tissue_sim.public_names import make_lazy_package_members as _import_on_use

#: Old public names -> new names.
_RENAMED = {"Wishes": "ImportOptions", "Stated": "InterpretationOverrides", "Imported": "ImportResult",
            "read_measured": "read_measured_curves", "ColumnHints": "InterpretationOverrides",
            "to_json": "to_json_dictionary", "design_experiments": "evaluate_planned_experiments"}
#: Old names of the modules of single effects -> modules of their categories.
_EFFECTS = {f"calibration.effects.{name}": f"calibration.effects.{category}" for category, names in {
    "tissue": ("strain_stiffening", "i2_term", "compressibility", "viscoelasticity", "poroelasticity", "softening",
               "layer", "puncture", "session_scale"),
    "contact": ("plate_friction", "partial_slip", "adhesion"),
    "geometry": ("self_weight", "edge_rounding", "radius_error", "height_error", "tilt"),
    "rig": ("contact_offset", "machine_compliance", "displacement_gain", "backlash", "step_loss", "zero_offset",
            "sensor_drift", "sensor_gain", "latency", "guide_friction", "rate_damping", "inertia"),
}.items() for name in names}
#: Old names of modules that programs of users import -> new names.
_MOVED = {
    "calibration.diagnosis.decision_limits": "calibration.diagnosis.settings",
    "calibration.diagnosis.refit_settings": "calibration.diagnosis.settings",
    "calibration.diagnosis.result": "calibration.diagnosis.diagnosis",
    "calibration.effects.catalogue": "calibration.effects.effect",
    "calibration.effects.situation": "calibration.effects.effect",
    **_EFFECTS,
    "calibration.fit.hold": "calibration.fit.ordinary",
    "calibration.fit.usability_settings": "calibration.fit.usability",
    "calibration.report.page": "calibration.report.outputs",
    "calibration.report.rounding": "calibration.report.quantities",
    "calibration.report.units": "calibration.report.quantities",
    "calibration.tasks.errors": "tissue_sim.errors",
}
_names, __getattr__, __dir__ = _import_on_use(__name__, _RENAMED, _MOVED)
__all__ = _names
