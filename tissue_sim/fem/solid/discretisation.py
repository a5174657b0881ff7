"""Discretisation of an experiment in three dimensions: mesh, boundary conditions, solver and self-weight."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from tissue_sim.errors import ConvergenceError, InputError, make_hint_with_similar_or_known_words
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.fem.contact.laws import NodalContactLaws
from tissue_sim.fem.contact.pairs import TOLERANCES, ContactPair, ContactPairs, SurfaceParts, build_contact_pairs
from tissue_sim.fem.solid.sensitivity import FirstTouchDerivatives
from tissue_sim.fem.solid.solver import SETTLING, SolidSolver
from tissue_sim.fem.solid.tissue import find_element_layer_indices
from tissue_sim.fem.solid.touch import PLACEMENT, FirstTouch, FirstTouchHeightAndSolverMaker, find_first_touch
from tissue_sim.fem.solver import ExperimentDerivatives, Neighbours, Step, StepStatus
from tissue_sim.fem.stepping import solve_self_weight_equilibrium
from tissue_sim.material.material import Layer
from tissue_sim.mesh.mesh_mapping import Circle
from tissue_sim.mesh.solid import O_GRID, Grading, SolidMesh
from tissue_sim.mesh.solid_element import HEX8P0, HEX27P1, Hexahedron
from tissue_sim.model import Model
from tissue_sim.pose import Pose, shift_pose_along_z
from tissue_sim.specimen import Specimen
from tissue_sim.specimen.cylinder import Cylinder
from tissue_sim.specimen.specimen import add_indefinite_article


class SettledStateDerivatives(NamedTuple):
    """Derivatives of a settled specimen with respect to m parameters.

    The attributes are those of `FirstTouchDerivatives` with the same names.
    """

    stretch: np.ndarray
    settled: list[np.ndarray]
    resting: np.ndarray


class SolidSelfWeightProblem:
    """Self-weight of a solid, and the load steps that led to equilibrium; see `SelfWeightProblem`.

    Args:
        stand: makes the solver of a mesh without tool and weight.
        mesh: mesh with the stated height of the specimen.
        specimen: specimen with its weight; `height_is` states whether its height is that before settling.

    Attributes:
        mesh: undeformed mesh of the last solver.
        steps: specific weight of each converged load step of the last solver, N/m3, and its equilibrium: displacements,
            m, pressures, Pa, contact forces, N.
    """

    smallest_increment = SETTLING.smallest_part

    def __init__(self, stand: Callable[[SolidMesh], SolidSolver], mesh: SolidMesh, specimen: Specimen):
        self._stand, self._stated_mesh, self._specimen = stand, mesh, specimen
        self.mesh = mesh
        self.steps: list[tuple[float, tuple[np.ndarray, ...]]] = []

    def make_solver(self, stretch: float) -> SolidSolver:
        """See `SelfWeightProblem.make_solver`."""
        solver = self._stand(self._stated_mesh.scale_height(stretch))
        self.mesh, self.steps = solver.mesh, []
        return solver

    def solve_equilibrium_under_weight(self, solver: SolidSolver, specific_weight: float) -> Step:
        """See `SelfWeightProblem.solve_equilibrium_under_weight`. A converged step is recorded."""
        solver.tissue.specific_weight = specific_weight
        step = solver.step(solver.pose, np.inf)
        if step.status is StepStatus.CONVERGED:
            self.steps.append((specific_weight, solver.equations.copy_iterate()))
        return step

    def store_resting_state(self, solver: SolidSolver) -> None:
        """See `SelfWeightProblem.store_resting_state`."""
        solver.equations.make_committed_state_the_resting_state()

    def differentiate_state_settled_by_weight_or_none(
            self, neighbours: Neighbours,
            experiments: Sequence[ExperimentDerivatives] | None) -> SettledStateDerivatives | None:
        """Repeat the load steps from their stored equilibria, and differentiate the last one.

        Args:
            neighbours: see `tissue_sim.fem.solver.Neighbours`.
            experiments: derivatives of the inputs from the experiment; None: zero.

        Returns:
            Derivatives; None if the solver has none or a step does not converge.
        """
        solver, m = self._stand(self.mesh), len(neighbours)
        # An undeformed height that was determined from the settled one is an additional parameter.
        height = (solver.material, solver.material, SETTLING.height_width)
        more = [height] if self._specimen.height_is == "placed" else []
        if experiments is not None:
            experiments = [*experiments, *(ExperimentDerivatives() for _ in more)]
        derivatives = solver.enable_force_derivatives([*neighbours, *more], experiments)
        if derivatives is None:
            return None
        stretches = np.repeat([0.0, 1.0], [m, len(more)])
        derivatives.set_first_touch_derivatives(FirstTouchDerivatives.from_undeformed_specimen(stretches))
        for weight, state in self.steps:
            solver.tissue.specific_weight = weight
            solver.contact.copy_committed_bonds_to_step()
            solver.equations.set_iterate(state)
            if solver.step(solver.pose, np.inf, resumes=True).status is not StepStatus.CONVERGED:
                return None
        carried, stretch = derivatives.state_derivatives, np.zeros(m)
        if more:
            rises = np.average(carried[0][:, 2::3], axis=1, weights=self.mesh.compute_node_areas_of_named_faces("top"))
            stretch = -rises[:m] / (rises[m] + float(np.ptp(self.mesh.nodes[:, 2])))
        settled = [each[:m] + np.multiply.outer(stretch, each[m]) if more else each for each in carried]
        return SettledStateDerivatives(stretch, settled, solver.contact.nodes)


def solve_solid_self_weight_equilibrium(stand: Callable[[SolidMesh], SolidSolver], mesh: SolidMesh, specimen: Specimen
                                        ) -> tuple[SolidSolver, SolidSelfWeightProblem]:
    """Compute the equilibrium of a solid under its weight, without a tool (`tissue_sim.fem.stepping`).

    Args:
        stand: makes the solver of a mesh without tool and weight.
        mesh: mesh with the stated height of the specimen.
        specimen: specimen with its weight.

    Returns:
        Solver in equilibrium under the weight, and its load steps.

    Raises:
        ConvergenceError: the specimen has no equilibrium under its weight.
    """
    problem = SolidSelfWeightProblem(stand, mesh, specimen)
    return solve_self_weight_equilibrium(problem, specimen, float(np.ptp(mesh.nodes[:, 2]))), problem


#: Lower bound of the largest element far from a needle, over the size of the specimen, 1.
_LEAST_LARGEST = 0.17


class SolidForceErrors(NamedTuple):
    """Largest known relative errors of the force, 1, under upright tools on thick cylinders of one material.

    They are compared with the accurate axisymmetric mesh for the specimen of the study from 2 to 10 mm, under tips from
    2 to 6 mm (`benchmarks/realtime/resolution_levels.py`).

    Attributes:
        plate: under a plate.
        held: under a flat face that holds the tissue by bonding, stick or a friction coefficient of at least
            `MEASURED_FRICTION`, or under a sharp face without friction.
        tip: under a tool without a flat face.
        slipping_edge: under other flat faces, whose rounded edge slips along the tissue.
    """

    plate: float
    held: float
    tip: float
    slipping_edge: float


#: Smallest friction coefficient for which `SolidForceErrors.held` is measured, 1.
MEASURED_FRICTION = 0.3
#: Smallest height of the specimen, and smallest distance of its rim from the tool's axis, over the radius of the tool
#: for which `SolidForceErrors` are valid, 1. The specimen of the study has 8.75 and 5 radii.
MEASURED_THICKNESS = 4.0
#: Smallest height over radius of a specimen between plates for which they are valid, 1. The specimen of the study has
#: 1.75.
LEAST_SLENDERNESS = 1.0
#: Largest height over radius of a specimen between plates for which they are valid, 1.
LARGEST_SLENDERNESS = 3.0


class Resolution(NamedTuple):
    """Element type and element sizes that belong to the name of a resolution, see `RESOLUTIONS`.

    Attributes:
        element: element type.
        smallest: size of the elements at the edge of the tool's face, over the radius of the face, 1.
        growth, largest: ratio of successive sizes away from the edge; largest size over the radius of the face, 1.
        around: number of elements along a quarter of the circumference of the face.
        layer_elements: smallest number of elements through a layer of the material.
        force_errors: largest known errors of the force; None: not measured.
    """

    element: Hexahedron
    smallest: float
    growth: float
    largest: float
    around: int
    layer_elements: int = 1
    force_errors: SolidForceErrors | None = None

    def get_force_error_or_none(self, experiment: Experiment) -> float | None:
        """Return the largest known relative error of the force of an experiment, 1; None if it is not known."""
        errors, tool, specimen, approach = self.force_errors, experiment.tool, experiment.specimen, experiment.approach
        if errors is None or not isinstance(specimen, Cylinder) or experiment.grip is not None:
            return None
        if tool.is_plate:
            slenderness = specimen.height / specimen.radius
            return errors.plate if LEAST_SLENDERNESS <= slenderness <= LARGEST_SLENDERNESS else None
        offset, angle = (0.0, 0.0) if approach is None else (approach.offset, approach.angle)
        to_rim = specimen.radius - abs(offset)
        if angle or min(specimen.height, to_rim) < MEASURED_THICKNESS * tool.require_radius():
            return None
        if not tool.face_radius:
            return errors.tip
        friction = 0.0 if experiment.friction == "frictionless" else experiment.friction
        slips = isinstance(friction, float) and friction < MEASURED_FRICTION
        return errors.slipping_edge if slips and tool.edge_radius else errors.held


#: Name -> resolution.
RESOLUTIONS = {
    "realtime": Resolution(HEX8P0, 0.2, 1.8, 1.9, 4, force_errors=SolidForceErrors(0.03, 0.08, 0.06, 0.12)),
    "fast": Resolution(HEX27P1, 0.25, 1.8, 1.9, 2),
    "accurate": Resolution(HEX27P1, 0.12, 1.6, 1.2, 4, layer_elements=2),
}
#: Interface of the base -> fixed axes.
_FIXED = {"bonded": "xyz", "frictionless": "z"}


def make_solver(model: Model, *, resolution: str = "fast", mesh: SolidMesh | None = None,
                topology: Model | None = None) -> SolidSolver:
    """Make the three-dimensional solver of a model; see `tissue_sim.fem.solver.SolverMaker`.

    Args:
        model: experiment and material.
        resolution: a key of `RESOLUTIONS`.
        mesh: mesh to use instead of the mesh of `resolution`.
        topology: model whose mesh (or `mesh`, which belongs to it) is moved to the geometry of `model`.
    """
    experiment = model.experiment
    _require_possible_interfaces(experiment)
    origin, own = topology or model, mesh is not None
    if mesh is None:
        mesh = build_mesh(origin.experiment, resolution, origin.material.layers)
    if topology is not None:
        mesh = _adapt_mesh_to_geometry(mesh, topology, experiment)
    solver = _make_solver_on_mesh(model, mesh, None, None, can_move=not own and experiment.specimen.is_flat)
    if not own and not model.material.layers:
        solver.stated_force_error = RESOLUTIONS[resolution].get_force_error_or_none(experiment)
    return solver


def _make_solver_on_mesh(model: Model, mesh: SolidMesh, start: Pose | None, datum: float | None, *,
                         can_move: bool) -> SolidSolver:
    """Make the solver of a model on its mesh.

    Args:
        model: experiment and material.
        mesh: undeformed mesh, made for the position of the first touch.
        start: pose of the first touch; None: that of the experiment's approach.
        datum: height of the scene's origin in the frame of the mesh, m; None: that of the first touch at `start`.
        can_move: whether the mesh can be moved to another position of the first touch.
    """
    experiment, undeformed = model.experiment, mesh
    layers, weight = find_element_layer_indices(mesh, model.material.layers), experiment.specimen.specific_weight
    settled = load = None
    if weight:
        settled, load = solve_solid_self_weight_equilibrium(
            lambda moulded: _make_solver_without_tool(model, moulded, layers), mesh, experiment.specimen)
        mesh = settled.mesh
    tool = experiment.tool
    bonded = mesh.sets["top" if tool.is_plate else "face"] if experiment.friction == "bonded" else np.zeros(0, int)
    placed, start = start is not None, start or experiment.tool_pose(0.0)
    contact = _build_contact_pairs(experiment, mesh, start)
    pairs = contact.pairs
    places = mesh.nodes if settled is None else mesh.nodes + settled.x.reshape(-1, 3)
    top = places[mesh.sets["top"]]
    if datum is None:
        first = find_first_touch(mesh, places, pairs, start)
        datum = first.height
    else:
        first = find_first_touch(mesh, places, pairs, shift_pose_along_z(start, -start.position[2]))
        start = shift_pose_along_z(start, first.height - datum - start.position[2])
    laws = NodalContactLaws(contact.laws, contact.face, _compute_law_areas(experiment, mesh))
    lift = _get_height_of_nearest_top_node(mesh, top[:, 2] - datum) if weight and tool.is_plate else None
    rates = partial(_differentiate_first_touch_or_none, load, experiment, first) if load and not placed else None
    solver = SolidSolver(mesh, model.material, _map_fixed_node_set_to_axes(experiment), bonded, pairs=pairs,
                         laws=laws, tolerance=contact.tolerance, largest_motion=contact.largest_depth, start=start,
                         datum=datum, contact_radius=experiment.contact_radius,
                         pins=_choose_rigid_motion_pins(experiment, mesh), element_layers=layers,
                         settled=None if settled is None else settled.equations, specific_weight=weight, lift=lift,
                         start_rates=rates)
    solver.placement = FirstTouchHeightAndSolverMaker(
        top, pairs, datum, is_level=experiment.specimen.is_flat and settled is None, margin=experiment.specimen.margin,
        touch_height=lambda pose: find_first_touch(mesh, places, pairs, pose).height,
        remake=partial(_make_solver_at_pose_or_none, model, undeformed, start, datum, can_move))
    return solver


def _make_solver_at_pose_or_none(model: Model, mesh: SolidMesh, start: Pose, datum: float, can_move: bool, pose: Pose,
                                 solver: SolidSolver) -> SolidSolver | None:
    """Make the solver of a first touch at another pose, with the mesh moved there.

    Args:
        model: experiment and material.
        mesh: undeformed mesh, made for a first touch at `start`.
        start: pose of the present first touch.
        datum: height of the scene's origin in the frame of the mesh, m.
        can_move: whether the mesh can be moved.
        pose: pose of the new first touch.
        solver: solver whose material, mass and requests are copied.

    Returns:
        The solver; None if the tool would reach beyond the specimen, or if the mesh would have to be moved but cannot:
        the edge of a flat tool must coincide with element edges.
    """
    experiment = model.experiment
    (x, y, _), (u, v, _) = pose.position, start.position
    tool, specimen = experiment.tool, experiment.specimen
    moves = math.hypot(x - u, y - v) > PLACEMENT.same_position * experiment.contact_radius
    radius = tool.face_radius or experiment.contact_radius
    if moves and (tool.is_plate or specimen.margin(x, y) <= radius):
        return None
    if moves and can_move:
        mesh = specimen.moved_mesh(mesh, specimen, (Circle(radius, (u, v)), Circle(radius, (x, y))))
    elif tool.face_radius and math.hypot(x - u, y - v) > PLACEMENT.face_offset * radius:
        return None
    try:
        other = _make_solver_on_mesh(model, mesh, pose, datum, can_move=can_move)
    except (InputError, ConvergenceError):
        return None
    solver.copy_material_and_requests_to(other)
    return other


def _get_height_of_nearest_top_node(mesh: SolidMesh, heights: np.ndarray) -> np.ndarray:
    """Return the height of the nearest node of the top above the plate, for all nodes, m, shape (nodes, ...).

    A plate touches an unevenly settled top at all nodes at once, as if the top had been cut flat in its settled state.

    Args:
        mesh: undeformed mesh.
        heights: of the nodes of the top above the plate, m, shape (n, ...).
    """
    from scipy.spatial import cKDTree

    _, nearest_top = cKDTree(mesh.nodes[mesh.sets["top"], :2]).query(mesh.nodes[:, :2])
    return heights[nearest_top]


def _differentiate_first_touch_or_none(
        settling: SolidSelfWeightProblem, experiment: Experiment, first: FirstTouch, neighbours: Neighbours,
        experiments: Sequence[ExperimentDerivatives] | None) -> FirstTouchDerivatives | None:
    """Differentiate the state of the first touch with respect to parameters; None if no derivatives are available."""
    mesh = settling.mesh
    specimen, over_sides = experiment.specimen, experiment.tool.is_plate or not experiment.specimen.is_flat
    if specimen.height_is == "placed" and experiment.acting_laws and over_sides:
        return None  # the areas for tractions would depend on the height as well
    if first.place is None:
        return None
    found = settling.differentiate_state_settled_by_weight_or_none(neighbours, experiments)
    if found is None:
        return None
    ways = found.settled[0].reshape(len(neighbours), -1, 3).copy()
    ways[:, :, 2] += np.multiply.outer(found.stretch, mesh.nodes[:, 2])
    datum = np.array([first.differentiate_height_by_mesh_parameter(mesh, way) for way in ways])
    top = ways[:, mesh.sets["top"], 2].T
    lift = _get_height_of_nearest_top_node(mesh, top - datum) if experiment.tool.is_plate else None
    return FirstTouchDerivatives(found.stretch, found.settled, found.resting, datum, lift)


def _map_fixed_node_set_to_axes(experiment: Experiment) -> dict[str, str]:
    """Return the fixed axes of base and side, node set -> axes; a lateral wall also prevents slip around the axis."""
    interface = experiment.resolved_base_interface
    base = {"base": _FIXED[interface]} if interface in _FIXED else {}
    return base | ({"side": "xy"} if experiment.has_lateral_wall else {})


def _make_solver_without_tool(model: Model, mesh: SolidMesh, layers: np.ndarray) -> SolidSolver:
    """Make the solver of the specimen on its base without tool and weight, to which the weight is applied."""
    experiment, pins = model.experiment, []
    if experiment.resolved_base_interface not in ("bonded", "stick"):
        # Three pins without reaction forces, because the weight has no component along the base.
        base = mesh.sets["base"]
        place = mesh.nodes[base, :2] - mesh.nodes[base, :2].mean(axis=0)
        middle = int(np.argmin(np.hypot(*place.T)))
        second = int(np.argmax(place[:, 0] - np.abs(place[:, 1] - place[middle, 1])))
        pins = [(int(base[middle]), "xy"), (int(base[second]), "y")]
    return SolidSolver(mesh, model.material, _map_fixed_node_set_to_axes(experiment), np.zeros(0, int),
                       pairs=_build_contact_pairs(experiment, mesh, None).pairs, start=experiment.tool_pose(0.0),
                       pins=pins, tolerance=TOLERANCES.plate * experiment.specimen.margin(),
                       contact_radius=experiment.contact_radius, element_layers=layers)


def _choose_rigid_motion_pins(experiment: Experiment, mesh: SolidMesh) -> list[tuple[int, str]]:
    """Choose pins (node, fixed axes) against rigid motions of a specimen that no face holds horizontally.

    Faces without friction, and plates with friction before pressure acts, do not hold it. One pin is the middle of the
    base, one is another node. By symmetry they carry no force under a tool on the axis.

    Raises:
        InputError: the tool or the middle node is off the axis, so that the pins would carry a lateral force.
    """
    faces = experiment.resolved_base_interface, experiment.friction
    without, rubbed = (all(loose(face) for face in faces) for loose in (_is_frictionless, _may_slip))
    if not (without or (rubbed and experiment.tool.is_plate)):
        return []
    x, y = mesh.nodes[(base := mesh.sets["base"]), :2].T
    middle, second = base[np.argmin(np.hypot(x, y))], base[np.argmax(x - np.abs(y))]
    if np.hypot(*mesh.nodes[middle, :2]) > 1e-9 or experiment.approach is not None:
        remedy = "Give one of them friction" if without and not experiment.tool.is_plate else "Use 'stick' for one"
        raise InputError("base and tool may both slip, and the tool or the middle node of the base is off the axis: "
                         f"nothing carries the side force. {remedy}", field="friction_base")
    return [(int(middle), "xy"), (int(second), "y")]


def _is_frictionless(face: str | float) -> bool:
    return face == "frictionless"


def _may_slip(face: str | float) -> bool:
    return face == "frictionless" or not isinstance(face, str)


def _require_possible_interfaces(experiment: Experiment) -> None:
    """Raise InputError if a specimen with curved faces has a base that is not bonded, or a bonded plate."""
    if not experiment.specimen.is_flat:
        shape = add_indefinite_article(experiment.specimen.shape)
        if experiment.resolved_base_interface != "bonded":
            raise InputError(f"must be 'bonded' below {shape}; got {experiment.resolved_base_interface}",
                             field="friction_base")
        if experiment.tool.is_plate and experiment.friction == "bonded":
            raise InputError(f"must not be 'bonded' for a plate on the curved top of {shape}. Use 'stick', "
                             "'frictionless' or a coefficient of friction", field="friction")


def build_mesh(experiment: Experiment, resolution: str = "fast", layers: tuple[Layer, ...] = (),
               distance: float = 0.0) -> SolidMesh:
    """Make the undeformed mesh of a resolution; element boundaries coincide with the interfaces of layers.

    Args:
        experiment: specimen, tool and approach.
        resolution: a key of `RESOLUTIONS`.
        layers: layers of the material.
        distance: distance from the edge of the tool up to which the mesh is as fine as under the tool, m.

    Raises:
        InputError: unknown resolution, or layers thicker than the specimen.
    """
    if (chosen := RESOLUTIONS.get(resolution)) is None:
        hint = make_hint_with_similar_or_known_words(resolution, RESOLUTIONS)
        raise InputError(f"unknown resolution {resolution!r}{hint}", field="resolution")
    specimen, tool = experiment.specimen, experiment.tool
    size = specimen.margin()
    if experiment.grip is not None:
        # In a wide thin strip the deformation varies over its height, not over its thickness.
        size = max(size, min(0.5 * specimen.height, math.sqrt(0.5) * specimen.outer_radius))
    interfaces = tuple(np.cumsum([layer.thickness for layer in layers]).tolist())
    if tool.is_plate:
        return specimen.solid_mesh(Grading(chosen.element, chosen.smallest * size, chosen.growth, chosen.largest * size,
                                           chosen.around, interfaces=interfaces, least=chosen.layer_elements))
    radius = (tool.face_radius or experiment.contact_radius) + distance
    least = _LEAST_LARGEST * max(size, specimen.height)
    offset = 0.0 if experiment.approach is None else experiment.approach.offset
    return specimen.solid_mesh(Grading(chosen.element, chosen.smallest * radius, chosen.growth,
                                       max(chosen.largest * radius, least), chosen.around, radius=radius,
                                       centre=(offset, 0.0), interfaces=interfaces, least=chosen.layer_elements))


def _adapt_mesh_to_geometry(mesh: SolidMesh, topology: Model, experiment: Experiment) -> SolidMesh:
    """Move the mesh of a model to the geometry of an experiment, if that differs.

    Raises:
        InputError: the geometry differs, and the model has layers or a shape whose mesh cannot be moved.
    """
    before, after = topology.experiment.specimen, experiment.specimen
    circles = _find_mesh_ring_circle(topology.experiment), _find_mesh_ring_circle(experiment)
    if before.shape == after.shape and before.values_by_file_key == after.values_by_file_key and len({*circles}) == 1:
        return mesh
    if topology.material.layers:
        raise InputError("must have no layers if the geometry differs, because the mesh of layers cannot be moved. Do "
                         "not fit sizes of specimen and tool", field="topology")
    return after.moved_mesh(mesh, before, circles)


def _find_mesh_ring_circle(experiment: Experiment) -> Circle:
    """Return the circle at the edge of the tool, around which the rings of elements are arranged."""
    tool = experiment.tool
    if tool.is_plate:
        return Circle(O_GRID.plate_ring * experiment.specimen.margin(), (0.0, 0.0))
    offset = 0.0 if experiment.approach is None else experiment.approach.offset
    return Circle(tool.face_radius or experiment.contact_radius, (offset, 0.0))


def _build_contact_pairs(experiment: Experiment, mesh: SolidMesh, start: Pose | None) -> ContactPairs:
    """Return the contact pairs of an experiment on a mesh.

    Args:
        experiment: specimen, tool, interfaces.
        mesh: mesh of the specimen.
        start: pose of the tool at its first touch; None: without tool.

    Raises:
        InputError: a tilted needle whose flat face has a sharp edge and no friction.
    """
    tool, upright = experiment.tool, start is None or not any(start.orientation[1:3])
    if not upright and experiment.largest_accurate_depth < math.inf:
        raise InputError("must be positive for a tilted tool without friction: tissue slides around the sharp edge. "
                         "Give the tool an edge radius", field="tool.edge_radius")
    base, top, bottom = mesh.sets["base"], mesh.sets["top"], float(mesh.nodes[:, 2].min())
    side = np.setdiff1d(mesh.sets["side"], np.concatenate([base, top]))
    is_low = mesh.nodes[side, 2] < 0.5 * bottom
    face = mesh.sets["face"] if tool.face_radius else top[:0]
    parts = SurfaceParts(bottom, base, side[is_low], side[~is_low], top, face, np.setdiff1d(top, face))
    return build_contact_pairs(experiment, parts, tool=start is not None, upright=upright)


def make_contact_pairs_and_datum(experiment: Experiment, mesh: SolidMesh, places: np.ndarray
                                 ) -> tuple[tuple[ContactPair, ...], float]:
    """Make the contact pairs of an experiment, and find the first touch of the tool.

    Args:
        experiment: tool and interfaces.
        mesh: undeformed mesh.
        places: positions of the nodes, m, shape (nodes, 3).

    Returns:
        Contact pairs, and height of the scene's origin in the frame of the mesh at the first touch, m.
    """
    start = experiment.tool_pose(0.0)
    pairs = _build_contact_pairs(experiment, mesh, start).pairs
    return pairs, find_first_touch(mesh, places, pairs, start).height


def _compute_law_areas(experiment: Experiment, mesh: SolidMesh) -> np.ndarray:
    """Compute the area that each node represents for tractions of the tool, m2, shape (nodes,).

    At the rim of the top only the area of the top counts, at the edge of a flat face only that of the face.
    """
    areas, top = mesh.compute_node_areas_of_named_faces("side"), mesh.sets["top"]
    areas[top] = mesh.compute_node_areas_of_named_faces("top")[top]
    if experiment.tool.face_radius:
        face = mesh.sets["face"]
        under = mesh.faces["top"][np.isin(mesh.faces["top"], face).all(axis=1)]
        areas[face] = replace(mesh, faces={"face": under}).compute_node_areas_of_named_faces("face")[face]
    return areas
