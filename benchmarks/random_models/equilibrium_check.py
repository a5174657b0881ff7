"""Check the equilibria of a simulated test independently of the solver: numpy, and the formula of
the law.

Nodal displacements and pressures of a sample are what the solver says; nodal forces of the body follow from them in
`equilibrium_forces`, and what no force of the body itself balances, a tool or the base must push with. Of a material
with Prony terms the isochoric stress at the Gauss points, which depends on all that was, is taken from the solver's
memory; that of the law in it is compared.

Contact is judged at the nodes of the surface: what the body's forces leave over there, its tool or base pushes with. A
flat or blunt tool on which tissue slips meets the top at two Gauss points of each edge instead: the forces there are
those which give the nodal ones.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

import tissue_sim as ts
from benchmarks.random_models.equilibrium_forces import Section, energy_of, isochoric_stress

#: Relative residual at which the solver accepts an equilibrium, 1.
TOLERANCE = 1e-9
#: Factor by which the check accepts more, 1.
SLACK = 10.0
#: Smallest reference force, as a fraction of the largest force so far, as in the solver.
FLOOR_SHARE = 0.1
#: Smallest reference force, as a fraction of mu0 on the top, as in the solver.
LEAST_STRAIN = 1e-6
#: Accepted distance outside of Coulomb's cone, in largest nodal contact forces.
CONE = 1e-3
#: Accepted error of the force on the tool, in largest forces.
BALANCE = 1e-6
#: Accepted error of the stored stress of the law, in largest stresses.
MEMORY = 1e-9
#: Accepted rounding error, in measured effects of one rounding.
ROUNDINGS = 10.0
#: Largest accepted rounding error, over the reactions: the limit of the solver.
MOST_ROUNDING = 1e-5
#: Tips of at least this radius, in radii of the contact, are blunt.
BLUNT = 0.5
#: Checks, and what their numbers are.
CHECKS = {
    "residual": "unbalanced force of nodes that nothing touches, over the reactions",
    "volume": "force of pressures that are not K (J - 1) in the mean, over the reactions",
    "penetration": "depth of a surface node in the tool or the base, over the tolerance of the recording",
    "afar": "force on a surface node that is farther from both than that, over the largest nodal contact force",
    "pull": "pull of a body that does not hold, over the largest nodal contact force",
    "stick": "the same for an interface without slip that may separate",
    "friction": "tangential force beyond mu times the normal one, over the largest nodal contact force",
    "memory": "stress of the law that the solver's memory has, less that of the formula, over the largest",
    "balance": "sum of the tool's nodal forces less the force of the recording, over its largest force",
}


@dataclass(frozen=True)
class Fault:
    """Failed check of a sample.

    Attributes:
        check: one of `CHECKS`; sample: its number from 0; value: as the check states it; allowed: of it.
        node: the worst one, -1 where it is none in particular.
    """

    check: str
    sample: int
    value: float
    allowed: float
    node: int = -1


@dataclass
class Findings:
    """Results of the checks of all samples.

    Attributes:
        worst: check -> largest value. faults: check -> first sample that fails. failed: numbers of all samples that
            fail a check.
        early: largest residual over the limit from tolerance and observed rounding. Above 1 the iteration ended
            because the solver overestimates rounding, which is not a fault.
    """

    worst: dict[str, float] = field(default_factory=dict)
    early: float = 0.0
    faults: dict[str, Fault] = field(default_factory=dict)
    failed: set[int] = field(default_factory=set)

    def note(self, check: str, sample: int, value: float, allowed: float, node: int = -1) -> None:
        value = float(value)
        self.worst[check] = max(self.worst.get(check, 0.0), value)
        # A NaN must fail the check.
        if not value <= allowed:
            self.faults.setdefault(check, Fault(check, sample, value, float(allowed), int(node)))
            self.failed.add(sample)


@dataclass(frozen=True)
class Outline:
    """Rigid body that surface nodes may touch.

    Attributes:
        vertices: chain of straight lines (r, z), body on its left, m; rounding: thickness around it, m.
        shaft: first line of the shaft; friction: coefficient of face and shaft, infinite where nothing slips.
    """

    vertices: np.ndarray
    rounding: float
    shaft: int
    friction: tuple[float, float]

    def meet(self, points: np.ndarray, near: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return gap (m) of points (n, 2) in the body's frame, outward normal of the body, and coefficient of friction.

        A sharp edge from a face or to a shaft without slip holds what is as `near` as this, m.
        """
        start, way = self.vertices[:-1], np.diff(self.vertices, axis=0)
        length = np.linalg.norm(way, axis=1)
        along = way / length[:, None]
        offset = points[:, None] - start
        passed = (offset * along).sum(axis=-1)
        arrow = offset - np.clip(passed, 0.0, length)[..., None] * along
        normal = np.stack([along[:, 1], -along[:, 0]], axis=-1)
        distance, front = np.linalg.norm(arrow, axis=-1), (arrow * normal).sum(axis=-1)
        # Of two lines that are equally near, at a vertex, that which the point stands farther in front of.
        nearest = np.abs(distance - distance.min(axis=1, keepdims=True)) <= 1e-15
        line = np.argmax(np.where(nearest, np.abs(front), -1.0), axis=1)
        rows = np.arange(len(points))
        outside = (front[rows, line] >= 0) | ((line == 0) & (passed[:, 0] < 0))
        sign = np.where(outside, 1.0, -1.0)
        d, arrow = distance[rows, line], arrow[rows, line]
        beyond = ((passed < 0) | (passed > length))[rows, line] & (d > 0)
        turned = np.where(beyond[:, None], sign[:, None] * arrow / np.where(d > 0, d, 1.0)[:, None], normal[line])
        on_face = beyond | (line < self.shaft)
        friction = np.where(on_face, *self.friction)
        if not self.rounding and 0 < self.shaft < len(way) and np.isinf(self.friction).any():
            at_edge = np.linalg.norm(points - self.vertices[self.shaft], axis=1) <= near
            between = normal[self.shaft - 1] + normal[self.shaft]
            turned[at_edge], friction[at_edge] = between / np.linalg.norm(between), np.inf
        return sign * d - self.rounding, turned, friction


@dataclass(frozen=True)
class _Points:
    """Points of the surface at which the tool may act.

    Attributes:
        numbers: node of each point; for a point between nodes, the middle node of its edge.
        undeformed, now: positions (r, z), m. pushes: forces, N. stays: whether the base fixes the point.
    """

    numbers: np.ndarray
    undeformed: np.ndarray
    now: np.ndarray
    pushes: np.ndarray
    stays: np.ndarray


def _coefficient(interface: str | float) -> float:
    return {"frictionless": 0.0, "stick": np.inf, "bonded": np.inf}[interface] if isinstance(interface, str) \
        else interface


class EquilibriumCheck:
    """Follows a solver through `tissue_sim.simulate(model, watch=...)` and checks each sample; then call `finish`.

    Adhesion, laws of contact or points that were added, softening, pores, tilt and slip in part are not known here.

    Args:
        model: that is simulated; tolerance: unbalanced over balanced nodal forces that was asked of it.

    Attributes:
        found: of all samples so far.
        largest: force so far, N; who knows of larger ones between the samples may say so.
    """

    def __init__(self, model: ts.Model, tolerance: float = TOLERANCE):
        experiment, material = model.experiment, model.material
        if (experiment.acting_laws or experiment.tilt or experiment.slip or material.effects or material.softening
                or material.poroelasticity):
            raise ts.InputError("the check of equilibria knows elastic and viscoelastic tissue under tools that push "
                                "and rub; leave out what else the model has")
        self.model, self.found, self._forces, self.largest = model, Findings(), [], 0.0
        self._slack = SLACK * tolerance
        self._energy = energy_of(material.energy_law, dict(material.parameters))

    def before_first_step(self, solver) -> None:
        """Store body, supports and contact partners of a simulation."""
        model, mesh = self.model, solver.mesh
        experiment, material, specimen = model.experiment, model.material, model.experiment.specimen
        if mesh.element.name != "Q9/P-1":
            raise ts.InputError(f"the check of equilibria knows Q9/P-1, not {mesh.element.name}")
        self.section, self._datum = Section(mesh.nodes, mesh.connectivity), solver.datum
        self._tolerance = solver.get_recording_metadata().get("penetration_tolerance_mm", 0.0) * 1e-3
        depth = -mesh.nodes[mesh.connectivity[:, :4], 1].mean(axis=1)
        depth *= specimen.height / -mesh.nodes[:, 1].min()
        layer = np.searchsorted(np.cumsum([layer.thickness for layer in material.layers]), depth)
        self._ratios = np.array([*(layer.ratio for layer in material.layers), 1.0])[layer][:, None]
        self._held = np.zeros(mesh.nodes.shape, dtype=bool)
        self._held[mesh.sets["axis"], 0] = True
        base = experiment.resolved_base_interface
        self._held[mesh.sets["base"]] |= {"bonded": [True, True], "frictionless": [False, True]}.get(
            base, [False, False])
        self._on_tool = np.zeros(len(mesh.nodes), dtype=bool)
        if experiment.friction == "bonded":
            self._on_tool[mesh.sets["top" if experiment.tool.is_plate else "face"]] = True
            self._held[self._on_tool] = True
        surface = np.unique(np.concatenate([mesh.sets[name] for name in ("top", "side", "base")]))
        self._surface = surface[~self._held[surface].all(axis=1)]
        self._edges = np.zeros((0, 3), dtype=int)
        blunt = experiment.tool.face_radius or experiment.tool.profile.rounding >= BLUNT * experiment.contact_radius
        if not experiment.tool.is_plate and blunt and experiment.friction not in ("bonded", "stick"):
            self._edges = mesh.select_edges_in_node_set("top")
            self._surface = np.setdiff1d(self._surface, mesh.sets["top"])
        self._stays = np.isin(self._surface, mesh.sets["base"])
        profile = experiment.tool.profile
        self._tool = Outline(profile.vertices, profile.rounding, profile.shaft,
                             (_coefficient(experiment.friction), _coefficient(experiment.friction_wall)))
        self._base = _coefficient(base)
        self._bottom = float(mesh.nodes[:, 1].min())
        # A plate meets a top that settled unevenly all at once.
        self._lift = np.zeros(len(mesh.nodes))
        if experiment.tool.is_plate:
            top, start = mesh.sets["top"], solver.state[: mesh.nodes.size].reshape(-1, 2)
            order = top[np.argsort(mesh.nodes[top, 0])]
            self._lift = np.interp(mesh.nodes[:, 0], mesh.nodes[order, 0],
                                   mesh.nodes[order, 1] + start[order, 1] - self._datum)
        self._floor = LEAST_STRAIN * material.mu0 * np.pi * mesh.nodes[mesh.sets["top"], 0].max() ** 2

    def after_sample(self, solver, factor: float) -> None:
        """Check a sample."""
        memory, stresses, law = solver.equations.memory, None, None
        if self.model.material.viscoelastic is not None:
            ratio = self.model.material.instantaneous_over_law_modulus_ratio
            stresses, law = memory.compute_committed_stress_with_relaxation(), memory.stresses / ratio
        *_, rounding = solver.equations.settings[:7].tolist()
        self.check(solver.state, solver.depth, rounding, stresses, law)

    def check(self, state: np.ndarray, depth: float, rounding: float = 0.0, stresses: np.ndarray | None = None,
              law: np.ndarray | None = None) -> None:
        """Check a state as the next sample.

        Args:
            state: nodal displacements, m, then pressure amplitudes.
            depth: of the tool below where it first touches, m.
            rounding: unbalanced force that the solver takes for rounding, N.
            stresses: isochoric second Piola stress at the Gauss points (RR, RZ, ZZ, hoop), Pa, of a material with a
                memory; law: what the law alone says there.
        """
        section, sample, note = self.section, len(self._forces), self.found.note
        u = state[: section.nodes.size].reshape(-1, 2)
        elements = len(section.connectivity)
        pressures = state[u.size: u.size + 3 * elements].reshape(elements, 3)
        force, seen, volume = self._body(u, pressures, stresses, law)
        # What nothing in the body balances; weight pulls down.
        push = force.copy()
        push[:, 1] += self.model.experiment.specimen.specific_weight * section.volumes
        open_ = ~self._held
        points, inside = self._points(u, np.where(open_, push, 0.0))
        gap, normal, friction, by_tool = self._meet(points, depth)
        pushes, touches = points.pushes, gap <= self._tolerance
        largest = np.linalg.norm(pushes[touches], axis=1).max(initial=0.0)
        tool_force = -float(push[self._on_tool, 1].sum() + pushes[by_tool & ~self._on_tool[points.numbers], 1].sum())
        self._forces.append(tool_force)
        self.largest = max(self.largest, abs(tool_force))
        reactions = np.hypot(np.linalg.norm(push[self._held]), np.linalg.norm(pushes[touches]))
        scale = max(reactions, self._floor, FLOOR_SHARE * self.largest)
        tight = self._slack * scale + ROUNDINGS * seen
        # The solver allows for no more than this of it.
        allowed = max(tight, self._slack * scale + min(rounding, MOST_ROUNDING * scale))
        unbalanced = float(np.linalg.norm(inside))
        self.found.early = max(self.found.early, unbalanced / tight)
        note("residual", sample, unbalanced / scale, allowed / scale, np.argmax(np.abs(inside).max(axis=1)))
        # The solver sees the residual with these forces in it; where both are as small as allowed, they are.
        note("volume", sample, np.linalg.norm(volume[open_]) / scale, 2.0 * allowed / scale)
        if points.numbers.size:
            self._surface_checks(sample, points, gap, normal, friction, touches, allowed, max(largest, 1e-3 * scale))

    def _body(self, u: np.ndarray, pressures: np.ndarray, stresses, law) -> tuple[np.ndarray, ...]:
        """Return the nodal forces, their rounding error (N), and those of pressures outside the pressure space."""
        section, sample = self.section, len(self._forces)

        def volume_forces(cofactors, amplitudes):
            p = np.einsum("eqm,em->eq", section.modes, amplitudes)
            return section.forces(p[..., None, None] * cofactors[0], p * cofactors[1])

        def kinematics(u):
            plane, hoop, J = section.deformation(u)
            cofactor = np.stack([plane[..., 1, 1], -plane[..., 1, 0], -plane[..., 0, 1], plane[..., 0, 0]], axis=-1)
            cofactors = cofactor.reshape(plane.shape) * hoop[..., None, None], J / hoop
            amplitudes = self.model.material.bulk_modulus * self._ratios * np.einsum(
                "eq,eqm,eq->em", section.weights, section.modes, J - 1.0)
            return plane, hoop, cofactors, amplitudes

        plane, hoop, cofactors, slaved = kinematics(u)
        P, Ph = isochoric_stress(self._energy, plane, hoop)
        if stresses is not None:
            own = np.linalg.solve(plane, P)
            own = np.stack([own[..., 0, 0], own[..., 0, 1], own[..., 1, 1], Ph / hoop], axis=-1)
            largest = max(float(np.abs(own).max()), LEAST_STRAIN * self.model.material.mu0)
            self.found.note("memory", sample, np.abs(own - law).max() / largest, MEMORY)
            P = plane @ stresses[..., [[0, 1], [1, 2]]]
            Ph = hoop * stresses[..., 3]
        force, whole = section.forces(self._ratios[..., None, None] * P, self._ratios * Ph)
        by_pressure, more = volume_forces(cofactors, pressures)
        # Displacements are rounded, and K makes forces of it: seen once, with digits that are drawn.
        digits = np.finfo(float).eps * np.random.default_rng(0).uniform(-1.0, 1.0, u.shape)
        _, _, _, other = kinematics(u * (1.0 + digits))
        by_rounding, _ = volume_forces(cofactors, other - slaved)
        rounding = np.linalg.norm(by_rounding) + np.finfo(float).eps * np.linalg.norm(whole + more)
        displaced, _ = volume_forces(cofactors, slaved - pressures)
        return force + by_pressure, float(rounding), displaced

    def _points(self, u: np.ndarray, push: np.ndarray) -> tuple[_Points, np.ndarray]:
        """Return the points of the surface with their forces, and the remaining nodal forces, N."""
        nodes, surface, rest = self.section.nodes, self._surface, push.copy()
        rest[surface] = 0.0
        shapes = np.array([[x * (x - 1) / 2, 1 - x * x, x * (x + 1) / 2] for x in (-(3**-0.5), 3**-0.5)])
        between = np.repeat(self._edges, 2, axis=0)
        spread = np.zeros((len(nodes), len(between)))
        for k, (edge, shape) in enumerate(zip(between, np.tile(shapes, (len(self._edges), 1)), strict=True)):
            spread[edge, k] = shape
        pushed = np.zeros((len(between), 2))
        for component in range(2):
            # Radial forces on the axis are reactions of the symmetry condition.
            own = np.intersect1d(between, np.flatnonzero(~self._held[:, component]))
            pushed[:, component], *_ = np.linalg.lstsq(spread[own], push[own, component], rcond=None)
            rest[own, component] -= spread[own] @ pushed[:, component]
        return _Points(np.concatenate([surface, between[:, 1]]), np.concatenate([nodes[surface], spread.T @ nodes]),
                       np.concatenate([nodes[surface] + u[surface], spread.T @ (nodes + u)]),
                       np.concatenate([push[surface], pushed]),
                       np.concatenate([self._stays, np.zeros(len(between), dtype=bool)])), rest

    def _meet(self, points: _Points, depth: float) -> tuple[np.ndarray, ...]:
        """Return gap, normal and friction of each point with the nearest body, and whether it is the tool."""
        down = self._datum + self._lift[points.numbers] - depth
        gap, normal, friction = self._tool.meet(points.now - np.stack([np.zeros_like(down), down], axis=-1),
                                                self._tolerance)
        normal[points.undeformed[:, 0] == 0.0] = [0.0, -1.0]
        height = points.now[:, 1] - self._bottom
        by_tool = (gap < height) & ~points.stays
        return (np.where(by_tool, gap, height), np.where(by_tool[:, None], normal, [0.0, 1.0]),
                np.where(by_tool, friction, self._base), by_tool)

    def _surface_checks(self, sample, points, gap, normal, friction, touches, allowed, largest) -> None:
        """Contact conditions: no penetration, pressure only in contact, no adhesion, Coulomb friction.

        `largest` is the largest nodal contact force or, where nothing is pressed, what counts as nothing, N.
        """
        nodes, pushes, stays, note = points.numbers, points.pushes, points.stays, self.found.note
        tangential = np.abs(pushes[:, 0] * -normal[:, 1] + pushes[:, 1] * normal[:, 0])
        along = (pushes * normal).sum(axis=1)
        # A base keeps the tissue on itself.
        inside = np.where(stays, np.abs(gap), -gap)
        worst = np.argmax(inside)
        if self._tolerance:
            note("penetration", sample, max(inside[worst], 0.0) / self._tolerance, 1.0, nodes[worst])
        little = allowed / largest

        def worst_of(check, values, among, limit):
            values = np.where(among, values, 0.0)
            worst = int(np.argmax(values))
            note(check, sample, max(values[worst], 0.0) / largest, limit, nodes[worst])

        worst_of("afar", np.linalg.norm(pushes, axis=1), ~touches, little)
        slips = np.isfinite(friction)
        worst_of("pull", -along, touches & ~stays & slips, little)
        # A node on the axis stands for no area: of a pressure that grows outwards its share is a pull.
        off_axis = points.undeformed[:, 0] > 0.0
        worst_of("stick", -along, touches & ~stays & ~slips & off_axis, little)
        beyond = tangential - np.where(slips, friction, 0.0) * np.maximum(along, 0.0)
        worst_of("friction", beyond, touches & slips & (friction > 0), CONE + little)
        worst_of("friction", beyond, touches & slips & (friction == 0), little)

    def finish(self, recording: ts.Recording) -> Findings:
        """Compare the forces of an ideal rig, and return the results of all samples."""
        if self.model.rig == ts.Rig():
            largest = max(float(np.abs(recording.force).max(initial=0.0)), self._floor)
            for sample, (ours, theirs) in enumerate(zip(self._forces, recording.force.tolist(), strict=True)):
                self.found.note("balance", sample, abs(ours - theirs) / largest, BALANCE)
        return self.found
