"""Conditions under which all forces of a test are proportional to the moduli.

One simulation then serves all sets of moduli with the same ratios.
"""

from __future__ import annotations

from calibration.campaign.parameter_space import FitParameter
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.rig.rig import Rig

#: Parameters of an experiment that are neither forces nor stiffnesses.
_EXPERIMENT_PARAMETERS = frozenset(f"experiment.{name}" for name in (
    "friction", "friction_base", "friction_wall", "tilt", "slip"))
#: Parameters of a rig that only change the motion of the tool.
_MOTION_PARAMETERS = frozenset(f"rig.{name}" for name in (
    "contact_offset", "displacement_gain", "backlash", "step_loss", "step_loss_depth"))


def is_force_proportional_to_moduli(experiment: Experiment, rig: Rig) -> bool:
    """Return whether the tissue is the only source of force and stiffness in a test.

    Self-weight, contact laws with a stress scale and a compliant load train break the proportionality.
    """
    return not (experiment.specimen.specific_weight or experiment.acting_laws or rig.compliance)


def keeps_force_proportional_to_moduli(unknown: FitParameter, *, rigid: bool) -> bool:
    """Return whether forces stay proportional to the moduli for every value of a parameter.

    Args:
        unknown: parameter of the fit.
        rigid: whether the simulation uses an ideal rig, so that parameters of the rig have no influence.
    """
    if unknown.is_modulus:
        # A modulus of some tests or recordings does not scale all forces.
        return unknown.tests is None and unknown.recording is None
    if unknown.is_material_parameter:
        return True
    if unknown.path.startswith("rig."):
        return rigid or unknown.path in _MOTION_PARAMETERS
    return unknown.path in _EXPERIMENT_PARAMETERS or unknown.declaration.shapes_mesh
