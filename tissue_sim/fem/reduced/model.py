"""Reduced model of a solid: modes, sampled elements, and the box of tool poses for which the model is valid.

The table of the compliance of the contact nodes belongs to the estimate of the error by missing compliance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.solid.tissue import find_element_layer_indices, require_mesh_regions
from tissue_sim.material.effect import PointEffect
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.model import Model
from tissue_sim.pose import Pose, compute_rigid_motion
from tissue_sim.public_names import OldName, with_old_names


@dataclass(frozen=True, eq=False)
class ContactNodeComplianceTable:
    """Compliance matrices of the contact nodes along the axis of the tool, for the undeformed or resting solid.

    Attributes:
        nodes: node numbers, shape (n,).
        axis: axis of the tool at its start, unit vector, shape (3,).
        whole: compliance G of the full-order solid, m/N, shape (n, n).
        missing: compliance G - G_r that the reduced solid lacks, m/N, shape (n, n).
        forces: forces on the tool, N, ascending from 0, shape (k,).
        accepted: missing force (`MissingComplianceErrorEstimator`) up to which the training paths showed no error of
            the force on the tool, at each of `forces`, N, shape (k,).
    """

    nodes: np.ndarray
    axis: np.ndarray
    whole: np.ndarray
    missing: np.ndarray
    forces: np.ndarray
    accepted: np.ndarray

    @property
    def unlimited_acceptance_copy(self) -> ContactNodeComplianceTable:
        """Copy of the table with infinite accepted missing force, so that the error by missing compliance is 0."""
        return replace(self, forces=np.zeros(1), accepted=np.full(1, np.inf))

    def get_accepted_missing_force_at_tool_force(self, force: float) -> float:
        """Interpolate the accepted missing force, N, for a force on the tool, N; beyond the table in proportion."""
        last = float(self.forces[-1])
        if force > last > 0.0:
            return float(self.accepted[-1]) * force / last
        return float(np.interp(force, self.forces, self.accepted))


def calibrate_accepted_missing_forces(table: ContactNodeComplianceTable, forces: Sequence[float],
                                      missing: Sequence[float],
                                      errors: Sequence[float]) -> ContactNodeComplianceTable:
    """Return a copy of a table with accepted missing forces from states whose true force error is known.

    In each state the accepted missing force is max(0, missing force - true error). The value at a force F is the
    larger of the largest accepted value at forces below F and F times the largest accepted fraction at forces above F:
    the fraction falls as more nodes touch.

    Args:
        table: table of the reduced solid.
        forces: force on the tool in each state, N.
        missing: missing force in each state, N.
        errors: true error of the force in each state, N.
    """
    order = np.argsort(forces)
    force, accepted = np.asarray(forces)[order], np.maximum(0.0, np.asarray(missing) - np.asarray(errors))[order]
    fraction = np.divide(accepted, force, out=np.zeros_like(accepted), where=force > 0.0)
    of_larger = force * np.maximum.accumulate(fraction[::-1])[::-1]
    accepted = np.maximum(np.maximum.accumulate(accepted), of_larger)
    return replace(table, forces=np.concatenate([[0.0], force]), accepted=np.concatenate([[0.0], accepted]))


#: Factors of the error estimate, see `ReducedModel.error_factors`.
ErrorFactors = tuple[float, float, float]


@dataclass(frozen=True)
class PoseBox:
    """Range of the tool poses of a reduced model: a box for the deepest point, and a largest rotation.

    Attributes:
        sideways: largest distance along x and along y from the start of the experiment's approach, m.
        depth: largest depth below the start, m.
        turn: largest rotation about any axis from the orientation of the experiment's approach, rad.

    Raises:
        InputError: a size is negative or not finite, or the depth is 0.
    """

    sideways: float
    depth: float
    turn: float = 0.0

    holds = OldName("contains_pose")

    def __post_init__(self):
        for name in ("sideways", "depth", "turn"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError(f"must be finite and at least 0; got {value:g}", field=f"box.{name}")
        if not self.depth > 0.0:
            raise InputError(f"must be positive; got {self.depth:g}. A box without depth contains no contact",
                             field="box.depth")

    def contains_pose(self, pose: Pose, start: Pose, slack: float = 1e-6) -> bool:
        """Whether a pose is inside the box, which is relative to the pose `start`.

        Args:
            pose: pose of the tool.
            start: start of the experiment's approach.
            slack: tolerance as a fraction of the sizes.
        """
        x, y, z, *turn = compute_rigid_motion(start, pose)
        most, little = 1.0 + slack, slack * self.depth
        return (max(abs(x), abs(y)) <= self.sideways * most + little and -little <= -z <= self.depth * most
                and math.hypot(*turn) <= self.turn * most + slack)

    def has_pose_above(self, pose: Pose, start: Pose) -> bool:
        """Whether a pose is above the top of the box at `start`, and inside the box if lowered to its top."""
        (x, y, z), (_, _, top) = pose.position, start.position
        return z > top and self.contains_pose(Pose((x, y, top), pose.orientation), start)


def require_reducible(model: Model) -> None:
    """Check that a model is one that a reduced solid supports.

    Raises:
        InputError: the tool is a plate or has a sharp face without friction, the base has friction, or there are
            contact laws, point effects or a compressible law.
    """
    experiment = model.experiment
    if experiment.tool.is_plate:
        raise InputError("a reduced solid requires a needle; the tool is a plate. Use the axisymmetric solver, which "
                         "is fast enough for a plate", field="tool")
    if experiment.resolved_base_interface not in ("bonded", "frictionless"):
        raise InputError("a reduced solid requires a bonded or frictionless base. Use 'bonded' or 'frictionless'",
                         field="friction_base")
    if experiment.largest_accurate_depth < math.inf:
        raise InputError("must be positive for a reduced solid without friction. Give the tool an edge radius, or use "
                         'the solver "solid"', field="tool.edge_radius")
    if experiment.acting_laws:
        raise InputError("a reduced solid does not support adhesion or other contact laws. Leave them out",
                         field="contact_laws")
    if any(each.bulk.kind == "of_law" for each in (model.material, *model.material.regions.values())):
        raise InputError("must not have a compressible law in a reduced solid, which has no elements without pressure. "
                         "Use the solver \"solid\", or a law with a bulk response", field="material.law")
    require_no_point_effects(model.material)


def require_no_point_effects(material: Material) -> None:
    """Check that a material has no point effects.

    Raises:
        InputError: the material has point effects.
    """
    names = [name for name, effect in material.effects.items() if isinstance(effect, PointEffect)]
    if names:
        raise InputError("a reduced solid does not support effects at quadrature points; got "
                         f"{', '.join(names)}. Leave them out", field="material.effects")


def require_compatible_layers_and_regions(material: Material, made_of: Material, mesh: SolidMesh) -> None:
    """Check that a material has the layers and regions of the material for which a solid was reduced.

    Args:
        material: material to be checked.
        made_of: material of the training.
        mesh: mesh of the reduced solid.

    Raises:
        InputError: the material has point effects, other layer thicknesses, or a region that the mesh does not have.
    """
    require_no_point_effects(material)
    require_mesh_regions(material, mesh)
    stated, kept = ([layer.thickness for layer in each.layers] for each in (material, made_of))
    # A material without layers is uniform and always fits.
    if stated and not (len(stated) == len(kept) and np.allclose(stated, kept, rtol=1e-6, atol=0.0)):
        if not kept:
            raise InputError("must be empty, because the reduced solid has no layers. Leave the layers out, or reduce "
                             "a model with layers", field="material.layers")
        layers = " and ".join(f"{1e3 * each:g} mm" for each in kept)
        raise InputError(f"must have the thicknesses of the reduced solid, from the top down {layers}. Use these, or "
                         "reduce the model again", field="material.layers")


@dataclass(frozen=True, eq=False)
class SelfWeightEquilibriumFields:
    """Equilibrium of a solid under self-weight without contact.

    Attributes:
        displacement: nodal displacements from the moulded shape, m, shape (freedoms,).
        pressures: amplitudes of the pressure modes of all elements, Pa, shape (elements, pressure modes).
    """

    displacement: np.ndarray
    pressures: np.ndarray


@dataclass(frozen=True, eq=False)
class TrainingDisplacementsAndWrenches:
    """Full-order states on a training path.

    Attributes:
        displacements: nodal displacements from rest at each pose, m, shape (poses, freedoms).
        wrenches: wrench on the tool at each pose, N and N m, shape (poses, 6).
        doubts: warnings of the solver (`Solver.warnings`) at the largest force; not stored in files.
    """

    displacements: np.ndarray
    wrenches: np.ndarray
    doubts: Sequence[str] = ()


@with_old_names(require_material="require_supported_material")
@dataclass(frozen=True, eq=False)
class ReducedModel:
    """Reduced solid: modes and sampled elements, for `ts.Simulator(reduced.model, solver="reduced", mesh=reduced)`.

    Attributes:
        model: experiment and material of the training.
        mesh: mesh of the full-order solid in its moulded shape.
        basis: nodal displacements of the modes from rest, m per amplitude, shape (freedoms, modes). Only the first
            `lifting` modes move the nodes of a bonded face.
        lifting: number of modes prescribed by the pose of the tool: 12 for a bonded tool, else 0.
        elements: numbers of the sampled elements, shape (n,).
        shares: weights of the sampled elements, shape (n,).
        box: box of the tool poses.
        bulk_ratio: upper limit of the bulk modulus over mu0. Combinations of modes change the volume slightly; a larger
            limit makes this change too stiff, a smaller limit makes the tissue too soft.
        softness: thickness of the contact layer over the contact radius.
        watched: number of error modes, the last ones. They are no unknowns; their residual estimates the error.
        error_factors: factors of the force change by the error modes, of the force itself, and of the largest lateral
            force of a tool with friction since its first touch. The sum of the three products is the estimated error of
            the force, calibrated on test paths.
        rest: equilibrium under self-weight; None: undeformed.
        compliance: compliance table of the contact nodes for the error estimate; None for a bonded tool and in files of
            older versions.
        report: sizes and accuracy: ``freedoms``, ``modes``, ``elements``, ``snapshots``, ``force_rms_error`` and
            ``force_largest_error`` over the rms force on test paths, and ``warnings`` of the full-order solver if any.
    """

    model: Model
    mesh: SolidMesh
    basis: np.ndarray
    lifting: int
    elements: np.ndarray
    shares: np.ndarray
    box: PoseBox
    softness: float
    bulk_ratio: float
    report: dict[str, Any] = field(default_factory=dict)
    watched: int = 0
    error_factors: ErrorFactors = (1.0, 0.0, 0.0)
    rest: SelfWeightEquilibriumFields | None = None
    compliance: ContactNodeComplianceTable | None = None

    @property
    def rest_positions(self) -> np.ndarray:
        """Positions of the nodes at rest under self-weight without contact, m, shape (nodes, 3)."""
        return self.mesh.nodes if self.rest is None else self.mesh.nodes + self.rest.displacement.reshape(-1, 3)

    @cached_property
    def element_layers(self) -> np.ndarray:
        """Number of the material's layer of each element, see `tissue_sim.fem.solid.tissue.find_element_layer_indices`.

        The stated layer thicknesses refer to the stated height of the specimen (moulded or placed).
        """
        stated, moulded = self.model.experiment.specimen, float(np.ptp(self.mesh.nodes[:, 2]))
        placed = self.rest is not None and stated.height_is == "placed"
        return find_element_layer_indices(self.mesh.scale_height(stated.height / moulded) if placed else self.mesh,
                                          self.model.material.layers)

    @property
    def sag(self) -> float:
        """Mean downward displacement of the top under self-weight, m."""
        if self.rest is None:
            return 0.0
        return -float(np.average(self.rest.displacement[2::3],
                                 weights=self.mesh.compute_node_areas_of_named_faces("top")))

    def require_supported_material(self, material: Material) -> None:
        """Check that the reduced solid supports a material.

        Raises:
            InputError: see `require_compatible_layers_and_regions`; under self-weight, the material differs from that
                of the training.
        """
        require_compatible_layers_and_regions(material, self.model.material, self.mesh)
        own = self.model.material
        # The name and the properties that have no effect here may differ.
        alike = replace(material, name=own.name, density=own.density, puncture=own.puncture)
        if self.rest is not None and alike != own:
            raise InputError("must equal the material of the training, because self-weight deforms the reduced solid. "
                             "Use this material, or reduce the model again", field="material")
