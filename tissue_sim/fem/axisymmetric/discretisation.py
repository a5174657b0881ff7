"""From an experiment to its mesh and its boundary-value problem."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tissue_sim.errors import ConvergenceError, InputError, nearest
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.fem.axisymmetric.contact_pairs import build_contact
from tissue_sim.fem.axisymmetric.resolutions import RESOLUTIONS, STUDY_SLENDERNESS, UNMEASURED, Resolution
from tissue_sim.fem.axisymmetric.solver import AxisymmetricSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.material.layer import Layer
from tissue_sim.mesh import Mesh, cylinder_mesh, needle_mesh, structured_mesh, tip_mesh, with_lines
from tissue_sim.mesh.elements import Q9P1, Element
from tissue_sim.model import Model
from tissue_sim.specimen.cylinder import Cylinder, require_cylinder

#: Elements need not be smaller than this share of a rounded edge, nor larger than this share of the specimen.
_ROUNDING_SHARE, _SPECIMEN_SHARE = 0.25, 0.17
#: Where the contact reaches the shoulder of a tip, from this share of its radius on, stresses are those of an edge:
#: elements are smaller by the next share there, down to the last one of the contact.
_AT_THE_SHOULDER, _SHOULDER_SHARE, _FINE_ENOUGH = 0.9, 0.4, 0.08
_HELD = {"bonded": "rz", "frictionless": "z"}


def build_mesh(experiment: Experiment, resolution: str = "fast", element: Element = Q9P1,
               layers: tuple[Layer, ...] = ()) -> Mesh:
    """The mesh that a named resolution stands for; a placed specimen is meshed with the height that it says.

    Args:
        experiment: what is done.
        resolution: a key of `RESOLUTIONS`, or "realtime".
        element: element type.
        layers: of the material; element boundaries lie on their interfaces.

    Raises:
        InputError: unknown resolution, or layers thicker than the specimen is high.
    """
    chosen = RESOLUTIONS.get(UNMEASURED.get(resolution, resolution))
    if chosen is None:
        raise InputError(f"unknown resolution {resolution!r}{nearest(resolution, [*UNMEASURED, *RESOLUTIONS])}",
                         field="resolution")
    mesh = _mesh_of_one_material(experiment, chosen, element, small=experiment.homogeneous and not layers)
    if not layers:
        return mesh
    interfaces = -np.cumsum([layer.thickness for layer in layers])
    if interfaces[-1] <= -experiment.specimen.height:
        raise InputError(f"the layers are {-interfaces[-1] * 1e3:g} mm thick, the specimen only "
                         f"{experiment.specimen.height * 1e3:g} mm high", field="layers")
    corners = mesh.nodes[mesh.connectivity[:, :4]].reshape(-1, 2)
    r, z = np.unique(corners[:, 0]), np.unique(corners[:, 1])
    layered = structured_mesh(r, with_lines(z, interfaces.tolist(), chosen.layer_elements), element)
    top, old = layered.sets["top"], mesh.sets["top"]
    top_sets = {name: top[np.isin(old, nodes)] for name, nodes in mesh.sets.items() if name in ("face", "free")}
    return replace(layered, sets={**layered.sets, **top_sets})


def _mesh_of_one_material(experiment: Experiment, resolution: Resolution, element: Element, *, small: bool) -> Mesh:
    specimen, tool = _cylinder(experiment), experiment.tool
    if small:
        # Every mesh is exact.
        return cylinder_mesh(specimen.radius, specimen.height, (2, 2), element)
    least = _SPECIMEN_SHARE * max(specimen.radius, specimen.height)
    if tool.face_radius == 0:
        smallest, largest, growth = resolution.tip
        contact = experiment.contact_radius
        if tool.profile.shaft and contact >= _AT_THE_SHOULDER * tool.require_radius():
            smallest = max(_SHOULDER_SHARE * smallest, min(smallest, _FINE_ENOUGH))
        return tip_mesh(specimen.radius, specimen.height, contact, element, growth=growth,
                        smallest=smallest * contact, largest=max(largest * contact, least))
    if tool.face_radius:
        radius = tool.require_radius()
        smallest, largest, growth = resolution.needle
        edge, rubbed = tool.edge_radius / radius, resolution.rubbed_edge
        if rubbed and 0.0 < edge < smallest and experiment.friction not in ("bonded", "frictionless"):
            smallest, largest, growth = rubbed._replace(smallest=max(edge, rubbed.smallest))
        return needle_mesh(
            specimen.radius, specimen.height, tool.face_radius, element, growth=growth,
            smallest=max(smallest * radius, _ROUNDING_SHARE * tool.edge_radius), largest=max(largest * radius, least))
    (along_r, along_z), grading = resolution.plates
    # As many elements in other shapes, with no fewer than half and no more than four times as many along a side.
    stretch = np.sqrt(specimen.height / specimen.radius / STUDY_SLENDERNESS)
    columns, rows = (round(float(np.clip(count * share, count / 2, 4 * count)))
                     for count, share in ((along_r, 1 / stretch), (along_z, stretch)))
    return cylinder_mesh(specimen.radius, specimen.height, (columns, rows), element, grading=grading)


def moved_mesh(mesh: Mesh, before: Model, after: Model) -> Mesh:
    """The mesh of a model for one of another geometry: same elements, with the nodes where the new one has them."""
    lines = [_lines(model) for model in (before, after)]
    return mesh.moved(*zip(*lines, strict=True))


def _lines(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Radii and heights at which element boundaries lie in every mesh of a model, m, ascending."""
    experiment = model.experiment
    face = [experiment.tool.face_radius] if experiment.tool.face_radius else []
    interfaces = -np.cumsum([layer.thickness for layer in model.material.layers])
    return (np.array([0.0, *face, _cylinder(experiment).radius]),
            np.array([-experiment.specimen.height, *interfaces[::-1], 0.0]))


def _cylinder(experiment: Experiment) -> Cylinder:
    return require_cylinder(experiment.specimen, "the axisymmetric solver")


def make_solver(model: Model, *, resolution: str = "fast", mesh: Mesh | None = None,
                topology: Model | None = None) -> AxisymmetricSolver:
    """The axisymmetric solver of a model; see `tissue_sim.fem.solver.SolverMaker`.

    Args:
        model: experiment and material.
        resolution: a key of `RESOLUTIONS`, or "realtime".
        mesh: a mesh of your own instead.
        topology: a model of another geometry, whose mesh is taken (or whose `mesh` is given) and moved to this one's.
    """
    if model.experiment.approach is not None:
        raise InputError("an axisymmetric solid takes a tool on its axis only; take the solver \"solid\" (--solid)",
                         field="approach")
    if model.material.regions:
        raise InputError("an axisymmetric solid has no regions; take the solver \"solid\" (--solid)",
                         field="material.regions")
    meshed = model if topology is None else topology
    if mesh is None:
        mesh = build_mesh(meshed.experiment, resolution, layers=meshed.material.layers)
    return build_solver(model, moved_mesh(mesh, meshed, model))


def build_solver(model: Model, mesh: Mesh) -> AxisymmetricSolver:
    """The boundary-value problem of an experiment on a mesh, at the moment when the tool touches.

    A specimen that weighs has settled by then; one whose height was measured as placed has got the moulded height that
    settles to it, and `solver.mesh` with it.

    Raises:
        ConvergenceError: the specimen does not stand under its own weight.
    """
    experiment = model.experiment
    start, weight = None, experiment.specimen.specific_weight
    layers = element_layers(mesh, model.material.layers)
    uniform = experiment.homogeneous and not model.material.layers
    if weight:
        start = _settled(model, mesh, layers)
        mesh = start.mesh
    held = {}
    if experiment.friction == "bonded":
        held = {"top" if experiment.tool.is_plate else "face": "rz"}
    return AxisymmetricSolver(mesh, model.material, _supports(experiment), held,
                              contact=build_contact(experiment, mesh, homogeneous=uniform), specific_weight=weight,
                              element_layers=layers, contact_radius=experiment.contact_radius, start=start)


def element_layers(mesh: Mesh, layers: tuple[Layer, ...]) -> np.ndarray:
    """Number of the layer in which the centre of each element lies, that after the last for none, shape (elements,)."""
    depth = -mesh.nodes[mesh.connectivity[:, :4], 1].mean(axis=1)
    return np.searchsorted(np.cumsum([layer.thickness for layer in layers]), depth)


def _supports(experiment: Experiment) -> dict[str, str]:
    return {"base": _HELD[experiment.base_interface]} if experiment.base_interface in _HELD else {}


def _settled(model: Model, mesh: Mesh, layers: np.ndarray) -> AxisymmetricSolver:
    """The specimen as moulded, standing under its own weight without the tool."""
    specimen = model.experiment.specimen
    height = -float(mesh.nodes[:, 1].min())
    factor = 1.0
    for _ in range(50):
        moulded = mesh.stretched(factor)
        solver = AxisymmetricSolver(moulded, model.material, _supports(model.experiment), {},
                                    contact=build_contact(model.experiment, moulded, tool=False), element_layers=layers,
                                    contact_radius=model.experiment.contact_radius)
        _let_settle(solver, specimen.specific_weight)
        stands = factor * height - solver.sag
        if specimen.height_is == "moulded" or abs(stands / height - 1) < 1e-10:
            return solver
        # The sag grows with the square of the height: one Newton step on factor - c factor^2 = 1.
        loss = (factor * height - stands) / (factor**2 * height)
        factor -= (factor - loss * factor**2 - 1) / (1 - 2 * loss * factor) if 2 * loss * factor < 1 else -0.1
    raise ConvergenceError(f"no moulded height settles to {height * 1e3:g} mm under a specific weight of "
                           f"{specimen.specific_weight:g} N/m3; check density and moduli")


def _let_settle(solver: AxisymmetricSolver, specific_weight: float) -> None:
    """Put weight on in as many parts as it takes."""
    carried, part = 0.0, 1.0
    while carried < 1.0:
        solver.equations.specific_weight = min(1.0, carried + part) * specific_weight
        # It has stood for long.
        step = solver.step(0.0, np.inf)
        if step.status is StepStatus.CONVERGED:
            carried = min(1.0, carried + part)
            part *= 2.0
        else:
            part /= 2.0
            if part < 2.0**-10:
                raise ConvergenceError("the specimen does not stand under its own weight: it stopped settling at "
                                       f"{carried:.0%} of it ({step.status.message}); check density and moduli")
    start = solver.equations.start
    start[:] = solver.state[: start.size]
