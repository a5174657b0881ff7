"""A tool whose outline is read from a file."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from tissue_sim.errors import InputError
from tissue_sim.experiment.tools.tool import SHAFT_LENGTH, Profile, Tool, edge_radius

if TYPE_CHECKING:
    import numpy as np


@dataclass(frozen=True)
class RoundingSettings:
    """Default rounding of the corners of an outline.

    Attributes:
        fraction: radius of the rounding over the radius of the tool, 1; the radius is halved until it fits the shortest
            segment.
        most_halvings: largest number of halvings.
    """

    fraction: float = 0.02
    most_halvings: int = 10


#: Rounding of every outline.
ROUNDING = RoundingSettings()


@dataclass(frozen=True)
class ProfileTool(Tool):
    """A convex needle of any outline.

    Attributes:
        radius: largest radius of the file, m.
        edge_radius: radius of the rounding of the corners, m; 0: `RoundingSettings.fraction` of the radius, or
            the largest that fits the segments.
        profile_file: see `tissue_sim.experiment.tools.profile_file`.
        points: content of the file, (r, z) of each point, m, if the file is not to be read again.

    Raises:
        InputError: no file, a radius that differs from that of the file, an error of `read_outline_points`, a segment
            that is too short for the rounding.
    """

    name = "profile"
    from_file = True
    radius: float | None = None
    edge_radius: float = edge_radius()
    profile_file: str | Path | None = None
    points: tuple[tuple[float, float], ...] | None = field(default=None, repr=False)

    def __post_init__(self):
        widest = self._largest_outline_radius
        if self.radius is not None and abs(self.radius - widest) > 1e-9 * widest:
            raise InputError(f"the profile's radius is {widest:g} m; leave the radius out", field="tool.radius")
        object.__setattr__(self, "radius", widest)
        if not self.edge_radius:
            self._set_default_rounding_halved_to_fit()
        self.require_valid_radius_and_roundings("edge_radius")

    def _set_default_rounding_halved_to_fit(self) -> None:
        """Set `edge_radius` to the default rounding, halved until the rounding fits the outline."""
        for halvings in range(ROUNDING.most_halvings):
            object.__setattr__(self, "edge_radius", ROUNDING.fraction * self._largest_outline_radius / 2**halvings)
            try:
                _ = self.profile
                return
            except InputError:
                continue

    @cached_property
    def outline(self) -> np.ndarray:
        """Outline of the file, (r, z), m, shape (n, 2)."""
        from tissue_sim.experiment.tools.profile_file import find_first_invalid_point_and_problem, read_outline_points

        if self.points is not None:
            import numpy as np

            outline = np.array(self.points, dtype=float).reshape(-1, 2)
            if len(outline) < 2 or not np.isfinite(outline).all():
                raise InputError("a profile needs at least two points, r and z in m", field="tool.points")
            if fault := find_first_invalid_point_and_problem(outline):
                raise InputError(fault[1], field=f"tool.points[{fault[0]}]")
            return outline
        if self.profile_file is None:
            raise InputError("a profile tool needs the file of its profile", field="tool.profile_file")
        return read_outline_points(self.profile_file)

    @property
    def _largest_outline_radius(self) -> float:
        """Largest radius of the outline, m."""
        return float(self.outline[:, 0].max())

    @property
    def profile(self) -> Profile:
        """Outline for contact: the polyline is that of the file, offset inwards by the rounding."""
        import numpy as np

        outline = self.outline
        top = [[outline[-1, 0], outline[-1, 1] + SHAFT_LENGTH * self._largest_outline_radius]]
        if outline[-1, 0] == outline[-2, 0]:
            outline = outline[:-1]
        outline = np.concatenate([outline, top])
        rounding = self.edge_radius
        segment = np.diff(outline, axis=0)
        inward = np.stack([-segment[:, 1], segment[:, 0]], axis=-1) / np.linalg.norm(segment, axis=1)[:, None]
        chain = outline.copy()
        chain[0] += rounding * np.array([0.0, 1.0]) / inward[0, 1]
        chain[-1] += rounding * inward[-1]
        for k in range(1, len(segment)):
            # Intersection of the two offset segments.
            chain[k] += rounding * (inward[k - 1] + inward[k]) / (1.0 + inward[k - 1] @ inward[k])
        if (np.einsum("ki,ki->k", np.diff(chain, axis=0), segment) <= 0).any():
            raise InputError(f"a segment of the profile is too short for corners rounded by {rounding:g} m; give a "
                             "smaller edge radius", field="tool.edge_radius")
        # Rounding moves the deepest point, which must be the origin.
        chain[:, 1] -= chain[0, 1] - rounding
        return Profile(chain, rounding, int(np.flatnonzero(segment[:, 0] == 0.0)[0]))

    @property
    def face_radius(self) -> float:
        """Radius of the flat part of the face, without the rounding of its edge, m; 0 without a flat face."""
        return max(0.0, float(self.outline[self.outline[:, 1] == 0.0, 0].max()) - self.edge_radius)

    def contact_radius(self, depth: float, specimen_radius: float = float("inf")) -> float:
        """Estimate the radius of the contact at a depth from the width of the outline there, m."""
        import numpy as np

        wide = float(np.interp(depth, self.outline[:, 1], self.outline[:, 0]))
        return max(self.face_radius, 1e-3 * self._largest_outline_radius,
                   wide if self.face_radius else 2.0 / np.pi * wide)
