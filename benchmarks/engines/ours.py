"""Four forms of this package as engines of the benchmark: axisymmetric, solid, multirate and reduced solid."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

import tissue_sim as ts
from benchmarks.engines.jobs import HEIGHT, RADIUS
from calibration.targets.runner import Progress, TargetCurve, TargetRunner, TargetTest
from haptics.loop.multirate import MultiRateTissue
from tissue_sim.exports.elastic_constants import ElasticConstants
from tissue_sim.material.material import Material

#: Simulated speed of the tool in quasi-static jobs, m/s; without inertia it has no influence on the force.
QUASI_STATIC_SPEED = 0.05
#: Model and box -> reduced solid, whose training takes minutes.
_REDUCED: dict[str, ts.ReducedModel] = {}
#: Range of a reduced solid over that of the test, 1.
MARGIN = 1.1
#: Largest number of further steps at a pose that the tissue has not reached; their time counts.
MAX_REPEATS = 20


def make_model_of_test(test: TargetTest, material: Material) -> ts.Model:
    """Make experiment and material of a test on the cylinder of the benchmark."""
    offset = float(test.positions[0, 0])
    return ts.Model(ts.Experiment(ts.Specimen(RADIUS, HEIGHT), ts.Protocol.ramp(-float(test.positions[:, 2].min()), 2),
                                  tool=test.tool, friction="bonded" if test.is_bonded else test.friction,
                                  approach=ts.Approach(offset) if offset else None), material)


class TissueRunner(TargetRunner):
    """Real-time simulation of this package as an engine.

    Args:
        title: name of the form.
        make_tissue: returns the tissue of a model and a test, without `warm_up`.
        is_on_axis: whether the form has no lateral motion.
        uses_mesh_of_test: whether the form runs on the mesh of the test; otherwise it makes its own.
    """

    uses_elastic_constants = False

    def __init__(self, title: str, make_tissue: Callable[[ts.Model, TargetTest], Any], *, is_on_axis: bool = False,
                 uses_mesh_of_test: bool = True):
        self.title = title  # type: ignore[misc]
        self.uses_mesh_of_test = uses_mesh_of_test
        self._make_tissue, self._is_on_axis = make_tissue, is_on_axis

    def describe_missing_program(self) -> str:
        """Return an empty text: this package is always there."""
        return ""

    def run(self, test: TargetTest, material: Material | ElasticConstants, progress: Progress | None = None
            ) -> TargetCurve:
        """Step the tissue through the positions; a quasi-static test without inertia, otherwise in steps of time."""
        assert isinstance(material, Material), "this package has its own laws"
        if self._is_on_axis and np.ptp(test.positions[:, :2]) + np.abs(test.positions[:, :2]).max() > 0.0:
            return TargetCurve(np.zeros((0, 3)), np.zeros((0, 3)), ended="the axisymmetric form has no lateral motion")
        tissue = self._make_tissue(make_model_of_test(test, material), test)
        try:
            tissue.warm_up()
            return _step_through_positions(tissue, test, progress)
        finally:
            if hasattr(tissue, "close"):
                tissue.close()


def _step_through_positions(tissue: Any, test: TargetTest, progress: Progress | None) -> TargetCurve:
    """Return the forces at the positions up to the first without a converged force."""
    forces, steps, spent, ended, previous, flagged = [], [], [], "", None, 0
    for number, position in enumerate(test.positions):
        start = position if previous is None else previous
        interval = _get_interval(test, number, float(np.linalg.norm(position - start)))
        count = max(1, math.ceil(interval / test.time_step - 1e-9)) if test.time_step else 1
        for part in range(1, count + 1):
            pose = ts.Pose(tuple((start + (position - start) * part / count).tolist()))
            began = time.process_time()
            answer = tissue.step(pose, interval / count)
            for _ in range(MAX_REPEATS):
                if not is_late(answer):
                    break
                answer = tissue.step(pose, 0.0)
            spent.append(time.process_time() - began)
        if is_late(answer) or answer.status in (ts.ForceStatus.STOPPED, ts.ForceStatus.REFUSED):
            ended = f"{answer.status.name} at {1e3 * -position[2]:g} mm"
            break
        forces.append(answer.wrench[:3])
        flagged += answer.status is not ts.ForceStatus.CONVERGED
        steps.append(count)
        previous = position
        if progress is not None:
            progress(number + 1, len(test.positions))
    return TargetCurve(test.positions[:len(forces)], np.array(forces).reshape(-1, 3), ended,
                       float(np.median(spent)) if spent else math.nan, np.array(steps, dtype=int),
                       version=f"tissue_sim {ts.__version__}", flagged=flagged)


def is_late(answer: ts.ToolForce) -> bool:
    """Whether the force belongs to an earlier pose; LATE without age is an equilibrium with a large known error."""
    return answer.status is ts.ForceStatus.LATE and answer.age > 0.0


def _get_interval(test: TargetTest, number: int, distance: float) -> float:
    """Return the time between a position and the previous one, s."""
    if test.times is None:
        return distance / QUASI_STATIC_SPEED
    return float(test.times[number] - test.times[max(number - 1, 0)])


def _choose_inertia(test: TargetTest) -> str:
    return "off" if test.times is None else "auto"


def _make_reduced(model: ts.Model, test: TargetTest) -> ts.Simulator:
    """Reduce the solid of a model for the range of the test, with its own mesh."""
    reach = np.abs(test.positions - test.positions[0])
    depth, sideways = -float(test.positions[:, 2].min()), float(reach[:, :2].max())
    box = ts.PoseBox(sideways=MARGIN * sideways, depth=MARGIN * depth)
    key = f"{model!r} {box!r}"
    if key not in _REDUCED:
        _REDUCED[key] = ts.reduce_solid(model, box)
    return ts.Simulator(_REDUCED[key].model, solver="reduced", mesh=_REDUCED[key])


#: Name -> form of this package.
OURS = {
    "axisymmetric": TissueRunner("tissue_sim, axisymmetric, accurate", lambda model, test: ts.Simulator(
        model, resolution="accurate", inertia=_choose_inertia(test)), is_on_axis=True,
        uses_mesh_of_test=False),
    "solid": TissueRunner("tissue_sim, solid", lambda model, test: ts.Simulator(
        model, solver="solid", mesh=test.mesh, inertia=_choose_inertia(test))),
    "multirate": TissueRunner("tissue_sim, multirate solid", lambda model, test: MultiRateTissue(
        model, mesh=test.mesh, waits=True)),
    "reduced": TissueRunner("tissue_sim, reduced solid", _make_reduced, uses_mesh_of_test=False),
}
