"""A solver in one file: a spring with a full 6 x 6 stiffness matrix between the tool and a slider.

The wrench is minus the stiffness matrix times the rigid motion of the tool relative to the slider. If the lateral force
would exceed the limit of the slider, the slider moves laterally until the force equals the limit. The solver has fields
on a block of tissue around the spring, and exact derivatives of the wrench with respect to material parameters.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.fem.result_views import SolidGeometry, SolidSurface
from tissue_sim.fem.solver import Solver, Step, StepStatus
from tissue_sim.material.material import Material
from tissue_sim.pose import Pose, compute_rigid_motion

#: Stiffness matrix at the shear modulus REFERENCE, N/m, N, N m; symmetric, positive definite, without zeros.
STIFFNESS = np.diag([300.0, 250.0, 400.0, 0.02, 0.03, 0.01]) + 0.002 * np.add.outer(np.arange(6), np.arange(6))
#: Initial shear modulus, Pa, of `STIFFNESS`; the stiffness is proportional to the shear modulus.
REFERENCE = 3000.0
#: Largest lateral force of the slider, N.
LIMIT = 0.5
#: Pose of the tool at its first touch.
TOUCH = Pose((0.0, 0.0, 0.0))
#: Half width of the drawn block, m; its diagonal fits into the specimen of the tests, a cylinder of radius 40 mm.
HALF_WIDTH = 0.028
#: Height of the drawn block, m; that of the specimen of the tests.
HEIGHT = 0.07
#: Distance from the axis at which the displacement of the block has decreased to 1/e, m.
DECAY = 0.012


def make_block() -> SolidGeometry:
    """Divide the block into six tetrahedra for each cell of a grid."""
    line = HALF_WIDTH * np.array([-1, -0.7, -0.5, -0.35, -0.25, -0.15, -0.05, 0.05, 0.15, 0.25, 0.35, 0.5, 0.7, 1])
    depth = -HEIGHT * np.array([1, 0.8, 0.6, 0.45, 0.3, 0.2, 0.1, 0])
    nodes = np.stack(np.meshgrid(line, line, depth, indexing="ij"), axis=-1).reshape(-1, 3)
    number = np.arange(len(nodes)).reshape(line.size, line.size, depth.size)
    # The corners of a tetrahedron are a path from corner 000 of the cell to corner 111 along the axes in one order.
    cells = []
    for order in permutations(range(3)):
        corners = np.cumsum([np.zeros(3, int), *np.eye(3, dtype=int)[list(order)]], axis=0)
        cells.append(np.stack([number[i : i + line.size - 1, j : j + line.size - 1, k : k + depth.size - 1].ravel()
                               for i, j, k in corners], axis=-1))
    tetrahedra = np.concatenate(cells)
    edges = nodes[tetrahedra[:, 1:]] - nodes[tetrahedra[:, :1]]
    negative = np.linalg.det(edges) < 0.0
    tetrahedra[negative] = tetrahedra[negative][:, [0, 2, 1, 3]]
    return SolidGeometry.from_tetrahedra(nodes, tetrahedra, top=np.flatnonzero(nodes[:, 2] == 0.0))


#: The drawn block.
BLOCK = make_block()
#: Volumes of its tetrahedra, m3, shape (tetrahedra, 1).
VOLUMES = np.linalg.det(BLOCK.nodes[BLOCK.cells[:, 1:]] - BLOCK.nodes[BLOCK.cells[:, :1]])[:, None] / 6.0


@dataclass(frozen=True)
class SpringState:
    """State of the solver after a step.

    Attributes:
        pose: pose of the tool.
        slid: displacement of the slider along x and y, m.
        slid_rates: derivatives of `slid` with respect to the material parameters, shape (parameters, 2).
    """

    pose: Pose = TOUCH
    slid: tuple[float, float] = (0.0, 0.0)
    slid_rates: tuple[tuple[float, float], ...] = ()


def wrench(pose: Pose, slid, stiffness=STIFFNESS) -> np.ndarray:
    """Return the wrench on the tool, N and N m, shape (6,)."""
    return -stiffness @ compute_extension(pose, slid)


def compute_extension(pose: Pose, slid) -> np.ndarray:
    """Return the rigid motion of the tool from its first touch relative to the slider, m and rad, shape (6,)."""
    extension = np.array(compute_rigid_motion(TOUCH, pose))
    extension[:2] -= slid
    return extension


def compute_displacement(state: SpringState) -> np.ndarray:
    """Return the displacement of the block, m, shape (nodes, 3): that of the spring, zero at the base and far away."""
    r, z = np.hypot(BLOCK.nodes[:, 0], BLOCK.nodes[:, 1]), BLOCK.nodes[:, 2]
    return np.outer(np.exp(-((r / DECAY) ** 2)) * (1.0 + z / HEIGHT), compute_extension(state.pose, state.slid)[:3])


@dataclass(frozen=True, eq=False)
class SpringFields:
    """Fields of the block; see `tissue_sim.fem.result_views.DrawableFields`.

    Attributes:
        material: material of the tissue.
        displacements: displacements of the nodes, m, shape (samples, nodes, 3).
        energies: energy of the spring, J, shape (samples,).
    """

    material: Material
    displacements: np.ndarray
    energies: np.ndarray
    mesh = None
    datum = 0.0
    names = ("displacement", "energy")
    weights = VOLUMES

    def geometry(self):
        return BLOCK

    def displacement(self, sample: int = -1):
        return self.displacements[sample]

    def at_nodes(self, name: str, sample: int = -1, at_points=None):
        square = (self.displacement(sample) ** 2).sum(axis=1)
        if name == "displacement":
            return np.sqrt(square)
        # The integral of the linear interpolant over the block is the energy of the spring.
        integral = float((VOLUMES[:, 0] * square[BLOCK.cells].mean(axis=1)).sum())
        return self.energies[sample] * square / integral if integral else square

    def at_points(self, name: str, sample: int = -1):
        return self.at_nodes(name, sample)[BLOCK.cells].mean(axis=1, keepdims=True)

    def stretch_range(self, sample: int = -1):
        before, after = (np.moveaxis(x[BLOCK.cells[:, 1:]] - x[BLOCK.cells[:, :1]], 1, 2)
                         for x in (BLOCK.nodes, BLOCK.nodes + self.displacement(sample)))
        stretches = np.linalg.svd(after @ np.linalg.inv(before), compute_uv=False)
        return float(np.quantile(stretches, 0.01)), float(np.quantile(stretches, 0.99))

    def arrays(self):
        return self.displacements, self.energies

    def with_arrays(self, arrays: Sequence[np.ndarray]):
        return replace(self, displacements=arrays[0], energies=arrays[1])

    def material_data(self) -> dict[str, Any]:
        return {"material": self.material}

    def with_material(self, changed: Mapping[str, Any]):
        return replace(self, **changed)


class SpringDerivatives:
    """Derivatives of the wrench; see `tissue_sim.fem.solver.ForceVectorDerivatives`."""

    def __init__(self, modulus_rates: np.ndarray):
        self.modulus_rates = modulus_rates
        self.vector, self.force = np.zeros((modulus_rates.size, 3)), np.zeros(modulus_rates.size)
        self.is_sliding, self.has_changed = False, False

    def pop_contact_changed_flag(self):
        changed, self.has_changed = self.has_changed, False
        return changed


class SpringSolver(Solver):
    """Solver of the spring; see `tissue_sim.fem.solver.Solver`."""

    def __init__(self, model, *, resolution, mesh=None, topology=None):
        if resolution not in ("realtime", "fast"):
            raise InputError(f"unknown resolution {resolution!r}; a spring has 'realtime' and 'fast'",
                             field="resolution")
        self._returns_stiffness, self._state, self._derivatives = False, SpringState(), None
        self.set_material(model.material)

    @property
    def pose(self):
        return self._state.pose

    def step(self, pose, dt=0.0, *, tolerance=1e-9, max_iterations=20, predictor_order=2, inertial=False,
             resumes=False, own_stiffness=True):
        slid, rates = self._move_slider(pose)
        self._state = SpringState(pose, tuple(slid.tolist()), tuple(map(tuple, rates.tolist())))
        total = tuple(wrench(pose, slid, self._stiffness).tolist())
        matrix = tuple(map(tuple, self._stiffness.tolist())) if self._returns_stiffness else None
        return Step(StepStatus.CONVERGED, 1, 0.0, total, matrix)

    def _move_slider(self, pose):
        """Return the slider's new displacement, m, shape (2,), and its derivatives, shape (parameters, 2)."""
        slid, rates = np.array(self._state.slid), np.array(self._state.slid_rates).reshape(-1, 2)
        stiffness, derivatives = self._stiffness, self._derivatives
        pull = wrench(pose, slid, stiffness)[:2]
        magnitude = np.hypot(*pull)
        is_sliding = bool(magnitude > LIMIT)
        if is_sliding:
            # The force keeps the direction of the trial force and has the limit as its magnitude.
            lateral = np.array(compute_rigid_motion(TOUCH, pose)[:2])
            rest, limited = wrench(pose, lateral, stiffness)[:2], LIMIT * pull / magnitude
            slid = lateral + np.linalg.solve(stiffness[:2, :2], limited - rest)
            if derivatives is not None:
                relative = derivatives.modulus_rates[:, None] / self._modulus
                pull_rates = relative * pull + rates @ stiffness[:2, :2]
                across = np.eye(2) - np.outer(pull, pull) / magnitude**2
                limited_rates = LIMIT / magnitude * pull_rates @ across
                rates = np.linalg.solve(stiffness[:2, :2], (limited_rates - relative * limited).T).T
        if derivatives is not None:
            relative = derivatives.modulus_rates[:, None] / self._modulus
            derivatives.vector = (relative * wrench(pose, slid, stiffness) + rates @ stiffness[:2])[:, :3]
            derivatives.force = derivatives.vector[:, 2]
            derivatives.has_changed |= is_sliding != derivatives.is_sliding
            derivatives.is_sliding = is_sliding
        return slid, rates

    def enable_force_derivatives(self, neighbours):
        rates = np.array([(more.mu0 - less.mu0) / difference for more, less, difference in neighbours])
        self._derivatives = SpringDerivatives(rates)
        self._state = replace(self._state, slid_rates=((0.0, 0.0),) * rates.size)
        return self._derivatives

    def save(self):
        return self._state

    def restore(self, saved):
        self._state = saved

    def set_material(self, material):
        self._material, self._modulus = material, material.mu0
        self._stiffness = STIFFNESS * (material.mu0 / REFERENCE)

    def reset_to_first_touch(self):
        self._state = replace(self._state, pose=TOUCH)

    def enable_stiffness_output(self):
        self._returns_stiffness = True

    def field_sample(self):
        return self._state

    def fields(self, samples):
        extensions = [compute_extension(state.pose, state.slid) for state in samples]
        energies = np.array([0.5 * extension @ self._stiffness @ extension for extension in extensions])
        return SpringFields(self._material, np.array(list(map(compute_displacement, samples))), energies)

    def deformed_surface(self):
        return SolidSurface(BLOCK, BLOCK.nodes + compute_displacement(self._state))

    def get_recording_metadata(self):
        return {"element": "spring", "mesh": {"elements": 1, "freedoms": 6}}
