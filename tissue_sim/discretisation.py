"""From an experiment to its mesh and its boundary-value problem."""

from __future__ import annotations

import numpy as np
from scipy.integrate import simpson

from tissue_sim.errors import ConvergenceError, InputError, nearest
from tissue_sim.experiment import Experiment, Model, Specimen
from tissue_sim.fem.axisymmetric import AxisymmetricSolver
from tissue_sim.fem.contact import Contact
from tissue_sim.fem.elements import Q9P1, Element
from tissue_sim.fem.newton import StepStatus
from tissue_sim.mesh import Mesh, cylinder_mesh, needle_mesh
from tissue_sim.tool import Tool

#: Resolution -> elements and grading along r and z of a cylinder as slender as the study's (radius 40, height 70 mm)
#: between plates. Bonded compression to 10 mm errs by 0.28 % (fast) and 0.03 % (accurate) at most.
RESOLUTIONS = {"fast": ((6, 8), (10.0, 4.0)), "accurate": ((16, 20), (50.0, 10.0))}
_STUDY_SLENDERNESS = 70.0 / 40.0
#: Resolution -> smallest and largest element in radii of the needle, and growth from one to the next. The study's
#: needle at 2, 5 and 10 mm errs by 0.7 % (fast) and 0.1 % (accurate) at most.
NEEDLE_RESOLUTIONS = {"fast": (0.1625, 1.875, 1.8), "accurate": (0.00625, 1.5, 1.5)}
#: Elements need not be smaller than this share of a rounded edge, nor larger than this share of the specimen.
_ROUNDING_SHARE, _SPECIMEN_SHARE = 0.25, 0.17
_HELD = {"bonded": "rz", "frictionless": "z"}


def build_mesh(experiment: Experiment, resolution: str = "fast", element: Element = Q9P1) -> Mesh:
    """The mesh that a named resolution stands for; a placed specimen is meshed with the height that it says.

    Raises:
        InputError: unknown resolution.
    """
    if resolution not in RESOLUTIONS:
        raise InputError(f"unknown resolution {resolution!r}{nearest(resolution, RESOLUTIONS)}", field="resolution")
    specimen, tool = experiment.specimen, experiment.tool
    if experiment.homogeneous:
        # Every mesh is exact.
        return cylinder_mesh(specimen.radius, specimen.height, (2, 2), element)
    if tool.shape != "plate":
        smallest, largest, growth = NEEDLE_RESOLUTIONS[resolution]
        return needle_mesh(
            specimen.radius, specimen.height, tool.face_radius, element, growth=growth,
            smallest=max(smallest * tool.radius, _ROUNDING_SHARE * tool.edge_radius),
            largest=max(largest * tool.radius, _SPECIMEN_SHARE * max(specimen.radius, specimen.height)))
    (along_r, along_z), grading = RESOLUTIONS[resolution]
    # As many elements in other shapes, with no fewer than half and no more than four times as many along a side.
    stretch = np.sqrt(specimen.height / specimen.radius / _STUDY_SLENDERNESS)
    counts = [round(float(np.clip(count * share, count / 2, 4 * count)))
              for count, share in ((along_r, 1 / stretch), (along_z, stretch))]
    return cylinder_mesh(specimen.radius, specimen.height, counts, element, grading=grading)


def build_solver(model: Model, mesh: Mesh) -> AxisymmetricSolver:
    """The boundary-value problem of an experiment on a mesh, at the moment when the tool touches.

    A specimen that weighs has settled by then; one whose height was measured as placed has got the moulded height that
    settles to it, and `solver.mesh` with it.

    Raises:
        ConvergenceError: the specimen does not stand under its own weight.
    """
    experiment = model.experiment
    start = None
    if experiment.specimen.specific_weight:
        mesh, start = _settled(model, mesh)
    weight = experiment.specimen.specific_weight
    supports = {"base": _HELD[experiment.friction_base]}
    if experiment.tool.shape == "plate":
        return AxisymmetricSolver(mesh, model.material, supports, {"top": _HELD[experiment.friction]},
                                  specific_weight=weight, start=start)
    held = {"face": "rz"} if experiment.friction == "bonded" else {}
    return AxisymmetricSolver(mesh, model.material, supports, held, contact=_contact(experiment, mesh),
                              specific_weight=weight, start=start)


def sag(solver: AxisymmetricSolver) -> float:
    """How much lower the top stands, on the mean of its area, than it was moulded when the tool touches, m."""
    top = solver.mesh.sets["top"]
    r = solver.mesh.nodes[top, 0]
    return -float(simpson(solver.start[2 * top + 1] * r, x=r) / simpson(r, x=r))


def _contact(experiment: Experiment, mesh: Mesh) -> Contact:
    """Where the surface may meet the needle: all of it where it can leave the face, else what is beside the face."""
    tool: Tool = experiment.tool
    profile = tool.profile
    face, free = mesh.edges("face"), mesh.edges("free")
    stick = (experiment.friction == "stick", experiment.friction_wall == "stick")
    if experiment.friction == "bonded":
        return Contact(profile, free, np.full(len(free), profile.shaft), np.zeros(len(free), bool), stick, tool.radius)
    # Tissue beside a sharp edge cannot come under the face without slip.
    first = np.concatenate([np.zeros(len(face)), np.full(len(free), 0 if tool.edge_radius else profile.shaft)])
    tied = np.arange(len(first)) < (len(face) if stick[0] else 0)
    return Contact(profile, np.concatenate([face, free]), first, tied, stick, tool.radius)


def _settled(model: Model, mesh: Mesh) -> tuple[Mesh, np.ndarray]:
    """The mesh as moulded, and the state in which it stands under its own weight."""
    specimen: Specimen = model.experiment.specimen
    height = -float(mesh.nodes[:, 1].min())
    factor, state = 1.0, None
    for _ in range(50):
        moulded = mesh.stretched(factor)
        solver = AxisymmetricSolver(moulded, model.material, {"base": _HELD[model.experiment.friction_base]}, {})
        _let_settle(solver, specimen.specific_weight)
        state, stands = solver.state, factor * height - sag(solver)
        if specimen.height_is == "moulded" or abs(stands / height - 1) < 1e-10:
            return moulded, state
        # The sag grows with the square of the height: one Newton step on factor - c factor^2 = 1.
        loss = (factor * height - stands) / (factor**2 * height)
        factor -= (factor - loss * factor**2 - 1) / (1 - 2 * loss * factor) if 2 * loss * factor < 1 else -0.1
    raise ConvergenceError(f"no moulded height settles to {height * 1e3:g} mm under a specific weight of "
                           f"{specimen.specific_weight:g} N/m3; check density and moduli")


def _let_settle(solver: AxisymmetricSolver, specific_weight: float) -> None:
    """Put weight on in as many parts as it takes."""
    carried, part = 0.0, 1.0
    while carried < 1.0:
        solver.specific_weight = min(1.0, carried + part) * specific_weight
        step = solver.step(0.0)
        if step.status is StepStatus.CONVERGED:
            carried = min(1.0, carried + part)
            part *= 2.0
        else:
            part /= 2.0
            if part < 2.0**-10:
                raise ConvergenceError("the specimen does not stand under its own weight: it stopped settling at "
                                       f"{carried:.0%} of it ({step.status.message}); check density and moduli")
    solver.start[:] = solver.state[: solver.start.size]
