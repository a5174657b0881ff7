"""Live progress of a calibration or a diagnosis: current task, remaining time and the iteration table of a fit."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich.console import Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.spinner import Spinner
from rich.table import Table
from rich.text import Text

from scenes.commands.shared.console import TaskLogLines, format_minutes_and_seconds, make_table_with_headings
from tissue_sim.laws import find_law

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

    from calibration.fit.fit import DescentEvaluation

_COMPILING = "loading the solver (the first run on a computer compiles it, about half a minute)"


@dataclass(frozen=True)
class ProgressDisplaySettings:
    """Layout and timing of the live progress.

    Attributes:
        max_rows: rows of the iteration table on a high terminal.
        min_rows: rows of the iteration table on a low terminal.
        other_lines: lines of the terminal that the table leaves free for headings and progress.
        bar_width: width of the progress bar, characters.
        compile_notice_after: delay before the note on the compilation of the solver, s; it must be shorter than the
            start of the compilation, which stops the refreshing thread.
        estimate_after: least duration of a part before its remaining time is estimated, s.
    """

    max_rows: int = 12
    min_rows: int = 3
    other_lines: int = 8
    bar_width: int = 20
    compile_notice_after: float = 0.5
    estimate_after: float = 1.0


_SETTINGS = ProgressDisplaySettings()


class CampaignProgressDisplay:
    """Live display of the progress of `calibration.calibrate` and `calibration.diagnose`; a context manager.

    The display disappears when the block ends.

    Args:
        console: progress console; a quiet console shows nothing.
        campaigns: number of campaigns.
        lines: log lines where the console is quiet because stderr is no terminal; None: no log lines.
    """

    def __init__(self, console: Console, campaigns: int = 1, lines: TaskLogLines | None = None):
        self._console, self._campaigns, self._lines = console, campaigns, lines
        self._sentence, self._start, self._last_report = "reading", time.monotonic(), time.monotonic()
        self._part_start = self._start
        self._campaign_and_law, self._solves = ("", ""), 0
        self._rows: list[DescentEvaluation] = []
        self._done, self._total, self._has_finished_task = 0, 0, False
        self._started_campaigns: list[str] = []
        self._spinner = Spinner("dots")
        self._live = Live(console=console, get_renderable=self.render_display, transient=True, refresh_per_second=8,
                          redirect_stdout=False, redirect_stderr=False)

    def __enter__(self) -> CampaignProgressDisplay:
        """Start the live display."""
        if not self._console.quiet:
            self._live.start()
        return self

    def __exit__(self, *failure) -> None:
        """Remove the live display."""
        self._live.stop()

    def show_task(self, sentence: str, done: int = 0, of: int = 0) -> None:
        """Show the current task and the number of finished tasks.

        Args:
            sentence: current task, in words.
            done: finished tasks of the current part.
            of: all tasks of the current part; 0 if unknown.
        """
        now = time.monotonic()
        # The sentence may change within a part, since it names the current task.
        if of != self._total or done < self._done or (not done and sentence != self._sentence):
            self._part_start = now
        self._sentence, self._last_report, self._done, self._total = sentence, now, done, of
        self._has_finished_task = self._has_finished_task or done > 0
        if self._live.is_started:
            # Refresh now: the refreshing thread stops while a kernel is compiled or runs.
            self._live.refresh()
        elif self._lines is not None:
            solves = f", {self._solves} solves" if self._solves else ""
            self._lines.update(f"{sentence}{f': {done} of {of}' if of else ''}{solves}")

    def print_above_display(self, sentence: str) -> None:
        """Print a sentence above the live display, where it stays."""
        self._console.print(sentence, style="dim", markup=False, emoji=False, highlight=False)

    def add_fit_iteration(self, campaign: str, law: str, iteration: DescentEvaluation) -> None:
        """Add one iteration of a fit to the table; a new campaign or law starts a new table."""
        if self._campaign_and_law != (campaign, law):
            self._campaign_and_law, self._rows = (campaign, law), []
        if campaign not in self._started_campaigns:
            self._started_campaigns.append(campaign)
        self._rows = [*self._rows, iteration][-_SETTINGS.max_rows:]
        self._solves += 1
        if self._lines is not None and not self._live.is_started:
            self._lines.update(f"{campaign}: {law}, {self._solves} solves")

    def render_display(self) -> Group:
        """Return the display: iteration table, current task, and a line with progress bar and times."""
        now = time.monotonic()
        seconds, width, number = round(now - self._start), _SETTINGS.bar_width, len(self._started_campaigns)
        line = Table.grid(padding=(0, 1))
        bar = ProgressBar(total=self._total, completed=self._done, width=width) if self._total else \
            ProgressBar(width=width, pulse=True, animation_time=now)
        line.add_row(self._spinner, bar, Text(f"{self._done} of {self._total}" if self._total else ""),
                     Text(format_minutes_and_seconds(seconds)), Text(self._describe_remaining_time(now)),
                     Text(f"{self._solves} solves" if self._solves else ""),
                     Text(f"campaign {max(number, 1)} of {self._campaigns}" if self._campaigns > 1 else ""))
        parts: list[RenderableType] = [self._make_iteration_table()] if self._rows else []
        parts += [Text(self._sentence), line]
        has_result = self._solves or self._has_finished_task
        if not has_result and now - self._last_report > _SETTINGS.compile_notice_after:
            parts.append(Text(_COMPILING, style="dim"))
        return Group(*parts)

    def _describe_remaining_time(self, now: float) -> str:
        """Return the estimated remaining time of the current tasks as text; empty without an estimate."""
        elapsed = self._last_report - self._part_start
        if not 0 < self._done < self._total or elapsed < _SETTINGS.estimate_after:
            return ""
        remaining = elapsed * (self._total - self._done) / self._done - (now - self._last_report)
        return f"about {format_minutes_and_seconds(max(round(remaining), 1))} remaining in this part"

    def _make_iteration_table(self) -> Table:
        """Return the iteration table of the current fit; parameters in SI units."""
        law = find_law(self._campaign_and_law[1])
        names = list(self._rows[-1].parameters)
        # The last component of a parameter path, such as bulk_ratio of bulk.bulk_ratio, is enough as a heading.
        headings = [f"{name.rpartition('.')[2]} {law.units.get(name, '')}".removesuffix("1").strip() for name in names]
        table = make_table_with_headings("start", "run", *headings, "error", "RMSE", "mesh", text=0)
        for column in table.columns[2:2 + len(names)]:
            column.no_wrap, column.overflow = False, "fold"
        visible_rows = max(self._console.size.height - _SETTINGS.other_lines, _SETTINGS.min_rows)
        for row in self._rows[-visible_rows:]:
            table.add_row(str(row.start), str(row.run), *(f"{row.parameters[name]:.5g}" for name in names),
                          f"{row.error:.6g}", f"{row.RMSE_N:.3g}", "corrected" if row.corrected else "fast")
        table.title, table.title_justify = Text(law.name, style="bold not italic"), "left"
        return table
