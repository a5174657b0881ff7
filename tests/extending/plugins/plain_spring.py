"""A solver without fields: the spring of `spring_solver`, drawn as a square."""

from dataclasses import dataclass

import numpy as np
from spring_solver import SpringSolver


@dataclass(frozen=True)
class Square:
    """A square under the tool."""

    outline = None

    def triangles(self, segments: int = 48):
        corners = 0.01 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], dtype=float)
        return corners, np.array([[0, 1, 2], [0, 2, 3]])


class PlainSpringSolver(SpringSolver):
    """The spring without fields."""

    def field_sample(self):
        return None

    def fields(self, samples):
        return None

    def deformed_surface(self):
        return Square()
