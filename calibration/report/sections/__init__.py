"""Sections of the reports of calibrations, diagnoses and designs by subject, and the registry of all of them.

A new section is a class that derives from `calibration.report.section.Section`, and a line in the table below. Another
package declares an entry point of the group ``tissue_sim.report_sections``; a program calls `SECTIONS.register`.
"""

from __future__ import annotations

from inspect import isabstract

from calibration.report.section import Section
from tissue_sim.registry import Registry

#: Name -> class, in the order of the page.
SECTIONS: Registry[type[Section]] = Registry("report section", "tissue_sim.report_sections", {
    "calibration_summary": "calibration.report.sections.summaries:CalibrationSummary",
    "diagnosis_summary": "calibration.report.sections.summaries:DiagnosisSummary",
    "planned_tests": "calibration.report.sections.planned_tests:PlannedTests",
    "expected_errors": "calibration.report.sections.planned_tests:ExpectedErrors",
    "predictions": "calibration.report.sections.fits:Predictions",
    "recordings_and_laws": "calibration.report.sections.recordings:RecordingsAndLaws",
    "region_misfits": "calibration.report.sections.recordings:RegionMisfits",
    "ranking": "calibration.report.sections.fits:Ranking",
    "usability": "calibration.report.sections.fits:Usability",
    "fitted_parameters": "calibration.report.sections.fits:FittedParameters",
    "specimens": "calibration.report.sections.fits:Specimens",
    "parameter_determination": "calibration.report.sections.fits:ParameterDetermination",
    "identifiability": "calibration.report.sections.fits:Identifiability",
    "convergence": "calibration.report.sections.fits:Convergence",
    "recording_offsets": "calibration.report.sections.recordings:RecordingOffsets",
    "segments": "calibration.report.sections.recordings:Segments",
    "misfit_by_test": "calibration.report.sections.evidence:MisfitByTest",
    "region_evidence": "calibration.report.sections.evidence:RegionEvidence",
    "parameter_changes": "calibration.report.sections.evidence:ParameterChanges",
    "held_out_errors": "calibration.report.sections.evidence:HeldOutErrors",
    "catalogue_effects": "calibration.report.sections.evidence:CatalogueEffects",
    "next_experiments": "calibration.report.sections.evidence:NextExperiments",
    "assumptions": "calibration.report.sections.statements:Assumptions",
    "methods_text": "calibration.report.sections.statements:MethodsText",
    "durations": "calibration.report.sections.evidence:Durations",
    "written_files": "calibration.report.sections.evidence:WrittenFiles",
    "recording_files": "calibration.report.sections.recordings:RecordingFiles",
}, accepts=lambda kind: isinstance(kind, type) and issubclass(kind, Section) and not isabstract(kind),
    expected="a class that derives from calibration.report.section.Section and defines iterate_blocks",
    is_used_in_tasks=False)
