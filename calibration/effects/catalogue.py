"""Registry of the effects that a diagnosis tests, by name."""

from __future__ import annotations

from calibration.effects.effect import Effect
from tissue_sim.registry import Registry


def _make_class_path(name: str) -> str:
    """Return the import path ``module:class`` of an effect, such as ``calibration.effects.step_loss:StepLoss``."""
    return f"calibration.effects.{name}:{''.join(part.capitalize() for part in name.split('_'))}"


#: Name -> class, ordered by category: tissue, contact, geometry, rig, population.
CATALOGUE: Registry[type[Effect]] = Registry(
    "effect", "tissue_sim.diagnosis_effects", {name: _make_class_path(name) for name in (
        "strain_stiffening", "i2_term", "compressibility", "viscoelasticity", "poroelasticity", "softening", "layer",
        "puncture", "session_scale",
        "plate_friction", "partial_slip", "adhesion",
        "self_weight", "edge_rounding", "radius_error", "height_error", "tilt",
        "contact_offset", "machine_compliance", "displacement_gain", "backlash", "step_loss", "zero_offset",
        "sensor_drift", "sensor_gain", "latency", "guide_friction", "rate_damping", "inertia",
        "population")},
    accepts=lambda kind: isinstance(kind, type) and issubclass(kind, Effect),
    expected="a class that derives from calibration.effects.effect.Effect")
