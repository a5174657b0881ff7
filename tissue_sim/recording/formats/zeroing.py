"""From where a displacement counts, and what a sensor shows without load: by the first sample, or by the contact."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.recording.contact import find_contact
from tissue_sim.recording.recording import Recording
from tissue_sim.recording.segments import segments_of

#: Words for ``offset`` of a column, in place of a number.
START, CONTACT = "start", "contact"


def zeroed(recording: Recording, offsets: dict[str, str], file: Path) -> Recording:
    """The recording with these channels counted from its first sample, or from its contact.

    From the contact: a displacement is zero there, a force is less what the sensor shows in air, its drift included,
    and the samples before it are a segment ``approach``. A recording without air counts from its first sample, and its
    force stays.

    Args:
        recording: as in the file. offsets: channel -> ``"start"`` or ``"contact"``. file: for the message.

    Raises:
        InputError: a contact of a recording without displacement and force, or one that cannot be told.
    """
    channels = {channel: recording.channel(channel) - recording.channel(channel)[0]
                for channel, word in offsets.items() if word == START}
    by_contact = {channel for channel, word in offsets.items() if word == CONTACT}
    if not by_contact:
        return recording.with_channels(**channels)
    if not {"displacement", "force"} <= set(recording.channels) or not by_contact <= {"displacement", "force"}:
        raise InputError('offset = "contact" is for the displacement and the force of a recording that has both',
                         file=file, field="columns")
    way, force = recording.displacement, recording.force
    time = recording.time if "time" in recording else None
    contact = find_contact(way, force, time)
    if contact.status == "before":
        return recording.with_channels(**{**channels, **({"displacement": way - way[0]}
                                                         if "displacement" in by_contact else {})})
    if not contact.found:
        raise InputError(f"{contact.in_words()}; state the offset of the displacement as a number", file=file,
                         field="columns.displacement.offset")
    clock = np.arange(way.size, dtype=float) if time is None else time
    if "displacement" in by_contact:
        channels["displacement"] = way - contact.displacement
    if "force" in by_contact:
        channels["force"] = force - contact.force_zero - contact.drift * (clock - clock[0])
    changed = recording.with_channels(**channels)
    if "segment" in recording.labels:
        return changed
    return Recording(changed.channels, {**changed.labels, "segment": segments_of(way, force, time).labels},
                     changed.metadata)
