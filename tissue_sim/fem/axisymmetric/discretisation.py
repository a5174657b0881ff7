"""Mesh and axisymmetric boundary-value problem of an experiment."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tissue_sim.errors import InputError, make_hint_with_similar_or_known_words
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.fem.axisymmetric.resolutions import (
    RESOLUTIONS,
    STUDY_SLENDERNESS,
    UNMEASURED,
    MeshResolution,
    find_force_error_of_resolution_or_none,
)
from tissue_sim.fem.axisymmetric.solver import AxisymmetricSolver
from tissue_sim.fem.contact.pairs import ContactPairs, SurfaceParts, build_contact_pairs
from tissue_sim.fem.solver import Step
from tissue_sim.fem.stepping import solve_self_weight_equilibrium
from tissue_sim.material.material import Layer
from tissue_sim.mesh import (
    Mesh,
    cylinder_mesh,
    cylinder_mesh_refined_under_needle,
    cylinder_mesh_refined_under_tip,
    insert_interfaces_and_refine_layers,
    structured_mesh,
)
from tissue_sim.mesh.elements import Q9P1, QuadrilateralElement
from tissue_sim.model import Model
from tissue_sim.specimen.cylinder import Cylinder, require_cylinder


@dataclass(frozen=True)
class ElementSizeLimits:
    """Limits of the element sizes.

    Attributes:
        edge_fraction: smallest useful element size, over the radius of a rounded edge.
        specimen_fraction: largest element size, over the radius or height of the specimen, whichever is larger.
        shoulder: contact radius, over the radius of a tip, from which the contact reaches the shoulder of the tip; the
            stresses there are those of an edge.
        shoulder_refinement: factor of the smallest element size at a shoulder.
        shoulder_smallest: smallest element size at a shoulder, over the contact radius.
    """

    edge_fraction: float = 0.25
    specimen_fraction: float = 0.17
    shoulder: float = 0.9
    shoulder_refinement: float = 0.4
    shoulder_smallest: float = 0.08


#: Settings of every mesh.
_SETTINGS = ElementSizeLimits()
#: Interface of the base -> fixed components of its nodes.
_FIXED_COMPONENTS = {"bonded": "rz", "frictionless": "z"}


def build_mesh(experiment: Experiment, resolution: str = "fast", element: QuadrilateralElement = Q9P1,
               layers: tuple[Layer, ...] = ()) -> Mesh:
    """Return the mesh of a named resolution.

    A specimen whose height was measured as placed is meshed with that height.

    Args:
        experiment: specimen, tool, interfaces.
        resolution: key of `RESOLUTIONS`, or "realtime".
        element: element type.
        layers: layers of the material; element boundaries lie on their interfaces.

    Raises:
        InputError: the resolution is unknown, or the layers are thicker than the specimen.
    """
    chosen = RESOLUTIONS.get(UNMEASURED.get(resolution, resolution))
    if chosen is None:
        known = [*UNMEASURED, *RESOLUTIONS]
        raise InputError(f"unknown resolution {resolution!r}{make_hint_with_similar_or_known_words(resolution, known)}",
                         field="resolution")
    mesh = _make_unlayered_mesh(experiment, chosen, element,
                                small=experiment.has_homogeneous_deformation and not layers)
    if not layers:
        return mesh
    interfaces = -np.cumsum([layer.thickness for layer in layers])
    if interfaces[-1] <= -experiment.specimen.height:
        raise InputError(f"must be thinner in total than the specimen, {experiment.specimen.height * 1e3:g} mm; got "
                         f"{-interfaces[-1] * 1e3:g} mm.", field="layers")
    corners = mesh.nodes[mesh.connectivity[:, :4]].reshape(-1, 2)
    r, z = np.unique(corners[:, 0]), np.unique(corners[:, 1])
    layered = structured_mesh(r, insert_interfaces_and_refine_layers(z, interfaces.tolist(), chosen.layer_elements),
                              element)
    top, old = layered.sets["top"], mesh.sets["top"]
    top_sets = {name: top[np.isin(old, nodes)] for name, nodes in mesh.sets.items() if name in ("face", "free")}
    return replace(layered, sets={**layered.sets, **top_sets})


def _make_unlayered_mesh(experiment: Experiment, resolution: MeshResolution, element: QuadrilateralElement, *,
                         small: bool) -> Mesh:
    """Return the mesh without layers; `small`: four elements, for a homogeneous deformation."""
    specimen, tool = _require_and_get_cylinder(experiment), experiment.tool
    if small:
        # Every mesh is exact for a homogeneous deformation.
        return cylinder_mesh(specimen.radius, specimen.height, (2, 2), element)
    upper_limit = _SETTINGS.specimen_fraction * max(specimen.radius, specimen.height)
    if tool.face_radius == 0:
        smallest, largest, growth = resolution.tip
        contact = experiment.contact_radius
        if tool.profile.shaft and contact >= _SETTINGS.shoulder * tool.require_radius():
            smallest = max(_SETTINGS.shoulder_refinement * smallest, min(smallest, _SETTINGS.shoulder_smallest))
        return cylinder_mesh_refined_under_tip(specimen.radius, specimen.height, contact, element, growth=growth,
                                               smallest=smallest * contact,
                                               largest=max(largest * contact, upper_limit))
    if tool.face_radius:
        radius = tool.require_radius()
        smallest, largest, growth = resolution.needle
        edge, rubbed = tool.edge_radius / radius, resolution.rubbed_edge
        if rubbed and 0.0 < edge < smallest and experiment.friction not in ("bonded", "frictionless"):
            smallest, largest, growth = rubbed._replace(smallest=max(edge, rubbed.smallest))
        return cylinder_mesh_refined_under_needle(
            specimen.radius, specimen.height, tool.face_radius, element, growth=growth,
            smallest=max(smallest * radius, _SETTINGS.edge_fraction * tool.edge_radius),
            largest=max(largest * radius, upper_limit))
    (along_r, along_z), grading = resolution.plates
    # Other shapes have about the same number of elements, and half to four times the number along each side.
    stretch = np.sqrt(specimen.height / specimen.radius / STUDY_SLENDERNESS)
    columns, rows = (round(float(np.clip(count * factor, count / 2, 4 * count)))
                     for count, factor in ((along_r, 1 / stretch), (along_z, stretch)))
    return cylinder_mesh(specimen.radius, specimen.height, (columns, rows), element, grading=grading)


def move_mesh_to_geometry(mesh: Mesh, before: Model, after: Model) -> Mesh:
    """Return the mesh of one model with its nodes moved to the geometry of another; the elements stay the same."""
    lines = [_list_element_boundary_radii_and_heights(model) for model in (before, after)]
    return mesh.with_moved_mesh_lines(*zip(*lines, strict=True))


def _list_element_boundary_radii_and_heights(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Return the radii r and heights z at which every mesh of a model has element boundaries, m, ascending."""
    experiment = model.experiment
    face = [experiment.tool.face_radius] if experiment.tool.face_radius else []
    interfaces = -np.cumsum([layer.thickness for layer in model.material.layers])
    return (np.array([0.0, *face, _require_and_get_cylinder(experiment).radius]),
            np.array([-experiment.specimen.height, *interfaces[::-1], 0.0]))


def _require_and_get_cylinder(experiment: Experiment) -> Cylinder:
    """Return the specimen; raises InputError if the specimen is not a cylinder."""
    return require_cylinder(experiment.specimen, "the axisymmetric solver")


def make_solver(model: Model, *, resolution: str = "fast", mesh: Mesh | None = None,
                topology: Model | None = None) -> AxisymmetricSolver:
    """Return the axisymmetric solver of a model; see `tissue_sim.fem.solver.SolverMaker`.

    Args:
        model: experiment and material.
        resolution: key of `RESOLUTIONS`, or "realtime".
        mesh: mesh to use instead of a resolution.
        topology: model of another geometry whose mesh (or `mesh`) is moved to the geometry of `model`.

    Raises:
        InputError: the model has a pose of approach or regions, or the resolution is unknown.
    """
    if model.experiment.approach is not None:
        raise InputError("must be None for an axisymmetric solid, whose tool is on the axis. Use the solver "
                         "\"solid\" (--solid).", field="approach")
    grip = model.experiment.grip
    if grip is not None and (grip.is_rotation or any(grip.axis[:2])):
        raise InputError("must move along the axis for an axisymmetric solid; got a lateral motion or a twist. Use the "
                         "solver \"solid\" (--solid).", field="grip")
    if model.material.regions:
        raise InputError("must be empty for an axisymmetric solid. Use the solver \"solid\" "
                         "(--solid).", field="material.regions")
    meshed, error = model if topology is None else topology, None
    if mesh is None:
        mesh = build_mesh(meshed.experiment, resolution, layers=meshed.material.layers)
        error = find_force_error_of_resolution_or_none(meshed.experiment, resolution)
    solver = build_solver_on_mesh(model, move_mesh_to_geometry(mesh, meshed, model))
    solver.stated_force_error = error
    return solver


def build_solver_on_mesh(model: Model, mesh: Mesh) -> AxisymmetricSolver:
    """Return the solver of an experiment on a mesh, in the state in which the tool first touches.

    A specimen with weight has settled under its weight. If its height was measured as placed, `solver.mesh` has the
    height as moulded that settles to the measured height.

    Raises:
        ConvergenceError: the specimen has no equilibrium under its own weight.
    """
    experiment = model.experiment
    start, weight = None, experiment.specimen.specific_weight
    layers = find_element_layer_indices(mesh, model.material.layers)
    uniform = experiment.has_homogeneous_deformation and not model.material.layers
    if weight:
        start = solve_self_weight_equilibrium(_SelfWeight(model, mesh, layers), experiment.specimen,
                                              -float(mesh.nodes[:, 1].min()))
        mesh = start.mesh
    held = {}
    if experiment.friction == "bonded":
        held = {"top" if experiment.tool.is_plate else "face": "rz"}
    return AxisymmetricSolver(mesh, model.material, _get_fixed_components_by_node_set(experiment), held,
                              contact=_build_contact_pairs_or_none(experiment, mesh, homogeneous=uniform),
                              specific_weight=weight, element_layers=layers, contact_radius=experiment.contact_radius,
                              start=start)


def find_element_layer_indices(mesh: Mesh, layers: tuple[Layer, ...]) -> np.ndarray:
    """Return the index of the layer with the centre of each element, shape (elements,).

    Elements below all layers have the number of layers as index.
    """
    depth = -mesh.nodes[mesh.connectivity[:, :4], 1].mean(axis=1)
    return np.searchsorted(np.cumsum([layer.thickness for layer in layers]), depth)


def _get_fixed_components_by_node_set(experiment: Experiment) -> dict[str, str]:
    """Return the fixed components of base and side, node set -> components."""
    interface = experiment.resolved_base_interface
    base = {"base": _FIXED_COMPONENTS[interface]} if interface in _FIXED_COMPONENTS else {}
    return base | ({"side": "r"} if experiment.has_lateral_wall else {})


def _build_contact_pairs_or_none(experiment: Experiment, mesh: Mesh, *, tool: bool = True,
                                 homogeneous: bool | None = None) -> ContactPairs | None:
    """Return the contact pairs of an experiment; None if no edge of the mesh may come into contact.

    Args:
        experiment: specimen, tool, interfaces.
        mesh: mesh of the specimen.
        tool: whether the tool is present.
        homogeneous: whether the deformation of the specimen is homogeneous; None: as the experiment states.
    """
    homogeneous = experiment.has_homogeneous_deformation if homogeneous is None else homogeneous
    bottom, side = float(mesh.nodes[:, 1].min()), mesh.select_edges_in_node_set("side")
    none, is_high = side[:0], mesh.nodes[side, 1].mean(axis=1) > 0.5 * bottom
    base, top = (mesh.select_edges_in_node_set(name) for name in ("base", "top"))
    face, free = (mesh.select_edges_in_node_set(name) if experiment.tool.face_radius else none
                  for name in ("face", "free"))
    low, high = (none, none) if homogeneous else (side[~is_high], side[is_high])
    contact = build_contact_pairs(experiment, SurfaceParts(bottom, base, low, high, top, face, free), tool=tool,
                                  homogeneous=homogeneous)
    return contact if any(len(pair.surface) for pair in contact.pairs) else None


@dataclass(frozen=True)
class _SelfWeight:
    """Self-weight of an axisymmetric specimen; see `SelfWeightProblem`.

    Attributes:
        model: experiment and material.
        mesh: undeformed mesh of the stated height.
        layers: layer of each element, see `find_element_layer_indices`.
    """

    model: Model
    mesh: Mesh
    layers: np.ndarray
    smallest_increment: float = 2.0**-10

    def make_solver(self, stretch: float) -> AxisymmetricSolver:
        """See `SelfWeightProblem.make_solver`."""
        experiment, mesh = self.model.experiment, self.mesh.scale_height(stretch)
        return AxisymmetricSolver(mesh, self.model.material, _get_fixed_components_by_node_set(experiment), {},
                                  contact=_build_contact_pairs_or_none(experiment, mesh, tool=False),
                                  element_layers=self.layers, contact_radius=experiment.contact_radius)

    def solve_equilibrium_under_weight(self, solver: AxisymmetricSolver, specific_weight: float) -> Step:
        """See `SelfWeightProblem.solve_equilibrium_under_weight`."""
        solver.equations.specific_weight = specific_weight
        return solver.step(0.0, np.inf)

    def store_resting_state(self, solver: AxisymmetricSolver) -> None:
        """See `SelfWeightProblem.store_resting_state`."""
        start = solver.equations.start
        start[:] = solver.state[: start.size]
