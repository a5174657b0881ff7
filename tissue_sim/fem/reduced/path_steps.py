"""Simulation of a reduced solid along the poses of a training or test path."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from tissue_sim.fem.reduced.settings import VERIFICATION
from tissue_sim.fem.reduced.solver import ReducedSolver
from tissue_sim.fem.solver import Step
from tissue_sim.pose import Pose, interpolate_pose


def simulate_reduced_path(small: ReducedSolver, poses: Sequence[Pose]) -> Iterator[Step]:
    """Simulate a reduced solid from rest along poses of the tool, and yield the step that ends at each pose."""
    small.reset_to_rest()
    for last_pose, pose in zip([poses[0], *poses], poses, strict=False):
        for k in range(VERIFICATION.substeps):
            step = small.step(interpolate_pose(last_pose, pose, (k + 1) / VERIFICATION.substeps))
        yield step
