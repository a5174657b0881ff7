"""Force limits: the last thing between a computed wrench and a hand."""

from __future__ import annotations

from itertools import compress
from math import hypot, inf, isfinite

from tissue_sim.errors import InputError
from tissue_sim.pose import Screw, Vector

_NO_WRENCH: Screw = (0.0,) * 6


class ForceLimits:
    """Limits the magnitudes of force and torque, and their changes from tick to tick; directions are kept.

    In place of a wrench that is not finite they go to zero, at the same rate. They start from zero.

    Args:
        force: largest magnitude, N; below what the device can hold and a hand can bear.
        rate: largest change of the force in a tick, N. A tool at speed v on a stiffness k needs k v tick: 0.3 N at
            0.2 m/s, 1500 N/m and 1 ms.
        torque: largest magnitude, N m.
        torque_rate: largest change of the torque in a tick, N m.

    Attributes:
        last: wrench of the last step, N and N m.
        limited: whether a magnitude was cut in the last step.
        rate_limited: whether a change was cut in the last step.
        invalid: whether the last wrench asked for was not finite.

    Raises:
        InputError: a limit that is not above zero, or not finite.
    """

    def __init__(self, force: float, rate: float, torque: float = 1.0, torque_rate: float = 0.1):
        for value, unit, field in ((force, "N", "force"), (rate, "N per tick", "rate"), (torque, "N m", "torque"),
                                   (torque_rate, "N m per tick", "torque_rate")):
            if not 0 < value < inf:
                raise InputError(f"{value:g} {unit} is no limit; give a finite number above zero", field=field)
        self.force, self.rate, self.torque, self.torque_rate = force, rate, torque, torque_rate
        self.reset()

    def reset(self):
        """Start from no force and no torque."""
        self.last = _NO_WRENCH
        self.limited = self.rate_limited = self.invalid = False
        #: Whether force, its change, torque, its change were cut in the last step that cut any.
        self._changes = (False, False, False, False)

    def step(self, wrench: Screw) -> Screw:
        """The wrench to give in this tick, N and N m."""
        self.invalid = not isfinite(sum(wrench))
        a, b, c, d, e, f = wanted = _NO_WRENCH if self.invalid else wrench
        u, v, w, x, y, z = last = self.last
        if (hypot(a, b, c) <= self.force and hypot(a - u, b - v, c - w) <= self.rate
                and hypot(d, e, f) <= self.torque and hypot(d - x, e - y, f - z) <= self.torque_rate):
            self.limited = self.rate_limited = False
            self.last = wanted
            return wanted
        force, cut, slowed = _limited(wanted[:3], last[:3], self.force, self.rate)
        torque, torque_cut, torque_slowed = _limited(wanted[3:], last[3:], self.torque, self.torque_rate)
        self.limited, self.rate_limited = cut or torque_cut, slowed or torque_slowed
        self._changes = (cut, slowed, torque_cut, torque_slowed)
        self.last = force + torque
        return self.last

    @property
    def message(self) -> str:
        """What the last step did, in words."""
        if self.invalid:
            return "the force was not a number: going to zero"
        if not (self.limited or self.rate_limited):
            return "as asked"
        words = (f"cut to {self.force:g} N", f"changed by {self.rate:g} N only",
                 f"cut to {self.torque:g} N m", f"changed by {self.torque_rate:g} N m only")
        return ", ".join(compress(words, self._changes))


def _limited(wanted: Vector, last: Vector, largest: float, rate: float) -> tuple[Vector, bool, bool]:
    """A vector within its limits, whether its magnitude was cut, and whether its change was."""
    x, y, z = wanted
    cut = not hypot(x, y, z) <= largest
    if cut:
        # The direction first, by the largest part: along an axis it is 1, and the limit is met to the last digit. And
        # above 4e307 hypot is no number in processes whose libraries round denormals to zero.
        most = max(abs(x), abs(y), abs(z))
        x, y, z = x / most, y / most, z / most
        size = hypot(x, y, z)
        wanted = x, y, z = x / size * largest, y / size * largest, z / size * largest
    a, b, c = last
    change = hypot(x - a, y - b, z - c)
    if change <= rate:
        return wanted, cut, False
    given = (a + (x - a) / change * rate, b + (y - b) / change * rate, c + (z - c) / change * rate)
    return given, cut, given != wanted
