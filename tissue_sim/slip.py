"""Partial slip of a bonded face, as an interpolation between the bonded and the frictionless test."""

from __future__ import annotations

from dataclasses import replace

from tissue_sim.recording.recording import Recording


def blend_bonded_and_frictionless_recordings(held: Recording, free: Recording, share: float) -> Recording:
    """Combine the recordings of bonded and frictionless faces to that of faces that slip in part.

    F = (1 - share) F_bonded + share F_frictionless: each part of the face carries the force that the whole face would
    carry with the same interface.

    Args:
        held: recording with bonded faces.
        free: recording with frictionless faces, at the same samples.
        share: fraction of the faces that slips, 0 to 1.
    """
    one, other = (each.metadata.get("solver", {}) for each in (held, free))
    errors = [report.get("force_error") for report in (one, other)]
    report = one | {"force_error": None if None in errors else max(errors),
                    "warnings": list(dict.fromkeys([*one.get("warnings", ()), *other.get("warnings", ())]))}
    held = replace(held, metadata={**held.metadata, "solver": report})
    names = (name for name in held.channels if name not in ("time", "displacement") and name in free.channels)
    return held.with_channels(**{name: (1.0 - share) * held.channels[name] + share * free.channels[name]
                                 for name in names})
