"""From an experiment to its mesh in space and its boundary-value problem."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tissue_sim.errors import InputError, nearest
from tissue_sim.experiment.experiment import Experiment
from tissue_sim.experiment.tools.outline import Profile
from tissue_sim.experiment.tools.plate import PLATE_RADIUS
from tissue_sim.fem.solid.contact import STICK, Body, Frame
from tissue_sim.fem.solid.contact import nearest as nearest_surface
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.mesh.hexahedra import HEX8P0, HEX27P1, Hexahedron
from tissue_sim.mesh.moved_solid import RingedCylinder, moved_solid
from tissue_sim.mesh.solid import SolidMesh, needle_solid
from tissue_sim.model import Model
from tissue_sim.pose import Pose

#: How far a node may violate a contact condition, in radii of the tool, and of the specimen between plates.
_NEEDLE_TOLERANCE, _PLATE_TOLERANCE = 1e-4, 1e-7


class Resolution(NamedTuple):
    """Sizes of elements.

    Attributes:
        element: element type.
        smallest, growth, largest: of the intervals that lead away from the edge of a tool's face, in its radii.
        around: elements along a quarter of the edge.
    """

    element: Hexahedron
    smallest: float
    growth: float
    largest: float
    around: int


RESOLUTIONS = {
    "realtime": Resolution(HEX8P0, 0.2, 1.8, 1.9, 4),
    "fast": Resolution(HEX27P1, 0.25, 1.8, 1.9, 2),
    "accurate": Resolution(HEX27P1, 0.12, 1.6, 1.2, 4),
}
_FIXED = {"bonded": "xyz", "frictionless": "z"}


def make_solver(model: Model, *, resolution: str = "fast", mesh: SolidMesh | None = None,
                topology: Model | None = None) -> SolidSolver:
    """The solver in space of a model; see `tissue_sim.fem.solver.SolverMaker`.

    Args:
        model: experiment and material.
        resolution: a key of `RESOLUTIONS`.
        mesh: a mesh of your own instead.
        topology: a model whose mesh is taken, or of which `mesh` is one, and moved to the geometry of this one.
    """
    experiment = model.experiment
    _require(experiment)
    if mesh is None:
        mesh = build_mesh((topology or model).experiment, resolution)
    if topology is not None:
        mesh = moved_solid(mesh, _ringed(topology.experiment), _ringed(experiment))
    tool = experiment.tool
    bonded = mesh.sets["top" if tool.is_plate else "face"] if experiment.friction == "bonded" else np.zeros(0, int)
    start = experiment.tool_pose(0.0)
    bodies = _bodies(experiment, mesh, bonded)
    tolerance = (_PLATE_TOLERANCE * experiment.specimen.radius if tool.is_plate
                 else _NEEDLE_TOLERANCE * tool.require_radius())
    fixed = {"base": _FIXED[experiment.base_interface]} if experiment.base_interface in _FIXED else {}
    return SolidSolver(mesh, model.material, fixed, bonded, bodies=bodies, tolerance=tolerance, start=start,
                       datum=_touching_height(mesh, bodies, start), contact_radius=experiment.contact_radius,
                       pins=_pins(experiment, mesh))


def _pins(experiment: Experiment, mesh: SolidMesh) -> list[tuple[int, str]]:
    """What keeps a specimen between frictionless faces where it is: the middle of its base, and one more node there
    from turning about it. By symmetry they carry no force under a tool on the axis."""
    if not experiment.base_interface == experiment.friction == "frictionless":
        return []
    base = mesh.sets["base"]
    x, y = mesh.nodes[base, 0], mesh.nodes[base, 1]
    middle, beside = base[np.argmin(np.hypot(x, y))], base[np.argmax(x - np.abs(y))]
    if np.hypot(*mesh.nodes[middle, :2]) > 1e-9 or experiment.approach is not None:
        raise InputError("nothing keeps the specimen from sliding off: base and tool are both frictionless; give one "
                         "of them friction", field="friction_base")
    return [(int(middle), "xy"), (int(beside), "y")]


def _require(experiment: Experiment) -> None:
    if experiment.specimen.specific_weight:
        raise InputError("the solid in space takes no self-weight yet; leave gravity out, or use the axisymmetric "
                         "solver", field="specimen.gravity")
    if experiment.acting_laws:
        raise InputError("the solid in space takes no adhesion or other laws of contact yet; leave them out",
                         field="contact_laws")


def build_mesh(experiment: Experiment, resolution: str = "fast") -> SolidMesh:
    """The mesh that a named resolution stands for.

    Raises:
        InputError: unknown resolution.
    """
    chosen = RESOLUTIONS.get(resolution)
    if chosen is None:
        raise InputError(f"unknown resolution {resolution!r}{nearest(resolution, RESOLUTIONS)}", field="resolution")
    specimen, tool = experiment.specimen, experiment.tool
    _, _, radius, centre = _ringed(experiment)
    if tool.is_plate:
        return needle_solid(specimen.radius, specimen.height, radius, chosen.element, growth=1.3,
                            smallest=0.6 * chosen.smallest * radius, largest=0.3 * chosen.largest * radius,
                            around=chosen.around)
    least = 0.17 * max(specimen.radius, specimen.height)
    return needle_solid(specimen.radius, specimen.height, radius, chosen.element, smallest=chosen.smallest * radius,
                        growth=chosen.growth, largest=max(chosen.largest * radius, least), around=chosen.around,
                        centre=centre)


def _ringed(experiment: Experiment) -> RingedCylinder:
    """What the rings of the mesh lie about."""
    specimen, tool = experiment.specimen, experiment.tool
    if tool.is_plate:
        return RingedCylinder(specimen.radius, specimen.height, 0.6 * specimen.radius, (0.0, 0.0))
    offset = 0.0 if experiment.approach is None else experiment.approach.offset
    return RingedCylinder(specimen.radius, specimen.height, tool.face_radius or experiment.contact_radius,
                          (offset, 0.0))


def _coefficient(interface: str | float) -> float:
    """Coefficient of friction of an interface for tissue that meets it during the test."""
    if not isinstance(interface, str):
        return interface
    return {"bonded": STICK, "stick": STICK, "frictionless": 0.0}[interface]


def _bodies(experiment: Experiment, mesh: SolidMesh, bonded: np.ndarray) -> list[Body]:
    """Who may meet whom: the base and the lower half of the side, the tool and the rest."""
    tool, bottom = experiment.tool, float(mesh.nodes[:, 2].min())
    plane = Profile(np.array([[PLATE_RADIUS, bottom], [0.0, bottom]]), 0.0, 1)
    mu = _coefficient(experiment.base_interface)
    side = np.setdiff1d(mesh.sets["side"], np.concatenate([mesh.sets["base"], mesh.sets["top"]]))
    low = mesh.nodes[side, 2] < 0.5 * bottom
    bodies = []
    if experiment.base_interface not in _FIXED:
        bodies.append(Body(plane, mesh.sets["base"], (mu, mu), moves=False, tied=mu == STICK, stays=True))
    bodies.append(Body(plane, side[low], (mu, mu), moves=False))
    mu = _coefficient(experiment.friction)
    free = np.setdiff1d(mesh.sets["top"], bonded)
    if tool.is_plate:
        return [*bodies, Body(tool.profile, np.concatenate([free, side[~low]]), (mu, mu))]
    wall = _coefficient(experiment.friction_wall)
    if tool.face_radius == 0:
        return [*bodies, Body(tool.profile, free, (mu, wall))]
    upright = experiment.approach is None or not experiment.approach.angle
    under = np.intersect1d(mesh.sets["face"], free)
    beside = np.setdiff1d(free, under)
    if experiment.friction == "bonded":
        return [*bodies, Body(tool.profile, beside, (mu, wall), first_line=1, closed=upright)]
    # Tissue beside a sharp edge cannot come under the face without slip.
    first = 0 if tool.edge_radius else 1
    return [*bodies, Body(tool.profile, under, (mu, wall), tied=mu == STICK),
            Body(tool.profile, beside, (mu, wall), first_line=first, closed=upright)]


def _touching_height(mesh: SolidMesh, bodies: list[Body], start: Pose) -> float:
    """Height of the scene's origin in the frame of the mesh where the tool first touches, m."""
    moving = [body for body in bodies if body.moves]
    if not moving:
        return 0.0
    top = mesh.nodes[mesh.sets["top"]]

    def clearance(datum: float) -> float:
        at = Frame(start, datum).into(top)
        return min(float(nearest_surface(body, at, pressed_in=False).gap.min()) for body in moving)

    scale = float(np.ptp(mesh.nodes[:, 2]))
    if abs(clearance(0.0)) < 1e-12 * scale:
        return 0.0
    from scipy.optimize import brentq

    high, step = scale, 1e-6 * scale
    while clearance(high - step) > 0.0:
        step *= 2.0
    return brentq(clearance, high - step, high, xtol=1e-15)
