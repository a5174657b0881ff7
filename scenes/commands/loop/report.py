"""What `tissue-sim loop` prints: a line while it runs, a table at its end."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from haptics.loop.ticker import LATE
from scenes.commands.shared.text_table import print_sentence, text_table

if TYPE_CHECKING:
    from rich.console import Console

    from haptics.loop.loop import LoopReport
    from haptics.loop.ring import RingReader


#: What it means that a tick was flagged, by the name in the report; see `haptics.safety.rendering.RenderFlag`.
_FLAGGED = {
    "limited": "with the force held at its limit", "rate_limited": "with a force that was let change more slowly",
    "invalid": "without a force that is a number", "lost_pose": "without a pose from the device",
    "active": "when the hand had got more energy than it had put in",
    "energy": "with the force taken away for its energy", "paused": "in a pause",
}


class LiveLine:
    """The state of a loop in one line, from its ring: the loop itself is not asked.

    Args:
        ring: of the loop.
        seconds: how long it will run.
    """

    def __init__(self, ring: RingReader, seconds: float):
        self._ring, self._seconds, self._number = ring, seconds, 0

    def text(self) -> str:
        """The line, over the ticks since it was asked for the last time."""
        ticks = self._ring.since(self._number)
        self._number, records = ticks.number, ticks.records
        if not len(records):
            return "waiting for a tick"
        newest = records[-1]
        compute, lateness = (np.quantile(records[name], 0.99) * 1e6 for name in ("compute_time", "lateness"))
        return (f"{newest['time']:.0f} of {self._seconds:g} s: {newest['tool_depth'] * 1e3:.2f} mm, "
                f"{newest['force']:.3f} N; p99 compute {compute:.0f}, lateness {lateness:.0f} us; "
                f"late {newest['late']}, missed {newest['missed']}")


def print_report(report: LoopReport, console: Console) -> None:
    """The report as a table and a few sentences."""
    from rich.text import Text

    table = text_table("", "p50", "p99", "p99.9", "max")
    answer = report.as_json()
    for title, key in (("lateness [us]", "lateness_us"), ("compute time [us]", "compute_us")):
        # As text: rich reads brackets as markup.
        table.add_row(Text(title), *(f"{value:.1f}" for value in answer[key].values()))
    console.print(table)
    print_sentence(console, f"{report.ticks} ticks in {report.seconds:.4g} s: {report.late} late (more than "
                            f"{LATE * 1e3:g} ms), {report.missed} missed ({answer['missed_percent']:.3g} %)")
    answers = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in report.statuses.items() if count)
    if answers:
        print_sentence(console, f"answers: {answers}")
    for name, count in report.flagged.items():
        if count:
            print_sentence(console, f"ticks {_FLAGGED.get(name, name)}: {count}")
    if report.resolution not in ("", "own mesh"):
        error = "" if report.force_error is None else f", whose force errs by {100 * report.force_error:.2g} % at most"
        print_sentence(console, f"mesh: {report.resolution}{error}")
    print_sentence(console, f"largest force: {report.largest_force:.4g} N")
    if report.device.get("trouble"):
        print_sentence(console, f"the device was lost: {report.device['trouble']}")
    if report.peak_memory is not None:
        print_sentence(console, f"peak memory: {answer['peak_memory_MB']:.0f} MB")
    obtained = [feature.name for feature in report.real_time if feature.obtained]
    print_sentence(console, f"real time: {', '.join(obtained) if report.real_time else 'not asked for'}")
    for feature in report.real_time:
        if not feature.obtained:
            print_sentence(console, f"real time: {feature.message}")
