"""Increments of a path that are halved after a failure and doubled after a success."""

from __future__ import annotations

#: Remaining fraction of a path up to which the last increment is extended to the end of the path, 1.
ROUNDING = 1e-9


class AdaptiveIncrements:
    """Increments of a path from 0 to 1: the next one is twice as long after a success and half as long after a failure.

    Args:
        smallest: smallest increment, 1.
        largest: largest increment, which is the first one, 1.

    Attributes:
        done: completed fraction of the path, 1.
        length: length of the next increment, 1; it may exceed the remaining fraction.
    """

    def __init__(self, smallest: float, largest: float = 1.0):
        self._smallest, self._largest = smallest, largest
        self.done, self.length = 0.0, largest

    @property
    def end(self) -> float:
        """Fraction of the path at the end of the next increment, 1; exactly 1 for the last one."""
        end = self.done + self.length
        return 1.0 if end >= 1.0 - ROUNDING else end

    @property
    def is_complete(self) -> bool:
        """Whether the end of the path is reached."""
        return self.done == 1.0

    def advance(self) -> None:
        """Complete the next increment, and double the length of the one after it."""
        self.done, self.length = self.end, min(2.0 * self.length, self._largest)

    def halve_and_check_size(self) -> bool:
        """Halve the next increment; return False if it is then smaller than the smallest one."""
        self.length /= 2.0
        return self.length >= self._smallest
