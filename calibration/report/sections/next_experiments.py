"""Section with the proposed experiments."""

from __future__ import annotations

from collections.abc import Iterator

from calibration.diagnosis.diagnosis import join_as_enumeration
from calibration.report.content import Block, Listing, Part, Span, Text
from calibration.report.diagnosis_tables import capitalise_first_letter, map_candidate_names_to_labels
from calibration.report.section import DiagnosisReport, Section


class NextExperiments(Section):
    """Proposed experiments, with the effects that each would distinguish."""

    name = "next_experiments"
    title = "What to measure next"
    reports = ("diagnosis",)

    def iterate_blocks(self, report: DiagnosisReport) -> Iterator[Block]:
        """Yield the numbered list; nothing without proposals."""
        labels = map_candidate_names_to_labels(report.diagnosis.candidates)
        sentences: list[Text] = []
        for each in report.diagnosis.next_experiment:
            by = "" if each.deviations is None else f" by {each.deviations:.2g} standard deviations"
            names = join_as_enumeration([labels.get(name, name) for name in each.separates], "and")
            separation: list[Part] = [" ", Span(f"Distinguishes {names}{by}.", "quiet")] if names else []
            sentences.append([f"{capitalise_first_letter(each.sentence)}.", *separation])
        if sentences:
            yield Listing(sentences, ordered=True)
