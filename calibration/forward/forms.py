"""Which form of forward model answers a test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from calibration.campaign.campaign import FitSettings, Test
from calibration.campaign.measured import MeasuredCurve, remembers
from calibration.forward.closed import ClosedTest
from calibration.forward.column import ColumnTest
from calibration.forward.contract import ForwardTest
from calibration.forward.meshes import (
    COARSEST_REMAINDER,
    FINEST_REMAINDERS,
    LEFT_OF_DIFFERENCE,
    LEFT_OF_ORDER,
    REMAINDERS,
    meshes_of,
)
from calibration.forward.motion import Loading, Timed
from calibration.forward.simulated import SimulatedTest
from calibration.forward.solves import content_key
from tissue_sim.experiment.protocol import STUDY_SPEED, Protocol

#: Of an analytical fit: histories are divided less finely than for a prediction, 1e-4 of the largest stress, below what
#: is measured.
FITTED_STEP = 0.01
#: Tests on one mesh may differ in their motion.
_ANY_MOTION = Protocol(np.array([0.0, 1.0]), np.array([0.0, 1e-9]))
#: The simulated way goes on for so many standard deviations of the contact offset, but for this share at least.
_MARGIN, _LEAST_MARGIN = 4.0, 1e-3


def build_test(test: Test, curves: Sequence[MeasuredCurve], settings: FitSettings,
               contact: float) -> SimulatedTest | ClosedTest:
    """A test and how it is simulated; `contact` is the standard deviation of the contact offset, m."""
    material = settings.material
    curves = tuple(curves)
    if test.experiment is None or curves[0].stressed:
        return closed_test(test, curves)
    layered = bool(material.layers)
    mesh = content_key(replace(test.experiment, protocol=_ANY_MOTION), test.solver)
    one_way = all(set(curve.segment.tolist()) == {"ramp"} for curve in curves if curve.segment is not None)
    timed = settings.whole and all(curve.time is not None for curve in curves)
    if timed or material.ages or (remembers(test, material) and not one_way):
        motions: list[Timed] = []
        motion_of = []
        for curve in curves:
            motion = Timed.of(curve.clock, curve.displacement)
            same = [i for i, other in enumerate(motions) if other.like(motion)]
            if not same:
                motions.append(motion)
            motion_of.append(same[0] if same else len(motions) - 1)
        return SimulatedTest(test.name, test.experiment, test.rig, tuple(motions), tuple(motion_of), curves, layered,
                             mesh=mesh, solver=test.solver)
    deepest = max(curve.displacement.max() for curve in curves)
    height = test.experiment.specimen.height
    depth = min(deepest + max(_MARGIN * contact, _LEAST_MARGIN * deepest), 0.999 * test.experiment.thickness)
    speed = float(np.median([curve.speed or STUDY_SPEED for curve in curves]))
    tool = test.experiment.tool
    smooth = tool.is_plate or (tool.sharp_edge and not test.experiment.is_path_dependent)
    way = Loading.to(float(depth), max(speed, 1e-9), smooth=smooth, strain=float(depth / height))
    return SimulatedTest(test.name, test.experiment, test.rig, (way,), (0,) * len(curves), curves, layered, mesh=mesh,
                         solver=test.solver)


def closed_test(test: Test, curves: Sequence[MeasuredCurve]) -> ClosedTest:
    """A homogeneous test; a cube of 1 m where the recordings are stretch and stress."""
    size = (1.0, 1.0) if test.specimen is None else (test.specimen.height, test.specimen.area)
    return ClosedTest(test.name, test.kind, *size, tuple(curves))


def analytical_test(test: Test, curves: Sequence[MeasuredCurve], settings: FitSettings) -> ClosedTest:
    """The closed form of a test, that of a column where the specimen weighs."""
    plain = closed_test(test, curves)
    if test.specimen is not None and test.specimen.specific_weight:
        reserve = settings.offset_bound if settings.offset == "fit" else 0.0
        return ColumnTest(plain.name, plain.kind, plain.height, plain.area, plain.measured, specimen=test.specimen,
                          reserve=reserve)
    return replace(plain, largest_step=FITTED_STEP)


def remainder(test: ForwardTest, of: Mapping[str, float]) -> float:
    """Relative standard deviation of what a mesh is off in this test; 0 where every mesh is exact."""
    if test.homogeneous or not isinstance(test, SimulatedTest):
        return 0.0
    shape, error = test.experiment.tool.shape, test.mesh_error
    known = meshes_of(test.solver).remainder * of[shape if shape in of else "other"]
    if test.specimen.from_file:
        largest = max(float(np.abs(curve.force).max()) for curve in test.measured)
        added = max((float(np.abs(each).max(initial=0.0)) for each in test.correction), default=np.inf)
        return max(known, min(LEFT_OF_ORDER * added / largest, COARSEST_REMAINDER))
    if of is REMAINDERS and error is not None and shape in FINEST_REMAINDERS:
        return min(known, max(FINEST_REMAINDERS[shape], LEFT_OF_DIFFERENCE * error.largest))
    return known
