"""Whether all forces of a test are proportional to the moduli, so that one simulation serves all of the same ratios."""

from __future__ import annotations

from calibration.campaign.parameter_space import Unknown
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.rig.rig import Rig

#: Numbers of an experiment that are no force, stiffness or size, and those of a rig that only move the tool.
_BESIDE = frozenset(f"experiment.{name}" for name in ("friction", "friction_base", "friction_wall", "tilt", "slip"))
_MOVES = frozenset(f"rig.{name}" for name in ("contact_offset", "displacement_gain", "backlash", "step_loss",
                                              "step_loss_depth"))


def in_proportion(experiment: Experiment, rig: Rig) -> bool:
    """Whether a test has no weight, and no other force or stiffness beside the tissue."""
    return not (experiment.specimen.specific_weight or experiment.acting_laws or rig.compliance)


def keeps_proportion(unknown: Unknown, *, rigid: bool) -> bool:
    """Whether forces stay in proportion to the moduli whatever the value of a number.

    Args:
        rigid: whether the tool is where the stage says, so that no number of the rig counts.
    """
    if unknown.is_modulus:
        # Of moduli that differ between tests none is the whole.
        return unknown.tests is None and unknown.recording is None
    if unknown.of_material:
        return True
    if unknown.path.startswith("rig."):
        return rigid or unknown.path in _MOVES
    return unknown.path in _BESIDE or unknown.declaration.shapes_mesh
