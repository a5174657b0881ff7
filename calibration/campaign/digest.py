"""Digest of all inputs on which the results of a campaign depend."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence

import tissue_sim
from calibration.campaign.campaign import Campaign
from calibration.campaign.measured import MeasuredCurve


def compute_input_and_version_digest(campaign: Campaign, recordings: Sequence[MeasuredCurve],
                                     changed: Mapping[str, object] | None = None) -> str:
    """Return the SHA-256 digest, in hexadecimal, of all inputs of a campaign and of the program version.

    Args:
        campaign: campaign.
        recordings: all recordings of the campaign.
        changed: name -> value of settings that differ from the defaults; None: none.
    """
    content = [campaign.sha256, *(f"{curve.name} {curve.sha256}" for curve in recordings)]
    for test in campaign.tests:
        if test.experiment is not None:
            outline = test.experiment.tool.profile.vertices.tolist()
            content.append(hashlib.sha256(repr((test.rig, outline)).encode()).hexdigest())
    content += [digest for specimen in campaign.specimens.values() if (digest := specimen.digest_of_files)]
    content += [f"{name} = {value!r}" for name, value in (changed or {}).items()]
    return hashlib.sha256("\n".join([*content, tissue_sim.__version__]).encode()).hexdigest()
