"""Storage and loss modulus of a recording, also from the loss factor or the absolute value of the complex modulus."""

from __future__ import annotations

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.recording.recording import Recording


def add_storage_and_loss_modulus(recording: Recording) -> Recording:
    """Return a recording with the channels ``storage modulus`` and ``loss modulus``, Pa.

    They follow from a modulus and the loss factor tan(delta). The channel ``complex modulus`` is the absolute value, so
    that the moduli are its products with cos(delta) and sin(delta).

    Raises:
        InputError: the channels do not determine both moduli.

    Examples:
        >>> table = Recording({"frequency": [1.0], "complex modulus": [1000.0], "loss factor": [0.75]})
        >>> both = add_storage_and_loss_modulus(table)
        >>> both.channel("storage modulus"), both.channel("loss modulus")
        (array([800.]), array([600.]))
    """
    if "storage modulus" in recording and "loss modulus" in recording:
        return recording
    if "loss factor" not in recording:
        raise InputError(f"must contain storage modulus and loss modulus, or one modulus and the loss factor; got "
                         f"{', '.join(recording.channels)}. Add the missing column", field="columns")
    factor = recording.channel("loss factor")
    if "complex modulus" in recording and "storage modulus" not in recording:
        storage = recording.channel("complex modulus") / np.hypot(1.0, factor)
    elif "storage modulus" in recording:
        storage = recording.channel("storage modulus")
    else:
        loss = recording.channel("loss modulus")
        return recording.with_channels(**{"storage modulus": loss / np.where(factor == 0.0, 1.0, factor)})
    return recording.with_channels(**{"storage modulus": storage, "loss modulus": storage * factor})
