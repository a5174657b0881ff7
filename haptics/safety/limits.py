"""Limit the force on the hand: magnitude and rate of change of force and torque, as the last step before the device."""

from __future__ import annotations

from itertools import compress
from math import hypot, inf, isfinite

from tissue_sim.errors import InputError
from tissue_sim.pose import Screw, Vector
from tissue_sim.public_names import make_getattr_for_old_names, with_old_names

_FADING = "tissue_sim.realtime.force_fading"
__getattr__ = make_getattr_for_old_names(__name__, {
    "ForceLimits": "ForceLimiter", "ForceRelease": f"{_FADING}:ForceFader",
    **{name: f"{_FADING}:{name}" for name in ("RELEASE", "ForceFadeTimesAndThresholds", "ForceFader", "Watchdog",
                                              "WatchdogState")}})

_NO_WRENCH: Screw = (0.0,) * 6


@with_old_names(message="active_limits_description")
class ForceLimiter:
    """Limit the magnitudes of force and torque, and their changes between two ticks; directions are kept.

    The limiter starts from zero force and torque. A wrench that is not finite is replaced by zero force and torque,
    which are approached at the same limited rate.

    Args:
        force: largest magnitude of the force, N; below the force that the device can hold and a hand can bear.
        rate: largest change of the force in a tick, N. A tool at speed v on a stiffness k needs k v tick: 0.3 N at
            0.2 m/s, 1500 N/m and 1 ms.
        torque: largest magnitude of the torque, N m.
        torque_rate: largest change of the torque in a tick, N m.

    Attributes:
        last: wrench of the last step, N and N m.
        limited: whether a magnitude was limited in the last step.
        rate_limited: whether a change was limited in the last step.
        invalid: whether the wrench of the last step was not finite.

    Raises:
        InputError: a limit is not positive and finite.
    """

    def __init__(self, force: float, rate: float, torque: float = 1.0, torque_rate: float = 0.1):
        for value, unit, field in ((force, "N", "force"), (rate, "N per tick", "rate"), (torque, "N m", "torque"),
                                   (torque_rate, "N m per tick", "torque_rate")):
            if not 0 < value < inf:
                raise InputError(f"a force limit must be positive and finite; got {value:g} {unit}", field=field)
        self.force, self.rate, self.torque, self.torque_rate = force, rate, torque, torque_rate
        self.reset()

    def reset(self):
        """Restart the rate limits from zero force and torque."""
        self.last = _NO_WRENCH
        self.limited = self.rate_limited = self.invalid = False
        #: Whether the force, its change, the torque and its change were limited in the last step that limited any.
        self._limited_parts = (False, False, False, False)

    def step(self, wrench: Screw) -> Screw:
        """Return the limited wrench of this tick, N and N m.

        Args:
            wrench: requested force and torque, N and N m.
        """
        self.invalid = not isfinite(sum(wrench))
        a, b, c, d, e, f = requested = _NO_WRENCH if self.invalid else wrench
        u, v, w, x, y, z = last = self.last
        if (hypot(a, b, c) <= self.force and hypot(a - u, b - v, c - w) <= self.rate
                and hypot(d, e, f) <= self.torque and hypot(d - x, e - y, f - z) <= self.torque_rate):
            self.limited = self.rate_limited = False
            self.last = requested
            return requested
        force, limited, rate_limited = _limit_magnitude_and_change(requested[:3], last[:3], self.force, self.rate)
        torque, torque_limited, torque_rate_limited = _limit_magnitude_and_change(
            requested[3:], last[3:], self.torque, self.torque_rate)
        self.limited, self.rate_limited = limited or torque_limited, rate_limited or torque_rate_limited
        self._limited_parts = (limited, rate_limited, torque_limited, torque_rate_limited)
        self.last = force + torque
        return self.last

    @property
    def active_limits_description(self) -> str:
        """Limits of force, torque and their changes that acted in the last step; ``not limited`` if no limit acted.

        A wrench that is not finite has a sentence without the other limits.
        """
        if self.invalid:
            return "the force was not a number: going to zero"
        if not (self.limited or self.rate_limited):
            return "not limited"
        descriptions = (f"force limited to {self.force:g} N", f"change of the force limited to {self.rate:g} N",
                        f"torque limited to {self.torque:g} N m",
                        f"change of the torque limited to {self.torque_rate:g} N m")
        return ", ".join(compress(descriptions, self._limited_parts))


def _limit_magnitude_and_change(requested: Vector, last: Vector, largest: float,
                                rate: float) -> tuple[Vector, bool, bool]:
    """Limit the magnitude of a vector and its distance to the last one.

    Args:
        requested: vector of this tick.
        last: vector of the last tick.
        largest: largest magnitude.
        rate: largest distance between `last` and the result.

    Returns:
        The limited vector, whether its magnitude was limited, and whether its change was limited.
    """
    x, y, z = requested
    limited = not hypot(x, y, z) <= largest
    if limited:
        # Division by the largest component first: a vector along an axis then meets the limit to the last digit. Above
        # 4e307, hypot is not finite in processes whose libraries flush denormal numbers to zero.
        scale = max(abs(x), abs(y), abs(z))
        x, y, z = x / scale, y / scale, z / scale
        size = hypot(x, y, z)
        requested = x, y, z = x / size * largest, y / size * largest, z / size * largest
    a, b, c = last
    change = hypot(x - a, y - b, z - c)
    if change <= rate:
        return requested, limited, False
    result = (a + (x - a) / change * rate, b + (y - b) / change * rate, c + (z - c) / change * rate)
    return result, limited, result != requested
