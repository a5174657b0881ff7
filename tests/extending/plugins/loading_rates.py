"""A section of calibration reports: the loading rate of each recording."""

from calibration.report.content import Column, Paragraph, Span, Table
from calibration.report.section import Section


class LoadingRates(Section):
    """Mean rate of displacement of each recording, with a mark for slow ones."""

    name = "loading_rates"
    title = "Loading rates"
    before = "ranking"
    #: Rate below which a recording is marked, mm/s.
    SLOW = 0.1

    def iterate_blocks(self, report):
        """Yield a note and the table; nothing if no recording has times."""
        timed = [curve for curves in report.recordings.values() for curve in curves if curve.time is not None]
        if not timed:
            return
        yield Paragraph(f"Recordings below {self.SLOW:g} mm/s are marked.", quiet=True)
        rates = {curve.name: 1e3 * float(abs(curve.displacement[-1]) / curve.time[-1]) for curve in timed}
        yield Table([Column("Recording"), Column("Rate [mm/s]")],
                    [[name, Span(f"{rate:.3g}", "bad" if rate < self.SLOW else "")] for name, rate in rates.items()])
