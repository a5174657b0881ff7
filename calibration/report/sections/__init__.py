"""Sections of the reports of calibrations, diagnoses and designs: one file each, and the registry of all of them.

A new section is a file with a class that derives from `calibration.report.section.Section`, and its name in the list
below. Another package declares an entry point of the group ``tissue_sim.report_sections``; a program calls
`SECTIONS.register`.
"""

from __future__ import annotations

from inspect import isabstract

from calibration.report.section import Section
from tissue_sim.registry import Registry


def _make_class_path(name: str) -> str:
    """Return the import path ``module:class`` of a section, such as ``calibration.report.sections.ranking:Ranking``."""
    return f"calibration.report.sections.{name}:{''.join(part.capitalize() for part in name.split('_'))}"


#: Name -> class, in the order of the page.
SECTIONS: Registry[type[Section]] = Registry(
    "report section", "tissue_sim.report_sections", {name: _make_class_path(name) for name in (
        "calibration_summary", "diagnosis_summary", "planned_tests", "expected_errors",
        "predictions", "recordings_and_laws", "region_misfits", "ranking", "usability", "fitted_parameters",
        "specimens", "parameter_determination", "identifiability", "convergence", "recording_offsets", "segments",
        "misfit_by_test", "region_evidence", "parameter_changes", "held_out_errors", "catalogue_effects",
        "next_experiments",
        "assumptions", "methods_text", "durations", "written_files", "recording_files")},
    accepts=lambda kind: isinstance(kind, type) and issubclass(kind, Section) and not isabstract(kind),
    expected="a class that derives from calibration.report.section.Section and defines iterate_blocks",
    is_used_in_tasks=False)
