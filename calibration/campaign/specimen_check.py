"""Compare the specimen in the metadata of a recording with the specimen of the campaign."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from calibration.campaign.campaign import Campaign, Test
from calibration.campaign.schema import PRISM
from tissue_sim.errors import InputError
from tissue_sim.recording.recording import Recording
from tissue_sim.specimen.specimen import add_indefinite_article

#: Largest relative difference between the specimen size in a recording and in the campaign.
SIZE_TOLERANCE = 0.02


def require_matching_specimen_metadata(recording: Recording, test: Test, campaign: Campaign, path: Path) -> None:
    """Check that the metadata of a recording state the shape and sizes of the specimen in the campaign.

    Metadata with ``radius_mm`` and without a shape mean a cylinder (older files). The shape is not compared if the test
    depends on the cross-section only.

    Raises:
        InputError: shape or size differ; the error states the field of the specimen.
    """
    if test.specimen is None or not isinstance(metadata := recording.metadata.get("specimen"), Mapping):
        return
    field = f"specimen[{list(campaign.specimens).index(test.specimen.name)}]"
    shape = test.specimen.shape
    recorded = metadata.get("shape", "cylinder" if "radius_mm" in metadata else None)
    any_shape = (test.kind.has_gripped_ends or campaign.fit.method == "analytical"
                 or test.specimen.name in campaign.prisms)
    if not any_shape and isinstance(recorded, str) and recorded not in (shape, PRISM):
        raise InputError(f"shape must agree with the recordings; the campaign states {add_indefinite_article(shape)} "
                         f"and "
                         f"{path.name} states {add_indefinite_article(recorded)}. Correct the wrong statement.",
                         file=campaign.path, field=f"{field}.shape")
    for key, size in test.specimen.sizes.items():
        stated = metadata.get(key)
        if isinstance(stated, int | float) and abs(stated - size) > SIZE_TOLERANCE * size:
            raise InputError(f"{key} must agree with the recordings within {100 * SIZE_TOLERANCE:g} %; the campaign "
                             f"states {size:g} mm and {path.name} states {stated:g} mm. Correct the wrong statement.",
                             file=campaign.path, field=f"{field}.{key}")
