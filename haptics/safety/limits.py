"""Force limits: the last thing between a computed force and a hand."""

from __future__ import annotations

import math

from tissue_sim.errors import InputError


class ForceLimits:
    """Limits the force, and its change from tick to tick.

    In place of a force that is not a finite number it goes to zero, at the same rate. It starts from zero.

    Args:
        force: largest magnitude, N; below what the device can hold and a hand can bear.
        rate: largest change in a tick, N. A tool at speed v on a stiffness k needs k v tick: 0.3 N at 0.2 m/s,
            1500 N/m and 1 ms.

    Attributes:
        last: force of the last step, N.
        limited: whether the magnitude was cut in the last step.
        rate_limited: whether the change was cut in the last step.
        invalid: whether the last force asked for was not a finite number.

    Raises:
        InputError: a limit that is not above zero, or not finite.
    """

    def __init__(self, force: float, rate: float):
        for value, unit, field in ((force, "N", "force"), (rate, "N per tick", "rate")):
            if not 0 < value < math.inf:
                raise InputError(f"{value:g} {unit} is no limit; give a finite number above zero", field=field)
        self.force, self.rate = force, rate
        self.reset()

    def reset(self):
        """Start from zero force."""
        self.last = 0.0
        self.limited = self.rate_limited = self.invalid = False

    def step(self, force: float) -> float:
        """The force to give in this tick, N."""
        self.invalid = not math.isfinite(force)
        wanted = 0.0 if self.invalid else force
        kept = min(max(wanted, -self.force), self.force)
        self.limited = kept != wanted
        given = min(max(kept, self.last - self.rate), self.last + self.rate)
        self.rate_limited = given != kept
        self.last = given
        return given

    @property
    def message(self) -> str:
        """What the last step did, in words."""
        if self.invalid:
            return "the force was not a number: going to zero"
        said = [word for cut, word in ((self.limited, f"cut to {self.force:g} N"),
                                       (self.rate_limited, f"changed by {self.rate:g} N only")) if cut]
        return ", ".join(said) or "as asked"
