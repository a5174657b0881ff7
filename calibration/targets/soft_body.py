"""Soft bodies of physics engines: linear tetrahedra that are stepped in time until they are at rest."""

from __future__ import annotations

import importlib
import importlib.util
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from calibration.targets.runner import Progress, TargetCurve, TargetRunner, TargetTest
from tissue_sim.errors import InputError
from tissue_sim.experiment.tools.tool import Tool
from tissue_sim.exports.elastic_constants import ElasticConstants
from tissue_sim.material.material import Material

#: Function that returns the first Piola-Kirchhoff stress, Pa, of deformation gradients, both of shape (n, 3, 3).
StressFunction = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class RestSettings:
    """Criteria for rest, and motion of the tool between the positions of a quasi-static test.

    Attributes:
        speed: largest speed of a node at rest, m/s.
        force_change: largest change of the force on the base within `window` at rest, as a fraction of the force, 1.
        window: number of time steps over which the change of the force is measured; more than two damping times.
        imbalance: largest difference of the forces on tool and base at rest, as a fraction of the force on the base, 1.
        force_resolution: difference of these forces that is always accepted, N.
        tool_speed: speed of the tool between two positions, m/s.
        max_steps: largest number of time steps at a position.
        interval: number of time steps between two checks for rest.
    """

    speed: float = 1e-5
    force_change: float = 1e-3
    window: int = 20
    imbalance: float = 1e-3
    force_resolution: float = 1e-5
    tool_speed: float = 0.1
    max_steps: int = 400
    interval: int = 1


def compute_nodal_forces(nodes: np.ndarray, tetrahedra: np.ndarray, positions: np.ndarray, stress: StressFunction
                         ) -> np.ndarray:
    """Return the internal forces of linear tetrahedra, N, shape (nodes, 3).

    For an elastic stress the forces are the derivative of the energy with respect to the positions.

    Args:
        nodes: undeformed positions, m, shape (nodes, 3).
        tetrahedra: indices of nodes, shape (n, 4).
        positions: deformed positions, m, shape (nodes, 3).
        stress: stress of the material.
    """
    rest = _compute_edge_matrices(nodes, tetrahedra)
    inverse = np.linalg.inv(rest)
    stresses = stress(_compute_edge_matrices(positions, tetrahedra) @ inverse)
    corner_forces = (np.linalg.det(rest) / 6.0)[:, None, None] * stresses @ np.swapaxes(inverse, 1, 2)
    forces = np.zeros_like(positions)
    for corner in range(3):
        np.add.at(forces, tetrahedra[:, corner + 1], corner_forces[:, :, corner])
    np.add.at(forces, tetrahedra[:, 0], -corner_forces.sum(axis=2))
    return forces


def compute_deformation_gradients(nodes: np.ndarray, tetrahedra: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return the deformation gradients of linear tetrahedra, shape (n, 3, 3); arguments of `compute_nodal_forces`."""
    return _compute_edge_matrices(positions, tetrahedra) @ np.linalg.inv(_compute_edge_matrices(nodes, tetrahedra))


def _compute_edge_matrices(points: np.ndarray, tetrahedra: np.ndarray) -> np.ndarray:
    """Return the matrices whose columns are the edges from the first corner, m, shape (n, 3, 3)."""
    return np.swapaxes(points[tetrahedra[:, 1:]] - points[tetrahedra[:, :1]], 1, 2)


def compute_penetration(tool: Tool, position: np.ndarray, points: np.ndarray) -> float:
    """Return the largest depth of points inside an upright tool, m; 0 if all points are outside.

    Args:
        tool: rigid tool.
        position: position of its deepest point, m, shape (3,).
        points: positions, m, shape (n, 3).
    """
    offsets = points - position
    gaps = tool.profile.gap(np.column_stack([np.hypot(offsets[:, 0], offsets[:, 1]), offsets[:, 2]]))
    return max(0.0, -float(gaps.min()))


def require_sphere_or_cylinder(tool: Tool, title: str) -> None:
    """Raise an error for tools in contact that are no sphere and no flat punch with a sharp edge.

    Raises:
        InputError: another shape.
    """
    if tool.name not in ("sphere", "flat") or tool.edge_radius:
        shape = f"{tool.name} with a rounded edge" if tool.name == "flat" else tool.name
        raise InputError(f"must be a sphere, or a flat punch with a sharp edge, in contact in {title}; got {shape}. "
                         "Use one of these tools, or a bonded face.", field="tool")


class SteppedSoftBody(ABC):
    """Soft body and tool of an engine, stepped in time.

    Attributes:
        time_step: s.
        surface: indices of the nodes that the tool can touch.
    """

    time_step: float
    surface: np.ndarray

    @abstractmethod
    def advance(self, tool_position: np.ndarray) -> None:
        """Make one time step that ends with the deepest point of the tool at a position, m, shape (3,)."""

    @abstractmethod
    def get_positions(self) -> np.ndarray:
        """Return the positions of the nodes, m, shape (nodes, 3)."""

    @abstractmethod
    def compute_largest_speed(self) -> float:
        """Return the largest speed of a free node, m/s."""

    @abstractmethod
    def compute_forces_on_tool_and_base(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the force on the tool, and the force on the tool that balances the base, N, shape (3,) each.

        Both agree at rest.
        """

    def describe_failure(self) -> str:
        """Return why the state is not usable; an empty text if it is."""
        return "" if np.isfinite(self.get_positions()).all() else "the positions are not finite"


def run_steps_along_path(body: SteppedSoftBody, test: TargetTest, rest: RestSettings, version: str,
                         progress: Progress | None = None) -> TargetCurve:
    """Move the tool along the path of a test, and return the forces up to the last position that is reached.

    Without `TargetTest.times` the tool waits at each position until the body is at rest: all nodes are slow, and the
    forces on tool and base agree and are steady. With times the tool moves at constant velocity between the positions.

    At the first position, which does not load the body, the force is zero.

    Args:
        body: body in its undeformed state.
        test: path, times and longest wall time of a position.
        rest: criteria for rest.
        version: name and version of the engine.
        progress: receives finished and all positions.
    """
    count, before, ended = len(test.positions), test.positions[0], ""
    forces, steps, penetrations, seconds = [np.zeros(3)], [0], [0.0], []
    for number in range(1, count):
        position, began = test.positions[number], time.process_time()
        made, ended = _step_to_position(body, test, rest, number, before)
        if not ended and _has_inverted_element(body, test):
            ended = "an element is inverted"
        if ended:
            ended = f"at {1e3 * math.dist(position, test.positions[0]):g} mm: {ended}"
            break
        steps.append(made)
        seconds.append((time.process_time() - began) / made)
        forces.append(body.compute_forces_on_tool_and_base()[0])
        penetrations.append(compute_penetration(test.tool, position, body.get_positions()[body.surface]))
        before = position
        if progress:
            progress(number + 1, count)
    reached = len(forces)
    curve = TargetCurve(test.positions[:reached], np.array(forces).reshape(-1, 3), ended,
                        steps=np.array(steps, dtype=int), version=version)
    if seconds:
        curve = replace(curve, step_seconds=float(np.median(seconds)))
    return curve if test.is_bonded else replace(curve, penetrations=np.array(penetrations))


def _step_to_position(body: SteppedSoftBody, test: TargetTest, rest: RestSettings, number: int, before: np.ndarray
                      ) -> tuple[int, str]:
    """Move the tool to a position; return the number of time steps, and the reason of a failure or an empty text."""
    position, began = test.positions[number], time.perf_counter()
    if test.times is None:
        moving = math.ceil(math.dist(position, before) / (rest.tool_speed * body.time_step) - 1e-9)
    else:
        moving = round((test.times[number] - test.times[number - 1]) / body.time_step)
    made, on_base, moving = 0, list[np.ndarray](), max(moving, 1)
    while True:
        made += 1
        body.advance(before + (position - before) * min(1.0, made / moving))
        if failure := body.describe_failure():
            return made, failure
        if made >= moving and test.times is not None:
            return made, ""
        if made >= moving and made % rest.interval == 0:
            on_tool, latest = body.compute_forces_on_tool_and_base()
            on_base.append(latest)
            if _are_forces_at_rest(on_tool, on_base, rest) and body.compute_largest_speed() < rest.speed:
                return made, ""
        if made - moving >= rest.max_steps or time.perf_counter() - began > test.max_seconds:
            return made, (f"not at rest after {made} time steps in {time.perf_counter() - began:.0f} s, "
                          f"{body.compute_largest_speed():.2g} m/s")


def _has_inverted_element(body: SteppedSoftBody, test: TargetTest) -> bool:
    """Return whether the volume of an element is zero or negative."""
    edges = _compute_edge_matrices(body.get_positions(), test.tetrahedral_mesh.cells)
    return bool((np.linalg.det(edges) <= 0.0).any())


def _are_forces_at_rest(on_tool: np.ndarray, on_base: Sequence[np.ndarray], rest: RestSettings) -> bool:
    """Return whether the forces on tool and base agree, and whether that on the base has been steady for the window."""
    earlier = len(on_base) - 1 - math.ceil(rest.window / rest.interval)
    if earlier < 0:
        return False
    size = float(np.linalg.norm(on_base[-1]))
    return (math.dist(on_tool, on_base[-1]) <= max(rest.imbalance * size, rest.force_resolution)
            and math.dist(on_base[earlier], on_base[-1]) <= max(rest.force_change * size, rest.force_resolution))


def require_constants(material: Material | ElasticConstants, title: str) -> ElasticConstants:
    """Return the argument if it is `ElasticConstants`.

    Raises:
        InputError: a material with a law, which the engine does not have.
    """
    if not isinstance(material, ElasticConstants):
        raise InputError(f"must be ElasticConstants for {title}; got a material with the law {material.law!r}. Use "
                         "linearise_material or match_constants.", field="material")
    return material


def with_minimum_damping(constants: ElasticConstants, damping_time: float) -> ElasticConstants:
    """Return constants whose damping time is at least a numerical one, s, with which a body comes to rest."""
    return replace(constants, damping_time=max(constants.damping_time, damping_time))


class SoftBodyRunner(TargetRunner):
    """Runner of a physics engine whose soft bodies are stepped in time.

    Attributes:
        program: name of the engine for people.
        package: name of its Python package and of the extra that installs it.
        damping_time: numerical damping of quasi-static tests, s.
        bonded_rest: criteria for rest of a body with a bonded face.
        contact_rest: criteria for rest of a body in contact.
    """

    program: ClassVar[str]
    package: ClassVar[str]
    damping_time: ClassVar[float]
    bonded_rest: ClassVar[RestSettings]
    contact_rest: ClassVar[RestSettings]

    @abstractmethod
    def make_body(self, test: TargetTest, constants: ElasticConstants) -> SteppedSoftBody:
        """Make the body and the tool of a test, in the undeformed state."""

    def prepare_test(self, test: TargetTest) -> TargetTest:
        """Return the test as the engine runs it; by default unchanged."""
        return test

    def describe_missing_program(self) -> str:
        """Return why the engine cannot run here; see `TargetRunner`."""
        if importlib.util.find_spec(self.package) is None:
            return f"{self.program} is not installed. Run: pip install 'tissue_sim[{self.package}]'"
        return ""

    def run(self, test: TargetTest, material: Material | ElasticConstants, progress: Progress | None = None
            ) -> TargetCurve:
        """Simulate a test; see `TargetRunner`."""
        if missing := self.describe_missing_program():
            raise InputError(missing, field="--in-target")
        constants = require_constants(material, self.title)
        if not test.is_bonded:
            require_sphere_or_cylinder(test.tool, self.title)
        test = self.prepare_test(test)
        if test.times is None:
            constants = with_minimum_damping(constants, self.damping_time)
        body = self.make_body(test, constants)
        version = f"{self.program} {importlib.import_module(self.package).__version__}"
        return run_steps_along_path(body, test, self.bonded_rest if test.is_bonded else self.contact_rest, version,
                                    progress)
