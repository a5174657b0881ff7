"""calibration: from recordings to a material with uncertainties.

Public names are listed here once and imported on first use, so that ``import calibration`` is instant.
"""

from importlib import import_module as _import_module

_HOMES = {
    "Campaign": "campaign", "FitSettings": "campaign", "Noise": "campaign", "Test": "campaign",
    "load_campaign": "campaign",
    "Replicate": "replicates", "read_replicates": "replicates",
    "fit_law": "uniaxial",
    "Fit": "fit", "Minimum": "fit", "Nuisance": "fit", "Prediction": "fit",
    "CalibrationResult": "analytical", "calibrate": "analytical", "to_json": "analytical",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str):
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(_import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__():
    return sorted([*globals(), *_HOMES])
