"""Job that evaluates the planned experiments of one campaign."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from calibration.campaign.campaign import Campaign
from calibration.diagnosis.design import (
    Design,
    evaluate_experiment_design,
    make_design_campaign_and_problem,
    simulate_expected_recordings,
    simulate_noise_free_evidence,
)
from calibration.diagnosis.evidence import Measured
from calibration.fit.run_context import RunContext
from calibration.job import Job
from calibration.output_folder import (
    DESIGN_FILE,
    TABLES_OF_DESIGN,
    list_possible_design_result_paths,
    list_test_figure_file_names,
)
from calibration.report.outputs import require_usable_sections, write_design_report


class CampaignDesign(Job):
    """Evaluate the planned experiments of one campaign; without a folder the result is returned only.

    The campaign has one law and is loaded with ``planned=True``, see
    `calibration.diagnosis.evidence.make_one_law_whole_recording_campaign`; its recordings are those of
    `calibration.campaign.planned.read_or_plan_curves_of_all_tests`.

    Args:
        campaign: the campaign.
        measured: recordings of each test.
        folder: folder of the results; None: nothing is written.
        context: task executor and progress reports.
        figures: whether the report includes figures.
        figures_format: format of separate figure files; None: no figure files.
    """

    kind = "design"
    result_file = DESIGN_FILE

    def __init__(self, campaign: Campaign, measured: Measured, folder: Path | None, context: RunContext,
                 *, figures: bool = True, figures_format: str | None = None):
        super().__init__(campaign, measured, folder, context)
        self.figures, self.figures_format = figures, figures_format
        # Planned recordings have no file that the digest could contain.
        self.settings = {"samples": [curve.force.size for curve in self.recordings]}

    def list_possible_files(self) -> list[Path]:
        """Return the paths of report, figures and ``design.json``."""
        return list_possible_design_result_paths(self.campaign, self.folder)

    def decode_result(self, found: Mapping[str, Any]) -> tuple[Design, Sequence[str]]:
        """Convert the content of ``design.json``; see `Job.decode_result`.

        Raises:
            ValueError: figures are requested, and the report has none.
        """
        if self.figures and not found["figures"]:
            raise ValueError("the report has no figures")
        return msgspec.convert(found, Design), [
            *TABLES_OF_DESIGN, *list_test_figure_file_names(self.campaign, self.figures_format, held_out=False)]

    def check_before_writing(self) -> None:
        """Check the sections of the report, and simulate the tests at the starting values.

        See `Job.check_before_writing`.
        """
        if self.writes_files:
            require_usable_sections()
        self.context.report_progress("checking the start values")
        campaign, problem = make_design_campaign_and_problem(self.campaign, self.measured, self.solves)
        simulate_expected_recordings(problem, campaign)

    def run(self) -> Design:
        """Compute the expected information of the experiments, and write all files if there is a folder.

        ``design.json`` is written last and marks the design as finished.
        """
        evidence = simulate_noise_free_evidence(self.campaign, self.measured, self.solves)
        design = evaluate_experiment_design(evidence, self.context)
        if self.writes_files:
            self.context.report_progress("writing the report")
            write_design_report(design, evidence, self.folder, figures=self.figures,
                                figures_format=self.figures_format)
            self.write_result_file({**msgspec.to_builtins(design), "figures": self.figures})
        return design
