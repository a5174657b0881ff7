"""A bonded face that slips in part, as a reduced form: between the bonded and the frictionless test."""

from __future__ import annotations

from tissue_sim.recording.recording import Recording


def slipped(held: Recording, free: Recording, share: float) -> Recording:
    """The recording of faces of which a share slips.

    Every part of the face answers as if the whole were held like it: F = (1 - share) F_bonded + share F_frictionless.

    Args:
        held, free: of bonded and of frictionless faces, at the same samples. share: 0 to 1.
    """
    names = (name for name in held.channels if name not in ("time", "displacement") and name in free.channels)
    return held.with_channels(**{name: (1.0 - share) * held.channels[name] + share * free.channels[name]
                                 for name in names})
