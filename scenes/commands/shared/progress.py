"""A calibration or a diagnosis as it goes: what is being done, and the iteration table of a fit that is under way."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

from rich.console import Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.spinner import Spinner
from rich.table import Table
from rich.text import Text

from scenes.commands.shared.log_lines import LogLines, clock
from scenes.commands.shared.text_table import text_table
from tissue_sim.laws import find_law

if TYPE_CHECKING:
    from rich.console import Console, RenderableType

    from calibration.fit.fit import Iteration

#: Rows of the table: at most so many, at least so many, and lines that the screen needs beside them.
_MOST_ROWS, _FEWEST_ROWS, _OTHER_LINES = 12, 3, 8
#: s after which the first run of a machine is mentioned: before it compiles, which stops the picture.
_PATIENCE = 0.5
_BAR_WIDTH = 20
#: s of a part after which the tasks that are done tell something of those that are not.
_TOLD_AFTER = 1.0
_COMPILING = "loading the solver (a machine's first run compiles it, about half a minute)"


class CampaignProgress:
    """What `calibration.calibrate` and `calibration.diagnose` report, live on a terminal; gone when the block ends.

    Args:
        console: of the progress; when it is quiet nothing is drawn.
        campaigns: how many there are.
        lines: instead, where there is no terminal; None: none.
    """

    def __init__(self, console: Console, campaigns: int = 1, lines: LogLines | None = None):
        self._console, self._campaigns, self._lines = console, campaigns, lines
        self._sentence, self._began, self._said = "reading", time.monotonic(), time.monotonic()
        self._part_began = self._began
        self._place, self._solves = ("", ""), 0
        self._rows: list[Iteration] = []
        self._done, self._of, self._worked = 0, 0, False
        self._seen: list[str] = []
        self._spinner = Spinner("dots")
        self._live = Live(console=console, get_renderable=self.render, transient=True, refresh_per_second=8,
                          redirect_stdout=False, redirect_stderr=False)

    def __enter__(self) -> CampaignProgress:
        if not self._console.quiet:
            self._live.start()
        return self

    def __exit__(self, *failure) -> None:
        self._live.stop()

    def say(self, sentence: str, done: int = 0, of: int = 0) -> None:
        """Show what is done from now on, and how many of its tasks are done, of how many."""
        now = time.monotonic()
        # Of one part the sentence names what is worked on.
        if of != self._of or done < self._done or (not done and sentence != self._sentence):
            self._part_began = now
        self._sentence, self._said, self._done, self._of = sentence, now, done, of
        self._worked = self._worked or done > 0
        if self._live.is_started:
            # At once: a kernel that is compiled, or runs, keeps the refreshing thread waiting.
            self._live.refresh()
        elif self._lines is not None:
            solves = f", {self._solves} solves" if self._solves else ""
            self._lines.update(f"{sentence}{f': {done} of {of}' if of else ''}{solves}")

    def announce(self, sentence: str) -> None:
        """Say something that stays, above what is done."""
        self._console.print(sentence, style="dim", markup=False, emoji=False, highlight=False)

    def listen(self, campaign: str, law: str, iteration: Iteration) -> None:
        """Add a solve to the table; another law, or campaign, begins a new one."""
        if self._place != (campaign, law):
            self._place, self._rows = (campaign, law), []
        if campaign not in self._seen:
            self._seen.append(campaign)
        self._rows = [*self._rows, iteration][-_MOST_ROWS:]
        self._solves += 1
        if self._lines is not None and not self._live.is_started:
            self._lines.update(f"{campaign}: {law}, {self._solves} solves")

    def render(self) -> Group:
        """The table, if any, above a line that says what is done."""
        now = time.monotonic()
        seconds = round(now - self._began)
        line = Table.grid(padding=(0, 1))
        bar = ProgressBar(total=self._of, completed=self._done, width=_BAR_WIDTH) if self._of else \
            ProgressBar(width=_BAR_WIDTH, pulse=True, animation_time=now)
        line.add_row(self._spinner, bar, Text(f"{self._done} of {self._of}" if self._of else ""),
                     Text(clock(seconds)), Text(self._left(now)),
                     Text(f"{self._solves} solves" if self._solves else ""),
                     Text(f"campaign {max(len(self._seen), 1)} of {self._campaigns}" if self._campaigns > 1 else ""))
        parts: list[RenderableType] = [self._table()] if self._rows else []
        parts += [Text(self._sentence), line]
        if not (self._solves or self._worked) and now - self._said > _PATIENCE:
            parts.append(Text(_COMPILING, style="dim"))
        return Group(*parts)

    def _left(self, now: float) -> str:
        """How long the tasks of this part will still take, by those that are done; empty until that can be told."""
        taken = self._said - self._part_began
        if not 0 < self._done < self._of or taken < _TOLD_AFTER:
            return ""
        left = taken * (self._of - self._done) / self._done - (now - self._said)
        return f"about {clock(max(round(left), 1))} left of this part"

    def _table(self) -> Table:
        law = find_law(self._place[1])
        names = list(self._rows[-1].parameters)
        # All in SI; the last part of a path tells which it is.
        headings = [f"{name.rpartition('.')[2]} {law.units.get(name, '')}".removesuffix("1").strip() for name in names]
        table = text_table("start", "run", *headings, "error", "RMSE", "mesh", text=0)
        for column in table.columns[2:2 + len(names)]:
            column.no_wrap, column.overflow = False, "fold"
        room = self._console.size.height - _OTHER_LINES
        for row in self._rows[-max(room, _FEWEST_ROWS):]:
            table.add_row(str(row.start), str(row.run), *(f"{row.parameters[name]:.5g}" for name in names),
                          f"{row.error:.6g}", f"{row.RMSE_N:.3g}", "corrected" if row.corrected else "fast")
        table.title, table.title_justify = Text(law.name, style="bold not italic"), "left"
        return table
