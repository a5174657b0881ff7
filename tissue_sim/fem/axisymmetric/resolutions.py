"""What the names of resolutions stand for: how fine a mesh is, and by how much its force errs."""

from __future__ import annotations

from math import isnan, nan
from typing import NamedTuple

from tissue_sim.experiment.experiment import Experiment
from tissue_sim.fem.solver import ErrorEstimate, ResolutionLevel


class Grading(NamedTuple):
    """Smallest and largest element in radii of the needle, or of the contact at the largest depth, and growth from one
    to the next."""

    smallest: float
    largest: float
    growth: float


class Resolution(NamedTuple):
    """Meshes of one fineness.

    Attributes:
        plates: elements and grading along r and z of a cylinder of `STUDY_SLENDERNESS` between plates.
        needle: under a flat tool; tip: under one without a flat face.
        rubbed_edge: under a flat tool with friction, or on which tissue sticks, where its edge radius is smaller than
            the elements there otherwise: they are as large as it is, but not smaller than these. None: as others.
        layer_elements: fewest in a layer of the material.
        error_estimate: what tells how far its force errs. Coarser meshes tell nothing, since contact round an edge errs
            otherwise on each; half of what a much finer mesh differs by is near its error where steps are too long.
        force_errors: largest error of the force under a plate, a flat tool and a tip, over the force, of the study's
            specimen from 2 to 10 mm (`benchmarks/realtime_ladder.py`), and under a flat tool without friction, over the
            largest force, down to a rounded edge of a sixteenth of the radius and with C20 down to none; NaN: not for
            such a tool. Empty of those that are not for real time.
    """

    plates: tuple[tuple[int, int], tuple[float, float]]
    needle: Grading
    tip: Grading
    force_errors: tuple[float, ...] = ()
    layer_elements: int = 2
    rubbed_edge: Grading | None = None
    error_estimate: ErrorEstimate | None = None


#: Height over radius of the study's specimen (radius 40, height 70 mm).
STUDY_SLENDERNESS = 70.0 / 40.0
#: Those for real time are called by their elements under the study's needle.
RESOLUTIONS = {
    "realtime_120": Resolution(((8, 10), (15.0, 6.0)), Grading(0.05, 1.8, 2.0), Grading(0.15, 2.5, 1.6),
                               (0.006, 0.004, 0.005, 0.032)),
    "realtime_63": Resolution(((6, 8), (10.0, 4.0)), Grading(0.1, 2.25, 2.5), Grading(0.25, 2.5, 1.6),
                              (0.008, 0.011, 0.015, 0.046)),
    "realtime_35": Resolution(((4, 6), (10.0, 4.0)), Grading(0.15, 3.0, 4.0), Grading(0.3, 3.0, 3.0),
                              (0.008, 0.015, 0.016, 0.065)),
    "realtime_20": Resolution(((4, 4), (8.0, 4.0)), Grading(0.2, 5.0, 6.0), Grading(0.35, 4.0, 4.0),
                              (0.01, 0.027, 0.022, nan)),
    "fast": Resolution(((6, 8), (10.0, 4.0)), Grading(0.1625, 1.875, 1.8), Grading(0.25, 2.5, 1.6),
                       rubbed_edge=Grading(0.03, 1.875, 2.2), error_estimate=ErrorEstimate("realtime_120", 1.0)),
    "accurate": Resolution(((16, 20), (50.0, 25.0)), Grading(0.00625, 1.5, 1.5), Grading(0.08, 1.5, 1.35),
                           layer_elements=4, error_estimate=ErrorEstimate("realtime_120", 0.5)),
    "finest": Resolution(((22, 28), (150.0, 25.0)), Grading(0.005, 1.0, 1.4), Grading(0.05, 1.0, 1.25),
                         layer_elements=6),
}
#: What a name stands for where nobody measures what the computer can do.
UNMEASURED = {"realtime": "realtime_63"}


def realtime_levels(experiment: Experiment) -> tuple[ResolutionLevel, ...]:
    """Resolutions of a test for real time, the finest first. Tissue that slides freely round an edge finds wrong
    equilibria on the coarsest (15 to 45 % of the force, of nearly neo-Hookean tissue after 8 mm)."""
    tool, free = experiment.tool, experiment.friction in ("frictionless", 0.0)
    kind = 0 if tool.is_plate else 2 if not tool.face_radius else 3 if free else 1
    return tuple(ResolutionLevel(name, one.force_errors[kind]) for name, one in RESOLUTIONS.items()
                 if one.force_errors and not isnan(one.force_errors[kind]))
