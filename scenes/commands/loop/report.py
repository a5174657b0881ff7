"""Output of `tissue-sim loop`: a status line while the loop runs, and its report."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from haptics.loop.ticker import TICKER
from scenes.commands.shared.text_table import make_table_with_headings, print_sentence

if TYPE_CHECKING:
    from rich.console import Console

    from haptics.loop.loop import LoopReport
    from haptics.loop.ring import RingReader


#: Flag of a tick in the report -> its description; see `haptics.safety.rendering.RenderFlag`.
_FLAG_DESCRIPTIONS = {
    "limited": "with the force at its limit",
    "rate_limited": "with a limited change of the force",
    "invalid": "with a force that was not a finite number",
    "lost_pose": "without a pose from the device",
    "active": "in which the hand had received more energy than it put in",
    "energy": "with the force switched off by the energy limit",
    "paused": "in pause",
}


class LoopStatusLine:
    """Status of a running loop in one line, read from its ring buffer without disturbing the loop.

    Args:
        ring: reader of the ring buffer.
        seconds: planned duration of the loop, s.
    """

    def __init__(self, ring: RingReader, seconds: float):
        self._ring, self._seconds, self._number = ring, seconds, 0

    def format_status_line(self) -> str:
        """Return the status line at every call; its quantiles are those of the ticks since the last call."""
        ticks = self._ring.read_ticks_after(self._number)
        self._number, records = ticks.number, ticks.records
        if not len(records):
            return "waiting for the next tick"
        newest = records[-1]
        compute, lateness = (np.quantile(records[name], 0.99) * 1e6 for name in ("compute_time", "lateness"))
        return (f"{newest['time']:.0f} of {self._seconds:g} s: {newest['tool_depth'] * 1e3:.2f} mm, "
                f"{newest['force']:.3f} N; p99 compute {compute:.0f}, lateness {lateness:.0f} us; "
                f"late {newest['late']}, missed {newest['missed']}")


def print_loop_report(report: LoopReport, console: Console) -> None:
    """Print the report of the loop: a table of lateness and compute time, then one sentence for each other result."""
    from rich.text import Text

    table = make_table_with_headings("", "p50", "p99", "p99.9", "max")
    answer = report.as_json()
    for title, key in (("lateness [us]", "lateness_us"), ("compute time [us]", "compute_us")):
        # As text: rich reads brackets as markup.
        table.add_row(Text(title), *(f"{value:.1f}" for value in answer[key].values()))
    console.print(table)
    print_sentence(console, f"{report.ticks} ticks in {report.seconds:.4g} s: {report.late} late (more than "
                   f"{TICKER.late * 1e3:g} ms), {report.missed} missed ({answer['missed_percent']:.3g} %)")
    answers = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in report.statuses.items() if count)
    if answers:
        print_sentence(console, f"simulation steps: {answers}")
    for name, count in report.flagged.items():
        if count:
            print_sentence(console, f"ticks {_FLAG_DESCRIPTIONS.get(name, name)}: {count}")
    if report.resolution not in ("", "own mesh"):
        error = "" if report.force_error is None else f", force error at most {100 * report.force_error:.2g} %"
        print_sentence(console, f"mesh: {report.resolution}{error}")
    print_sentence(console, f"largest force: {report.largest_force:.4g} N")
    if report.device.get("trouble"):
        print_sentence(console, f"the connection to the device was lost: {report.device['trouble']}")
    if report.peak_memory is not None:
        print_sentence(console, f"peak memory: {answer['peak_memory_MB']:.0f} MB")
    obtained = [feature.name for feature in report.real_time if feature.obtained]
    print_sentence(console, f"real time: {', '.join(obtained) if report.real_time else 'not requested'}")
    for feature in report.real_time:
        if not feature.obtained:
            print_sentence(console, f"real time: {feature.message}")
