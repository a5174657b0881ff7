"""Job that evaluates the planned experiments of one campaign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from calibration.campaign.campaign import Campaign
from calibration.diagnosis.design import Design, evaluate_experiment_design
from calibration.diagnosis.evidence import Measured
from calibration.fit.run_context import RunContext
from calibration.job import Job


class CampaignDesign(Job):
    """Evaluate the planned experiments of one campaign; without a folder the result is returned only.

    The campaign has one law and is loaded with ``planned=True``, see
    `calibration.diagnosis.evidence.make_one_law_whole_recording_campaign`; its recordings are those of
    `calibration.campaign.planned.read_or_plan_curves_of_all_tests`.
    """

    kind = "design"
    result_file = "design.json"

    def __init__(self, campaign: Campaign, measured: Measured, folder: Path | None, context: RunContext):
        super().__init__(campaign, measured, folder, context)
        # Planned recordings have no file that the digest could contain.
        self.settings = {"samples": [curve.force.size for curve in self.recordings]}

    def run(self) -> Design:
        """Compute the expected information of the experiments, and write ``design.json`` if there is a folder.

        Raises:
            InputError: a parameter has no starting value, or the simulation fails at the starting values.
        """
        design = evaluate_experiment_design(self.campaign, self.measured, self.context, self.solves)
        if self.writes_files:
            self.write_result_file(msgspec.to_builtins(design))
        return design

    def decode_result(self, found: Mapping[str, Any]) -> tuple[Design, Sequence[str]]:
        """Convert the content of ``design.json``; see `Job.decode_result`."""
        return msgspec.convert(found, Design), ()
