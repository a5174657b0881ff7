"""Factor between the load of a specimen with held ends and that of the closed form of its kind of test."""

from __future__ import annotations

import numpy as np

from tissue_sim.experiment.kinds.kind import TestKind
from tissue_sim.model import Model
from tissue_sim.recording.recording import Recording


def compute_grip_factor(kind: TestKind, model: Model, recording: Recording) -> np.ndarray:
    """Return the load of a simulated gripped specimen over that of the closed form, 1, shape (n,).

    A measured load divided by this factor is the load of a homogeneous deformation of the same material, such as of a
    strip in planar tension without free edges. The factor depends little on the law at small strain, more at large
    strain.

    Args:
        kind: kind of test, with a closed form.
        model: simulated model.
        recording: result of `tissue_sim.simulate` for this model.

    Returns:
        NaN where the closed form is zero, such as at rest.

    Raises:
        InputError: the kind has no closed form, or the closed form does not hold for the material or the specimen.

    Source: edge effects in planar tension: Treloar, Trans. Faraday Soc. 40 (1944) 59.
    """
    form, specimen = kind.require_closed_form(), model.experiment.specimen
    motion, load = (recording.channel(name) for name in model.experiment.channels)
    strain, stress = form.convert_motion_and_load(specimen, motion, load) or (
        motion / specimen.height, load / specimen.area)
    abscissa = kind.convert_nominal_strain_to_stretch_or_shear_strain(strain)
    closed = kind.sign * form.stress_history(model.material, recording.time, abscissa, model.experiment.contact_radius)
    return np.divide(stress, closed, out=np.full(stress.shape, np.nan), where=closed != 0.0)
