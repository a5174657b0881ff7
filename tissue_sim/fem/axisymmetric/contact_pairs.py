"""Definition of the contact pairs of an experiment on its mesh."""

from __future__ import annotations

import numpy as np

from tissue_sim.experiment.experiment import Experiment
from tissue_sim.experiment.tools.outline import Profile
from tissue_sim.experiment.tools.plate import PLATE_RADIUS, Plate
from tissue_sim.fem.axisymmetric.contact import ContactPair, ContactPairs
from tissue_sim.fem.contact.settings import STICK, TOLERANCES
from tissue_sim.mesh import Mesh

#: Smallest tip radius, over the radius of the contact, with which contact conditions at Gauss points are accurate.
BLUNT = 0.5


def friction_coefficient_or_stick_marker(interface: str | float) -> float:
    """Return the Coulomb coefficient of an interface for tissue that touches the interface during the test.

    Args:
        interface: coefficient of friction, or ``"bonded"``, ``"stick"`` (both give `STICK`: no slip) or
            ``"frictionless"`` (0).
    """
    if not isinstance(interface, str):
        return interface
    return {"bonded": STICK, "stick": STICK, "frictionless": 0.0}[interface]


def build_contact_pairs_or_none(experiment: Experiment, mesh: Mesh, *, tool: bool = True,
                                homogeneous: bool | None = None) -> ContactPairs | None:
    """Return the contact pairs: the base with the lower half of the side, the tool with the rest of the surface.

    Args:
        experiment: specimen, tool, interfaces.
        mesh: mesh of the specimen.
        tool: whether the tool is present; it is absent while the specimen settles under its weight.
        homogeneous: whether the deformation of the specimen is homogeneous; None: as the experiment states.

    Returns:
        Contact pairs; None if no edge may come into contact.
    """
    homogeneous = experiment.has_homogeneous_deformation if homogeneous is None else homogeneous
    low, high = (None, None) if homogeneous else _split_side_edges_at_mid_height(mesh)
    pairs = _make_base_pairs(experiment, mesh, low)
    if tool:
        pairs += (_make_plate_pairs(experiment, mesh, high) if experiment.tool.is_plate
                  else _make_needle_pairs(experiment, mesh))
    if not any(len(pair.edges) for pair in pairs):
        return None
    if experiment.tool.is_plate:
        relative = TOLERANCES.homogeneous if homogeneous else TOLERANCES.plate
        tolerance = relative * experiment.specimen.margin()
    else:
        tolerance = TOLERANCES.needle * experiment.tool.require_radius()
    level = tool and experiment.tool.is_plate
    return ContactPairs(tuple(pairs), tolerance, experiment.acting_laws if tool else (),
                        np.pi * experiment.contact_radius**2, level, experiment.largest_accurate_depth)


def _split_side_edges_at_mid_height(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges of the lower and of the upper half of the side."""
    side = mesh.select_edges_in_node_set("side")
    high = mesh.nodes[side, 1].mean(axis=1) > 0.5 * mesh.nodes[:, 1].min()
    return side[~high], side[high]


def _make_base_pairs(experiment: Experiment, mesh: Mesh, side: np.ndarray | None) -> list[ContactPair]:
    """Return the contact pairs of the tissue with the base plate.

    The side may bulge onto the base. A base with friction also holds the bottom, which stays in contact.
    """
    bottom = mesh.nodes[:, 1].min()
    plane = Profile(np.array([[PLATE_RADIUS, bottom], [0.0, bottom]]), 0.0, 1)
    mu = friction_coefficient_or_stick_marker(experiment.resolved_base_interface)
    pairs = []
    if experiment.resolved_base_interface not in ("bonded", "frictionless"):
        pairs.append(ContactPair(plane, mesh.select_edges_in_node_set("base"), (mu, mu), moves=False, tied=mu == STICK,
                                 stays=True))
    if side is not None:
        pairs.append(ContactPair(plane, side, (mu, mu), moves=False))
    return pairs


def _make_plate_pairs(experiment: Experiment, mesh: Mesh, side: np.ndarray | None) -> list[ContactPair]:
    """Return the contact pairs of a plate profile with mesh edges: the top, unless bonded, and the upper side."""
    profile, mu = experiment.tool.profile, friction_coefficient_or_stick_marker(experiment.friction)
    pairs = []
    if experiment.friction != "bonded":
        pairs.append(ContactPair(profile, mesh.select_edges_in_node_set("top"), (mu, mu), tied=mu == STICK))
    if side is not None:
        pairs.append(ContactPair(profile, side, (mu, mu)))
    return pairs


def _make_needle_pairs(experiment: Experiment, mesh: Mesh) -> list[ContactPair]:
    """Return the contact pairs of the needle and the top; with a bonded face, only the top next to the face."""
    tool = experiment.tool
    profile = tool.profile
    friction = (friction_coefficient_or_stick_marker(experiment.friction),
                friction_coefficient_or_stick_marker(experiment.friction_wall))
    if tool.face_radius == 0:
        blunt = profile.rounding >= BLUNT * experiment.contact_radius and friction[0] != STICK
        return [ContactPair(profile, mesh.select_edges_in_node_set("top"), friction, between_nodes=blunt)]
    face, free = mesh.select_edges_in_node_set("face"), mesh.select_edges_in_node_set("free")
    if experiment.friction == "bonded":
        return [ContactPair(profile, free, friction, first_line=1)]
    # The nodes under a sharp face without friction slide in its plane; its edge has no tangent. Tissue next to a sharp
    # edge cannot come under the face.
    tied, is_plane = friction[0] == STICK, tool.has_sharp_edge and friction[0] == 0.0
    first = 0 if tool.edge_radius else 1
    return [ContactPair(Plate().profile if is_plane else profile, face, friction, tied=tied,
                        between_nodes=not (tied or is_plane)),
            ContactPair(profile, free, friction, first_line=first, between_nodes=not (tied or is_plane))]
