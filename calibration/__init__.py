"""calibration: from recordings to a material with uncertainties.

Public names are listed here once and imported on first use, so that ``import calibration`` is instant.
"""

from tissue_sim.public_names import import_on_use as _import_on_use

_HOMES = {
    "Campaign": "campaign", "FitSettings": "campaign", "Noise": "campaign", "Test": "campaign",
    "load_campaign": "campaign",
    "Replicate": "replicates", "read_replicates": "replicates",
    "fit_law": "uniaxial",
    "Fit": "fit", "Minimum": "fit", "Nuisance": "fit", "Prediction": "fit",
    "CalibrationResult": "result", "to_json": "result",
    "calibrate": "batch",
    "MeasuredCurve": "measured", "read_measured": "measured",
    "Workers": "executors", "WorkerError": "executors",
}

__all__ = sorted(_HOMES)
__getattr__, __dir__ = _import_on_use(__name__, _HOMES)
