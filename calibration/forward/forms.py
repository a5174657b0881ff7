"""Construction of the forward model of a test (closed form or finite elements), and check of its geometry."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration.campaign.campaign import Campaign, FitSettings, Test
from calibration.campaign.measured import MeasuredCurve, is_test_force_history_dependent
from calibration.campaign.tables import ROUND_SOLVER
from calibration.forward.closed import ClosedFormTest, ColumnTest
from calibration.forward.contract import ForwardTest
from calibration.forward.meshes import ACCURATE_MESH_ERRORS, FINEST_MESH_ERRORS, MESH_ERROR, get_solver_fit_resolutions
from calibration.forward.modulus import ModulusTest
from calibration.forward.motion import MonotonicLoading, TimedMotion
from calibration.forward.simulated import SimulatedTest
from calibration.forward.simulation_cache import hash_content_and_source_code
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.experiment.protocol import STUDY_SPEED, Protocol
from tissue_sim.fem.solver import SOLVERS
from tissue_sim.model import Model


def check_solvers_accept_test_geometries(campaign: Campaign) -> None:
    """Build the solver of each three-dimensional test once, with the first material of the campaign.

    Raises:
        InputError: the mesh or the contact cannot be built; with file and field.
    """
    for number, test in enumerate(campaign.tests):
        if test.experiment is None or test.solver == ROUND_SOLVER:
            continue
        try:
            SOLVERS.find(test.solver, "solver")(Model(test.experiment, campaign.fit.placeholder_material_with_effects),
                                                resolution=get_solver_fit_resolutions(test.solver).fast)
        except InputError as error:
            raise InputError(error.problem, file=campaign.path, field=f"test[{number}]") from None
        except ConvergenceError:
            continue  # the specimen may be in equilibrium under its weight with another material


#: Largest strain step of histories in an analytical fit, coarser than in a prediction. Its error of 1e-4 of the largest
#: stress is below measurement errors.
FITTED_STEP = 0.01
#: Motion in the key of a mesh, which does not depend on the motion of the test.
_ANY_MOTION = Protocol(np.array([0.0, 1.0]), np.array([0.0, 1e-9]))


@dataclass(frozen=True)
class DepthMarginSettings:
    """Depth that is simulated beyond the deepest sample, so that a fitted contact offset needs no extrapolation.

    Attributes:
        offset_deviations: margin in standard deviations of the contact offset.
        min_fraction: smallest margin as a fraction of the largest displacement.
    """

    offset_deviations: float = 4.0
    min_fraction: float = 1e-3


_MARGINS = DepthMarginSettings()


def build_forward_test_of_inverse_fit(test: Test, curves: Sequence[MeasuredCurve], settings: FitSettings,
                                      contact: float) -> SimulatedTest | ClosedFormTest | ModulusTest:
    """Return the forward model of a test in an inverse (finite element) fit; a closed form for stress and moduli.

    Args:
        test: test of the campaign.
        curves: recordings of the test.
        settings: settings of the fit.
        contact: standard deviation of the contact offset, m.
    """
    material = settings.placeholder_material_with_effects
    curves = tuple(curves)
    if test.modulus:
        return ModulusTest(test.name, test.kind, test.modulus, test.modulus_abscissa, curves)
    if test.experiment is None or curves[0].stressed:
        return build_weightless_closed_form_test(test, curves)
    layered = bool(material.layers)
    mesh_key = hash_content_and_source_code(replace(test.experiment, protocol=_ANY_MOTION), test.solver)
    ramps_only = all(set(curve.segment.tolist()) == {"ramp"} for curve in curves if curve.segment is not None)
    timed = settings.whole and all(curve.time is not None for curve in curves)
    if timed or material.is_time_dependent or (is_test_force_history_dependent(test, material) and not ramps_only):
        motions: list[TimedMotion] = []
        motion_of = []
        for curve in curves:
            motion = TimedMotion.from_recording(curve.sample_times, curve.displacement,
                                                force=None if curve.force_control is None else curve.force)
            same = [i for i, other in enumerate(motions) if other.has_equal_knots_within_tolerance(motion)]
            if not same:
                motions.append(motion)
            motion_of.append(same[0] if same else len(motions) - 1)
        return SimulatedTest(test.name, test.experiment, test.rig, tuple(motions), tuple(motion_of), curves, layered,
                             mesh_key=mesh_key, solver=test.solver)
    deepest = max(curve.displacement.max() for curve in curves)
    height = test.experiment.specimen.height
    margin = max(_MARGINS.offset_deviations * contact, _MARGINS.min_fraction * deepest)
    depth = min(deepest + margin, 0.999 * test.experiment.thickness)
    speed = float(np.median([curve.mean_loading_speed or STUDY_SPEED for curve in curves]))
    tool = test.experiment.tool
    smooth = tool.is_plate or (tool.has_sharp_edge and not test.experiment.is_path_dependent)
    ramp = MonotonicLoading.make_loading_to_depth(float(depth), max(speed, 1e-9), smooth=smooth,
                                                  strain=float(depth / height))
    return SimulatedTest(test.name, test.experiment, test.rig, (ramp,), (0,) * len(curves), curves, layered,
                         mesh_key=mesh_key,
                         solver=test.solver)


def build_weightless_closed_form_test(test: Test, curves: Sequence[MeasuredCurve]) -> ClosedFormTest:
    """Return the closed form of a homogeneous test; self-weight of the specimen is ignored.

    Recordings of stretch and stress belong to a cube of 1 m, for which force equals stress and displacement equals
    strain.
    """
    return ClosedFormTest(test.name, test.kind, test.reference_height, test.reference_area, tuple(curves))


def build_closed_form_or_column_test(test: Test, curves: Sequence[MeasuredCurve],
                                     settings: FitSettings) -> ClosedFormTest:
    """Return the closed form of a test in an analytical fit; a `ColumnTest` if the specimen has self-weight."""
    plain = build_weightless_closed_form_test(test, curves)
    if test.specimen is not None and test.specimen.specific_weight:
        reserve = settings.offset_bound if settings.offset == "fit" else 0.0
        return ColumnTest(plain.name, plain.kind, plain.height, plain.area, plain.measured, specimen=test.specimen,
                          reserve=reserve)
    return replace(plain, largest_step=FITTED_STEP)


def compute_mesh_uncertainty(test: ForwardTest, errors: Mapping[str, float]) -> float:
    """Return the relative standard deviation of the force due to the mesh error; 0 if every mesh is exact.

    Args:
        test: forward model, after `ForwardTest.update_mesh_force_difference_and_get_ratio` if `errors` are those of the
            accurate mesh.
        errors: `ACCURATE_MESH_ERRORS` or `FAST_MESH_ERRORS`.
    """
    if test.is_homogeneous or not isinstance(test, SimulatedTest):
        return 0.0
    shape, error = test.experiment.tool.shape, test.mesh_error
    known = get_solver_fit_resolutions(test.solver).error_factor * errors[shape if shape in errors else "other"]
    if test.specimen.from_file:
        largest = max(float(np.abs(curve.force).max()) for curve in test.measured)
        added = max((float(np.abs(each).max(initial=0.0)) for each in test.correction), default=np.inf)
        return max(known, min(MESH_ERROR.file_fraction * added / largest, MESH_ERROR.max_file_error))
    if errors is ACCURATE_MESH_ERRORS and error is not None and shape in FINEST_MESH_ERRORS:
        return min(known, max(FINEST_MESH_ERRORS[shape], MESH_ERROR.finest_fraction * error.largest_error))
    return known
