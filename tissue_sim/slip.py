"""A bonded face that slips in part, as a reduced form: between the bonded and the frictionless test."""

from __future__ import annotations

from dataclasses import replace

from tissue_sim.recording.recording import Recording


def slipped(held: Recording, free: Recording, share: float) -> Recording:
    """The recording of faces of which a share slips.

    Every part of the face answers as if the whole were held like it: F = (1 - share) F_bonded + share F_frictionless.

    Args:
        held, free: of bonded and of frictionless faces, at the same samples. share: 0 to 1.
    """
    one, other = (each.metadata.get("solver", {}) for each in (held, free))
    errors = [report.get("force_error") for report in (one, other)]
    report = one | {"force_error": None if None in errors else max(errors),
                    "warnings": list(dict.fromkeys([*one.get("warnings", ()), *other.get("warnings", ())]))}
    held = replace(held, metadata={**held.metadata, "solver": report})
    names = (name for name in held.channels if name not in ("time", "displacement") and name in free.channels)
    return held.with_channels(**{name: (1.0 - share) * held.channels[name] + share * free.channels[name]
                                 for name in names})
