"""Named resolutions of the axisymmetric solid: element sizes, and largest errors of the force."""

from __future__ import annotations

from math import isnan, nan
from typing import NamedTuple

from tissue_sim.experiment.experiment import Experiment
from tissue_sim.fem.solver import ErrorEstimationRule, ResolutionLevel


class NeedleMeshGrading(NamedTuple):
    """Grading of a mesh under a needle, in radii of the needle, or of the contact at the largest depth.

    Attributes:
        smallest: size of the smallest element.
        largest: size of the largest element.
        growth: ratio of the sizes of neighbouring elements.
    """

    smallest: float
    largest: float
    growth: float


class MeshResolution(NamedTuple):
    """Element sizes of one named resolution, for plates, flat tools and tips, and their force errors.

    Attributes:
        plates: number of elements along r and z, and grading along r and z, of a cylinder of `STUDY_SLENDERNESS`
            between plates.
        needle: grading under a flat tool.
        tip: grading under a tool without a flat face.
        force_errors: largest relative error of the force under a plate, a flat tool and a tip for the specimen of the
            study from 2 to 10 mm (`benchmarks/realtime/resolution_levels.py`), and under a frictionless flat tool, over
            the largest force, for edge radii down to a sixteenth of the radius (with C20 down to none). NaN: the
            resolution is not valid for such a tool. Empty: the resolution is not for real time.
        layer_elements: smallest number of elements across a layer of the material.
        rubbed_edge: grading under a flat tool with friction or stick whose edge radius is smaller than the elements:
            the smallest elements are as large as the edge radius but not smaller than `rubbed_edge.smallest`. None: as
            under other tools.
        error_estimation_rule: reference resolution and factor of the estimated error. Coarser meshes give no estimate,
            because the error of the contact around an edge differs from mesh to mesh. Half of the difference from a
            much finer mesh is close to the error if the depth steps are too long.
    """

    plates: tuple[tuple[int, int], tuple[float, float]]
    needle: NeedleMeshGrading
    tip: NeedleMeshGrading
    force_errors: tuple[float, ...] = ()
    layer_elements: int = 2
    rubbed_edge: NeedleMeshGrading | None = None
    error_estimation_rule: ErrorEstimationRule | None = None


#: Height over radius of the specimen of the study (radius 40 mm, height 70 mm).
STUDY_SLENDERNESS = 70.0 / 40.0
#: Name -> mesh sizes. The names of real-time resolutions contain the number of elements under the needle of the study.
RESOLUTIONS = {
    "realtime_120": MeshResolution(((8, 10), (15.0, 6.0)), NeedleMeshGrading(0.05, 1.8, 2.0),
                                   NeedleMeshGrading(0.15, 2.5, 1.6), (0.006, 0.004, 0.005, 0.032)),
    "realtime_63": MeshResolution(((6, 8), (10.0, 4.0)), NeedleMeshGrading(0.1, 2.25, 2.5),
                                  NeedleMeshGrading(0.25, 2.5, 1.6), (0.008, 0.011, 0.015, 0.046)),
    "realtime_35": MeshResolution(((4, 6), (10.0, 4.0)), NeedleMeshGrading(0.15, 3.0, 4.0),
                                  NeedleMeshGrading(0.3, 3.0, 3.0), (0.008, 0.015, 0.016, 0.065)),
    "realtime_20": MeshResolution(((4, 4), (8.0, 4.0)), NeedleMeshGrading(0.2, 5.0, 6.0),
                                  NeedleMeshGrading(0.35, 4.0, 4.0), (0.01, 0.027, 0.022, nan)),
    "fast": MeshResolution(((6, 8), (10.0, 4.0)), NeedleMeshGrading(0.1625, 1.875, 1.8),
                           NeedleMeshGrading(0.25, 2.5, 1.6), rubbed_edge=NeedleMeshGrading(0.03, 1.875, 2.2),
                           error_estimation_rule=ErrorEstimationRule("realtime_120", 1.0)),
    "accurate": MeshResolution(((16, 20), (50.0, 25.0)), NeedleMeshGrading(0.00625, 1.5, 1.5),
                               NeedleMeshGrading(0.08, 1.5, 1.35), layer_elements=4,
                               error_estimation_rule=ErrorEstimationRule("realtime_120", 0.5)),
    "finest": MeshResolution(((22, 28), (150.0, 25.0)), NeedleMeshGrading(0.005, 1.0, 1.4),
                             NeedleMeshGrading(0.05, 1.0, 1.25), layer_elements=6),
}
#: Name that requires a speed measurement -> resolution without the measurement.
UNMEASURED = {"realtime": "realtime_63"}


def list_realtime_levels_finest_first(experiment: Experiment) -> tuple[ResolutionLevel, ...]:
    """Return the resolutions that are valid in real time for an experiment, the finest first.

    The coarsest mesh is not valid for tissue that slides without friction around an edge: it finds wrong equilibria
    (errors of 15 to 45 % of the force for nearly neo-Hookean tissue deeper than 8 mm).
    """
    tool, free = experiment.tool, experiment.friction in ("frictionless", 0.0)
    tool_kind = 0 if tool.is_plate else 2 if not tool.face_radius else 3 if free else 1
    return tuple(ResolutionLevel(name, one.force_errors[tool_kind]) for name, one in RESOLUTIONS.items()
                 if one.force_errors and not isnan(one.force_errors[tool_kind]))


def find_force_error_of_resolution_or_none(experiment: Experiment, resolution: str) -> float | None:
    """Return the largest known relative error of the force for a resolution, 1; None if it is unknown."""
    name = UNMEASURED.get(resolution, resolution)
    levels = list_realtime_levels_finest_first(experiment)
    return next((level.force_error for level in levels if level.resolution == name), None)
