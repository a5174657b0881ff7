"""Set one decimal mark for all files of an import, so that replicates have equal options."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from calibration.importing.imported import ReplicateFile
from tissue_sim.recording.formats.guesses import FileInterpretation, TableGroup
from tissue_sim.settings import make_shallow_read_only_copy


def copy_interpretations_with_common_decimal_mark(understood: Sequence[FileInterpretation]) -> list[FileInterpretation]:
    """Copy the option ``decimal`` of some files to the options of all other files that have the same decimal mark.

    A file with thousands separators states its decimal mark in the campaign. Replicates with smaller numbers have no
    separators; with the same option, they remain replicates.
    """
    stated = {reading.options["decimal"] for each in understood for reading in each.readings
              if "decimal" in reading.options}
    if len(stated) != 1:
        return list(understood)
    mark, = stated

    def add_decimal_option_if_same_mark(each: FileInterpretation, reading: TableGroup) -> TableGroup:
        """Return the reading with the option ``decimal``; unchanged if the file has another mark or open questions."""
        if "decimal" in reading.options or "columns" not in reading.options or each.decimal_mark != mark or any(
                assumption.needs_user_decision for assumption in each.assumptions):
            return reading
        options = dict(reading.options)
        columns = options.pop("columns")
        return replace(reading, options=make_shallow_read_only_copy({**options, "decimal": mark, "columns": columns}))

    return [replace(each, readings=tuple(add_decimal_option_if_same_mark(each, reading) for reading in each.readings))
            for each in understood]


def explain_why_campaign_states_decimal_mark(parts: Sequence[ReplicateFile]) -> str:
    """Return the reason why a campaign states the decimal mark of its files; empty if no assumption concerns it."""
    found = [assumption for part in parts for assumption in part.understanding.assumptions
             if assumption.subject in ("thousands separator", "decimal mark")]
    found.sort(key=lambda each: each.subject, reverse=True)
    return "" if not found else f"{found[0].subject}: {found[0].value}; {'; '.join(found[0].evidence)}"
