"""Bonded punch in Newton's soft body, `SolverVBD` on the CPU.

The energy density of Newton's linear tetrahedra is ``W = mu / 2 (I1 - 3) + L / 2 (J - a)^2``, ``L = lambda + mu``,
``a = 1 + mu / L`` (Smith, De Goes, Kim 2018, without the logarithm). Nodes of the face and of the base are particles of
zero mass, whose positions are prescribed: there is no stiffness of a contact. Forces are computed from the positions in
double precision.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

if TYPE_CHECKING:
    import newton

#: Time step, s. The steps are implicit, so that long steps come to rest.
STEP = 0.02
#: Iterations of block descent per step.
ITERATIONS = 10
#: Damping of the elasticity, Pa s.
DAMPING = 100.0
#: Density, kg/m3.
DENSITY = 1000.0
#: Largest speed that counts as rest, m/s.
REST = 1e-5
#: Largest difference of the forces on face and base at rest, relative to the force on the base.
BALANCE = 1e-3
#: Number of steps between two tests for rest.
TEST_INTERVAL = 10


def compute_nodal_forces(nodes: np.ndarray, tetrahedra: np.ndarray, positions: np.ndarray, mu: float,
                         lame: float) -> np.ndarray:
    """Return the derivative of the elastic energy with respect to the positions, N, shape (nodes, 3)."""
    rest, edges = (np.swapaxes(each[tetrahedra[:, 1:]] - each[tetrahedra[:, :1]], 1, 2) for each in (nodes, positions))
    inverse = np.linalg.inv(rest)
    gradient = edges @ inverse
    cofactor = np.stack([np.cross(gradient[:, :, (axis + 1) % 3], gradient[:, :, (axis + 2) % 3])
                         for axis in range(3)], axis=2)
    pressure = (lame + mu) * (np.linalg.det(gradient) - 1.0) - mu
    stress = mu * gradient + pressure[:, None, None] * cofactor
    shares = (np.linalg.det(rest) / 6.0)[:, None, None] * stress @ np.swapaxes(inverse, 1, 2)
    forces = np.zeros_like(positions)
    for corner in range(3):
        np.add.at(forces, tetrahedra[:, corner + 1], shares[:, :, corner])
    np.add.at(forces, tetrahedra[:, 0], -shares.sum(axis=2))
    return forces


def make_solver(job: dict, mu: float, lame: float) -> newton.solvers.SolverVBD:
    """Return the solver of a cylinder whose base and face have prescribed positions."""
    wp.config.quiet = True  # before Newton is imported, which prints otherwise
    import newton

    builder = newton.ModelBuilder(gravity=(0.0, 0.0, 0.0))
    builder.add_soft_mesh(pos=wp.vec3(0.0, 0.0, 0.0), rot=wp.quat_identity(), scale=1.0, vel=wp.vec3(0.0, 0.0, 0.0),
                          vertices=[wp.vec3(*node) for node in job["nodes"].tolist()],
                          indices=job["tetrahedra"].ravel().tolist(), density=DENSITY, k_mu=mu, k_lambda=lame,
                          k_damp=DAMPING, add_surface_mesh_edges=False)
    for node in [*job["base"], *job["face"]]:
        builder.particle_mass[node] = 0.0
    builder.color()
    return newton.solvers.SolverVBD(builder.finalize(device="cpu"), iterations=ITERATIONS)


def pressed(job: dict) -> dict:
    """Return forces at the depths up to the first that is not reached, and the cost of a step.

    Args:
        job: as in `solid_peers_mujoco`.
    """
    young, poisson, nodes, face = job["young"], job["poisson"], job["nodes"], job["face"]
    mu, lame = 0.5 * young / (1.0 + poisson), young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
    solver = make_solver(job, mu, lame)
    state, after, control, rows = solver.model.state(), solver.model.state(), solver.model.control(), []
    solver.step(state, after, control, None, STEP)  # compiles the kernels
    free = np.setdiff1d(np.arange(len(nodes)), [*job["base"], *face])
    for depth in job["depths"]:
        positions = state.particle_q.numpy()
        positions[face] = nodes[face] - [0.0, 0.0, depth]
        state.particle_q.assign(positions)
        began, spent, steps, is_at_rest = time.perf_counter(), 0.0, 0, False
        while not is_at_rest and time.perf_counter() - began < job["seconds"]:
            started = time.process_time()
            for _ in range(TEST_INTERVAL):
                solver.step(state, after, control, None, STEP)
                state, after = after, state
            spent, steps = spent + time.process_time() - started, steps + TEST_INTERVAL
            forces = compute_nodal_forces(nodes, job["tetrahedra"], state.particle_q.numpy().astype(float), mu, lame)
            on_face, on_base = -forces[face, 2].sum(), forces[job["base"], 2].sum()
            speed = np.abs(state.particle_qd.numpy()[free]).max()
            is_at_rest = speed < REST and abs(on_face - on_base) < BALANCE * abs(on_base)
        if not is_at_rest:
            return {"freedoms": 3 * len(free), "rows": rows,
                    "ended": f"not at rest after {steps} steps at {1e3 * depth:g} mm, {speed:.2g} m/s"}
        rows.append({"depth": float(depth), "force": float(on_base), "steps": steps, "step_cpu_s": spent / steps})
    return {"freedoms": 3 * len(free), "rows": rows, "ended": ""}
