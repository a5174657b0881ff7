"""A reduced solid: what is kept of it, and for which motions of the tool it was made."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.reduced.compliance_table import ContactCompliance
from tissue_sim.fem.solid.tissue import element_layers, require_regions
from tissue_sim.material.effect import PointEffect
from tissue_sim.material.material import Material
from tissue_sim.mesh.solid import SolidMesh
from tissue_sim.model import Model
from tissue_sim.pose import Pose, motion


@dataclass(frozen=True)
class PoseBox:
    """Where a tool may be: its deepest point in a box beside its first touch, its axis within a cone.

    Attributes:
        sideways: from where the experiment's approach begins, along x and y either way, m.
        depth: m.
        turn: from the orientation of the experiment's approach, about any axis, rad.

    Raises:
        InputError: a size that is negative or not finite, or no depth.
    """

    sideways: float
    depth: float
    turn: float = 0.0

    def __post_init__(self):
        for name in ("sideways", "depth", "turn"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError(f"{value:g} is no size of a box of poses; give 0 or more", field=f"box.{name}")
        if not self.depth > 0.0:
            raise InputError("a box without depth holds no contact; give a depth", field="box.depth")

    def holds(self, pose: Pose, start: Pose, slack: float = 1e-6) -> bool:
        """Whether a pose lies in the box of a tool that begins at `start`.

        Args:
            slack: share of the sizes that does not count.
        """
        x, y, z, *turn = motion(start, pose)
        most, little = 1.0 + slack, slack * self.depth
        return (max(abs(x), abs(y)) <= self.sideways * most + little and -little <= -z <= self.depth * most
                and math.hypot(*turn) <= self.turn * most + slack)

    def is_under(self, pose: Pose, start: Pose) -> bool:
        """Whether a pose is over the box of a tool that begins at `start`."""
        (x, y, z), (_, _, top) = pose.position, start.position
        return z > top and self.holds(Pose((x, y, top), pose.orientation), start)


def require_reducible(model: Model) -> None:
    """Refuse what a reduced solid does not take.

    Raises:
        InputError: a plate, a base with friction, laws of contact, effects at the points.
    """
    experiment = model.experiment
    if experiment.tool.is_plate:
        raise InputError("a reduced solid is one under a needle; a plate moves along one line, for which "
                         "the axisymmetric solver is fast enough", field="tool")
    if experiment.base_interface not in ("bonded", "frictionless"):
        raise InputError("a reduced solid stands on a base that is bonded or frictionless; use one of them",
                         field="friction_base")
    if experiment.acting_laws:
        raise InputError("a reduced solid takes no adhesion or other laws of contact yet; leave them out",
                         field="contact_laws")
    require_no_effects(model.material)


def require_no_effects(material: Material) -> None:
    """Raises InputError: effects at the points."""
    if any(isinstance(effect, PointEffect) for effect in material.effects.values()):
        raise InputError("a reduced solid takes no effects that are added at the points; leave them out",
                         field="material.effects")


def require_same_parts(material: Material, made_of: Material, mesh: SolidMesh) -> None:
    """Refuse a material that a reduced solid made of another one cannot be of.

    Raises:
        InputError: effects at the points, layers that lie elsewhere, a region that the mesh does not have.
    """
    require_no_effects(material)
    require_regions(material, mesh)
    stated, kept = ([layer.thickness for layer in each.layers] for each in (material, made_of))
    # A material without layers is the same everywhere.
    if stated and not (len(stated) == len(kept) and np.allclose(stated, kept, rtol=1e-6, atol=0.0)):
        if not kept:
            raise InputError("a reduced solid has the layers that it was made with, and this one has none; leave them "
                             "out, or make another one", field="material.layers")
        layers = " and ".join(f"{1e3 * each:g} mm" for each in kept)
        raise InputError(f"a reduced solid keeps its layers where they are, from the top down {layers}; take these, or "
                         "make another one", field="material.layers")


@dataclass(frozen=True, eq=False)
class Rest:
    """How a solid that weighs stands where nobody touches it.

    Attributes:
        displacement: of the nodes from where they are as moulded, m, shape (freedoms,).
        pressures: amplitudes of the pressure modes of all elements, Pa, shape (elements, pressure modes).
    """

    displacement: np.ndarray
    pressures: np.ndarray


@dataclass(frozen=True, eq=False)
class ReducedModel:
    """A solid in some of its motions and elements, for `ts.Simulator(reduced.model, solver="reduced", mesh=reduced)`.

    Attributes:
        model: experiment and material that it was made of.
        mesh: of the whole solid, as moulded.
        basis: what the modes move from where it stands, m per amplitude, shape (freedoms, modes); after the first
            `lifting` of them what the tool holds stays where it is.
        lifting: modes whose amplitudes the tool's pose says: 12 where it holds tissue, else 0.
        elements: numbers of those that are looked at, shape (n,); shares: how many each stands for.
        box: of poses.
        bulk_ratio: bulk modulus at most, over mu0. What is added up of modes changes its volume a little, which a
            stiffer bulk would make resist; under a softer one the force is too small.
        softness: share of the contact's reach by which the layer between tool and tissue gives way.
        watched: the last so many modes are none that it makes: what is unbalanced on them says how far it is off.
        error_factors: of what the force would change by with what is watched, and of the force itself; their sum
            estimates how far the force is off, as on motions that it was not made of.
        rest: how it stands; None: undeformed, as one that does not weigh.
        compliance: how well the modes represent forces on single nodes (`ContactCompliance`); None of a tool that holds
            tissue, and in files of older versions.
        report: how it was made and how good it is: ``freedoms``, ``modes``, ``elements``, ``snapshots``,
            ``force_rms_error`` and ``force_largest_error`` over the rms force, on motions that it was not made of;
            ``warnings``, sentences about the force of the whole solid, where there are some.
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
    error_factors: tuple[float, float] = (1.0, 0.0)
    rest: Rest | None = None
    compliance: ContactCompliance | None = None

    @property
    def places(self) -> np.ndarray:
        """Of the nodes where nobody touches it, m, shape (nodes, 3)."""
        return self.mesh.nodes if self.rest is None else self.mesh.nodes + self.rest.displacement.reshape(-1, 3)

    @cached_property
    def element_layers(self) -> np.ndarray:
        """Number of the material's layer of each element, see `tissue_sim.fem.solid.tissue.element_layers`: layers are
        as thick as they are stated where the specimen is as high as it is stated."""
        stated, moulded = self.model.experiment.specimen, float(np.ptp(self.mesh.nodes[:, 2]))
        placed = self.rest is not None and stated.height_is == "placed"
        return element_layers(self.mesh.stretched(stated.height / moulded) if placed else self.mesh,
                              self.model.material.layers)

    @property
    def sag(self) -> float:
        """How much lower the top stands, on the mean of its area, than it was moulded, m."""
        if self.rest is None:
            return 0.0
        return -float(np.average(self.rest.displacement[2::3], weights=self.mesh.areas("top")))

    def require_material(self, material: Material) -> None:
        """Refuse a material that it cannot be of.

        Raises:
            InputError: see `require_same_parts`; of a solid that weighs, any other one.
        """
        require_same_parts(material, self.model.material, self.mesh)
        own = self.model.material
        # What it is called, and what does not act here, is another matter.
        alike = replace(material, name=own.name, density=own.density, puncture=own.puncture)
        if self.rest is not None and alike != own:
            raise InputError("a reduced solid that weighs stands as its own material lets it; leave the material as it "
                             "is, or make another one", field="material")
