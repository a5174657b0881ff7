"""Parts of a model that the closed form of a homogeneous test does not support."""

from __future__ import annotations

from pathlib import Path

from calibration.campaign.campaign import Test
from tissue_sim.errors import InputError
from tissue_sim.material.material import Material


def require_closed_form_support_if_used(test: Test, material: Material, stressed: bool, closed: bool,
                                        path: Path) -> None:
    """Reject parts of the model that the closed form of a homogeneous test does not support.

    Args:
        test: test of the campaign.
        material: material of the fit.
        stressed: whether stress was recorded, which only the closed form describes.
        closed: whether method or kind of the test require the closed form.
        path: file of the recording.
    """
    if not (stressed or closed):
        return
    if material.layers:
        remedy = ("use displacement and force of a compression or a needle test" if stressed or test.experiment is None
                  else "set fit.method = 'inverse_fem'")
        raise InputError(f"{path.name} is computed by a closed form, which requires a homogeneous specimen; for a "
                         f"layered specimen {remedy}", field="kind")
    if test.specimen is None and material.poroelasticity is not None:
        raise InputError("a poroelastic material requires the size of the specimen; add a [[specimen]]",
                         field="specimen")
    if test.specimen is not None and test.specimen.specific_weight and material.is_history_dependent:
        raise InputError("the closed form does not support gravity for a material with memory; set gravity = false, or "
                         "fit.method = 'inverse_fem'", field="specimen")
    if not test.rig.is_ideal:
        raise InputError(f"{path.name} contains stress, to which a rig does not apply; leave rig out", field="rig")
