"""3D solid against closed forms and mesh refinement, on meshes that are too large for a test.

    python -m benchmarks solid_checks [dragged] [turned] [friction] [mindlin] [--fine] [--json]

- `dragged`: one mesh with its circle on the axis; a needle that holds its face is pressed in there and dragged aside,
  to places that are turned about the axis by angles that are no symmetries of the mesh. The force must stay the same,
  and its lateral part point along the radius.
- `turned`: one mesh with its rings about the axis, fine as far as the tool comes; a ball without friction is pressed in
  10 mm off the axis, at places turned in the same way. Here contact begins at other nodes in each of them.
- `friction`: a ball with friction on the axis against the axisymmetric solver, accurate meshes.
- `mindlin`: a ball pressed on a large body and pushed sideways: Hertz, Cattaneo and Mindlin (Johnson, Contact
  Mechanics, 1985, sections 4.2 and 7.2; with nu = 1/2 normal and tangential do not act on each other), gross sliding.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time

import numpy as np

import tissue_sim as ts
from tissue_sim.fem.contact.pairs import ContactPair
from tissue_sim.fem.solid.solver import SolidSolver
from tissue_sim.fem.solver import StepStatus
from tissue_sim.mesh.axisymmetric import divide_into_growing_intervals
from tissue_sim.mesh.solid import (
    SolidMesh,
    create_block_mesh_from_boundaries,
    create_cylinder_mesh,
    create_cylinder_mesh_under_needle,
)
from tissue_sim.mesh.solid_element import HEX27P1
from tissue_sim.pose import Pose

PHANTOM = ts.Material("reduced_polynomial_2", {"C10": 1404.9, "C20": 699.4}, ts.Bulk("bulk_ratio", 1e4))
ANGLES = (0.0, 17.0, 31.0, 45.0)


def stepped(solver: SolidSolver, *poses: Pose) -> np.ndarray:
    """Return the force at the end of a motion, N."""
    for pose in poses:
        step = solver.step(pose, max_iterations=40)
        if step.status is not StepStatus.CONVERGED:
            raise SystemExit(f"at {pose.position}: {step.status.message}")
    return np.array(step.wrench[:3])


def banded_mesh(radius: float, height: float, reach: float, size: float) -> SolidMesh:
    """Return a cylinder with elements of one size within `reach` of the axis and to half of that depth."""
    around = max(2, round(0.25 * 2.0 * math.pi * 0.5 * reach / size))
    inward = np.linspace(0.5, 1.0, round(0.5 * reach / size) + 1)
    outward = divide_into_growing_intervals(radius - reach, 1.5 * size, 2.0, 20 * size)
    depth = divide_into_growing_intervals(height, size, 1.5, 20 * size)
    return create_cylinder_mesh(radius, height, HEX27P1, around=around, inward=inward, outward=outward / outward[-1],
                                z=-depth[::-1], face_radius=reach)


def dragged(mesh: SolidMesh, depth: float, aside: float, angles: tuple[float, ...] = ANGLES) -> dict:
    """Return the forces on a bonded needle, displaced in directions rotated about the axis; see `turned`."""
    solver = SolidSolver(mesh, PHANTOM, {"base": "xyz"}, mesh.sets["face"], start=Pose((0.0, 0.0, 0.0)))
    stepped(solver, Pose((0.0, 0.0, -depth)))
    pressed = solver.save()
    forces = []
    for degrees in angles:
        angle = math.radians(degrees)
        x, y = aside * math.cos(angle), aside * math.sin(angle)
        solver.restore(pressed)
        forces.append(_turned_back(stepped(solver, Pose((x, y, -depth))), angle))
    return _changes(mesh, forces)


def _turned_back(force: np.ndarray, angle: float) -> list[float]:
    """Return the radial, circumferential and vertical components of a force."""
    cosine, sine = math.cos(angle), math.sin(angle)
    return [float(force @ [cosine, sine, 0.0]), float(force @ [-sine, cosine, 0.0]), float(force[2])]


def _changes(mesh: SolidMesh, forces: list[list[float]]) -> dict:
    radial, around, vertical = np.array(forces).T
    return {"freedoms": 3 * len(mesh.nodes), "forces_N": forces,
            "vertical_changes": float(np.ptp(vertical) / vertical.mean()),
            "radial_changes": float(np.ptp(radial) / abs(radial.mean())),
            "around_over_radial": float(abs(around).max() / abs(radial.mean()))}


def turned(mesh: SolidMesh, offset: float, depth: float, radius: float = 8e-3, steps: int = 4,
           angles: tuple[float, ...] = ANGLES) -> dict:
    """Return the forces on a ball at positions rotated about the axis, N: radial, circumferential, vertical."""
    forces = []
    for degrees in angles:
        angle = math.radians(degrees)
        x, y = offset * math.cos(angle), offset * math.sin(angle)
        ball = ContactPair(ts.Tool("sphere", radius=radius).profile, mesh.sets["top"], (0.0, 0.0))
        solver = SolidSolver(mesh, PHANTOM, {"base": "xyz"}, np.zeros(0, int), pairs=[ball], tolerance=1e-4 * radius,
                             start=Pose((x, y, 0.0)))
        force = stepped(solver, *(Pose((x, y, -depth * k / steps)) for k in range(1, steps + 1)))
        forces.append(_turned_back(force, angle))
    return _changes(mesh, forces)


def friction(resolution: str, depth: float, points: int = 6) -> dict:
    """Compare a ball with mu = 0.3 at some depths in 3D and in the axisymmetric section."""
    experiment = ts.Experiment(ts.Specimen(0.04, 0.07), ts.Protocol.ramp(depth, points),
                               tool=ts.Tool("sphere", radius=8e-3), friction=0.3)
    model = ts.Model(experiment, PHANTOM)
    found = ts.simulate(model, solver="solid", resolution=resolution)
    expected = ts.simulate(model, resolution="accurate")
    return {"resolution": resolution, "freedoms": found.metadata["solver"]["mesh"]["freedoms"],
            "depth_mm": (1e3 * found.displacement[1:]).tolist(),
            "error": (found.force[1:] / expected.force[1:] - 1.0).tolist()}


class Mindlin:
    """Ball on half of a large block, symmetric about y = 0, at small strains.

    Args:
        fine: elements on the radius of contact.
        far: size of the block, in radii of contact.
        mu: of friction.
    """

    #: K / mu0, 1.
    RATIO = 1e3
    #: Radius of the ball, m.
    RADIUS = 0.2
    #: Radius of the contact, m.
    CONTACT = 4e-3

    def __init__(self, fine: int = 3, far: float = 60.0, mu: float = 0.3):
        a = self.CONTACT
        size, reach = a / fine, 1.34 * a
        inner = np.linspace(0.0, reach, round(reach / size) + 1)
        outer = reach + divide_into_growing_intervals(far * a - reach, 2.0 * size, 3.0, far * a)[1:]
        half = np.concatenate([inner, outer])
        line = np.concatenate([-half[:0:-1], half])
        down = divide_into_growing_intervals(far * a, size, 3.0, far * a)
        self.mesh = create_block_mesh_from_boundaries(line, half, -down[::-1], HEX27P1)
        self.mesh.sets["mirror"] = np.flatnonzero(np.abs(self.mesh.nodes[:, 1]) < 1e-9 * a)
        self.mu, self.modulus = mu, 2e3
        material = ts.Material("neo_hooke", {"C10": 0.5 * self.modulus}, ts.Bulk("bulk_ratio", self.RATIO))
        top = self.mesh.sets["top"]
        near = top[np.hypot(*self.mesh.nodes[top, :2].T) < reach]
        ball = ContactPair(ts.Tool("sphere", radius=self.RADIUS).profile, near, (mu, mu))
        self.solver = SolidSolver(self.mesh, material, {"base": "xyz", "mirror": "y"}, np.zeros(0, int), pairs=[ball],
                                  tolerance=1e-7 * a, start=Pose((0.0, 0.0, 0.0)))
        # Poisson's ratio of the material, and the plane-strain modulus of the contact.
        self.nu = (3.0 * self.RATIO - 2.0) / (6.0 * self.RATIO + 2.0)
        self.plane = 2.0 * self.modulus / (1.0 - self.nu)

    @property
    def approach(self) -> float:
        """Approach at which the contact radius is `CONTACT`, m (Hertz)."""
        return self.CONTACT**2 / self.RADIUS

    def hertz(self, depth: float) -> float:
        """Return the force on the whole ball, N."""
        return 4.0 / 3.0 * self.plane * math.sqrt(self.RADIUS) * depth**1.5

    def slid(self, tangential: float, normal: float) -> float:
        """Return the lateral displacement under a tangential force below mu times the normal force, m (Mindlin)."""
        share = tangential / (self.mu * normal)
        stiff = 16.0 * self.CONTACT * self.modulus / (3.0 * self.mu * normal * (2.0 - self.nu))
        return (1.0 - (1.0 - share) ** (2.0 / 3.0)) / stiff

    def run(self, press: int = 4, push: tuple[float, ...] = (0.2, 0.4, 0.6, 0.8)) -> dict:
        """Press, then push tangentially up to full slip, and slide on."""
        depths = [self.approach * (k + 1) / press for k in range(press)]
        normal = [2.0 * stepped(self.solver, Pose((0.0, 0.0, -depth)))[2] for depth in depths]
        whole = self.slid(self.mu * normal[-1], normal[-1])
        rows = []
        for share in push:
            x, _, z = 2.0 * stepped(self.solver, Pose((share * whole, 0.0, -depths[-1])))
            rows.append([share * whole, -x, z, self.slid(-x, z)])
        x, _, z = 2.0 * stepped(self.solver, Pose((1.6 * whole, 0.0, -depths[-1])))
        rows = np.array(rows)
        return {"freedoms": 3 * len(self.mesh.nodes), "strain": self.CONTACT / self.RADIUS,
                "hertz_error": [force / self.hertz(depth) - 1.0 for force, depth in zip(normal, depths, strict=True)],
                "normal_changes": float(abs(rows[:, 2] / normal[-1] - 1.0).max()),
                "tangential_over_limit": (rows[:, 1] / (self.mu * rows[:, 2])).tolist(),
                "way_error": (rows[:, 0] / rows[:, 3] - 1.0).tolist(), "sliding_over_mu_normal": -x / (self.mu * z)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checks", nargs="*", default=["dragged", "turned", "friction", "mindlin"])
    parser.add_argument("--fine", action="store_true", help="finer meshes, minutes instead of seconds")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    answers = {}
    for name in asked.checks:
        began = time.perf_counter()
        if name == "dragged":
            answers[name] = dragged(create_cylinder_mesh_under_needle(
                0.04, 0.07, 8e-3, HEX27P1, smallest=2.4e-3, growth=2.2, largest=20e-3, around=4 if asked.fine else 2),
                3e-3, 4e-3)
        elif name == "turned":
            size = 2e-3 if asked.fine else 3e-3
            answers[name] = turned(banded_mesh(0.04, 0.03, 18e-3, size), 10e-3, 4e-3)
        elif name == "friction":
            answers[name] = [friction("accurate" if asked.fine else "fast", 4e-3)]
        else:
            answers[name] = Mindlin(4 if asked.fine else 3).run()
        print(f"{name}: {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
        print(json.dumps({name: answers[name]}, indent=None if asked.json else 1), flush=True)


if __name__ == "__main__":
    main()
