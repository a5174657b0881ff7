"""calibration: from recordings to a material with uncertainties.

Public names are listed here once and imported on first use, so that ``import calibration`` is instant.
"""

from tissue_sim.public_names import import_on_use as _import_on_use

_HOMES = {
    "Campaign": "campaign.campaign", "FitSettings": "campaign.campaign", "Noise": "campaign.campaign",
    "Test": "campaign.campaign",
    "load_campaign": "campaign.campaign",
    "Fit": "fit.fit", "Minimum": "fit.fit", "Nuisance": "fit.fit", "Prediction": "fit.fit",
    "CalibrationResult": "fit.result", "to_json": "fit.result",
    "calibrate": "pipeline", "HoldFit": "fit.hold", "fit_hold": "fit.hold",
    "MeasuredCurve": "campaign.measured", "read_measured": "campaign.measured",
    "Workers": "tasks.executors", "WorkerError": "tasks.errors",
}

__all__ = sorted(_HOMES)
__getattr__, __dir__ = _import_on_use(__name__, _HOMES)
