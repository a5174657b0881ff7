"""Sections of the reports of calibrations, diagnoses and designs: one file each, and the registry of all of them.

A new section is a file with a class that derives from `calibration.report.section.Section`, and its name in the list
below. Another package declares an entry point of the group ``tissue_sim.report_sections``; a program calls
`SECTIONS.register`.
"""

from __future__ import annotations

from inspect import isabstract

from calibration.report.section import Section
from tissue_sim.registry import Registry

#: Name -> class, in the order of the page.
SECTIONS: Registry[type[Section]] = Registry("report section", "tissue_sim.report_sections", {
    "calibration_summary": "calibration.report.sections.calibration_summary:CalibrationSummary",
    "diagnosis_summary": "calibration.report.sections.diagnosis_summary:DiagnosisSummary",
    "planned_tests": "calibration.report.sections.planned_tests:PlannedTests",
    "expected_errors": "calibration.report.sections.expected_errors:ExpectedErrors",
    "predictions": "calibration.report.sections.predictions:Predictions",
    "recordings_and_laws": "calibration.report.sections.recordings_and_laws:RecordingsAndLaws",
    "region_misfits": "calibration.report.sections.region_misfits:RegionMisfits",
    "ranking": "calibration.report.sections.ranking:Ranking",
    "usability": "calibration.report.sections.usability:Usability",
    "fitted_parameters": "calibration.report.sections.fitted_parameters:FittedParameters",
    "specimens": "calibration.report.sections.specimens:Specimens",
    "parameter_determination": "calibration.report.sections.parameter_determination:ParameterDetermination",
    "identifiability": "calibration.report.sections.identifiability:Identifiability",
    "convergence": "calibration.report.sections.convergence:Convergence",
    "recording_offsets": "calibration.report.sections.recording_offsets:RecordingOffsets",
    "segments": "calibration.report.sections.segments:Segments",
    "misfit_by_test": "calibration.report.sections.misfit_by_test:MisfitByTest",
    "region_evidence": "calibration.report.sections.region_evidence:RegionEvidence",
    "parameter_changes": "calibration.report.sections.parameter_changes:ParameterChanges",
    "held_out_errors": "calibration.report.sections.held_out_errors:HeldOutErrors",
    "catalogue_effects": "calibration.report.sections.catalogue_effects:CatalogueEffects",
    "next_experiments": "calibration.report.sections.next_experiments:NextExperiments",
    "assumptions": "calibration.report.sections.assumptions:Assumptions",
    "methods_text": "calibration.report.sections.methods_text:MethodsText",
    "durations": "calibration.report.sections.durations:Durations",
    "written_files": "calibration.report.sections.written_files:WrittenFiles",
    "recording_files": "calibration.report.sections.recording_files:RecordingFiles",
}, accepts=lambda kind: isinstance(kind, type) and issubclass(kind, Section) and not isabstract(kind),
    expected="a class that derives from calibration.report.section.Section and defines iterate_blocks",
    is_used_in_tasks=False)
