"""Registry of the effects that a diagnosis tests, by name."""

from __future__ import annotations

from calibration.effects.effect import Effect
from tissue_sim.registry import Registry

#: Name -> class, ordered by category: tissue, contact, geometry, rig, population.
CATALOGUE: Registry[type[Effect]] = Registry("effect", "tissue_sim.diagnosis_effects", {
    "strain_stiffening": "calibration.effects.strain_stiffening:StrainStiffening",
    "i2_term": "calibration.effects.i2_term:I2Term",
    "compressibility": "calibration.effects.compressibility:Compressibility",
    "viscoelasticity": "calibration.effects.viscoelasticity:Viscoelasticity",
    "poroelasticity": "calibration.effects.poroelasticity:Poroelasticity",
    "softening": "calibration.effects.softening:Softening",
    "layer": "calibration.effects.layer:Layer",
    "puncture": "calibration.effects.puncture:Puncture",
    "session_scale": "calibration.effects.session_scale:SessionScale",
    "plate_friction": "calibration.effects.plate_friction:PlateFriction",
    "partial_slip": "calibration.effects.partial_slip:PartialSlip",
    "adhesion": "calibration.effects.adhesion:Adhesion",
    "self_weight": "calibration.effects.self_weight:SelfWeight",
    "edge_rounding": "calibration.effects.edge_rounding:EdgeRounding",
    "radius_error": "calibration.effects.radius_error:RadiusError",
    "height_error": "calibration.effects.height_error:HeightError",
    "tilt": "calibration.effects.tilt:Tilt",
    "contact_offset": "calibration.effects.contact_offset:ContactOffset",
    "machine_compliance": "calibration.effects.machine_compliance:MachineCompliance",
    "displacement_gain": "calibration.effects.displacement_gain:DisplacementGain",
    "backlash": "calibration.effects.backlash:Backlash",
    "step_loss": "calibration.effects.step_loss:StepLoss",
    "zero_offset": "calibration.effects.zero_offset:ZeroOffset",
    "sensor_drift": "calibration.effects.sensor_drift:SensorDrift",
    "sensor_gain": "calibration.effects.sensor_gain:SensorGain",
    "latency": "calibration.effects.latency:Latency",
    "guide_friction": "calibration.effects.guide_friction:GuideFriction",
    "rate_damping": "calibration.effects.rate_damping:RateDamping",
    "inertia": "calibration.effects.inertia:Inertia",
    "population": "calibration.effects.population:Population",
}, accepts=lambda kind: isinstance(kind, type) and issubclass(kind, Effect),
    expected="a class that derives from calibration.effects.effect.Effect")
