"""A bulk for multirate simulation in one file: a Winkler foundation, independent springs under a grid of nodes.

The bulk is linear, so that each linearisation is exact. `spring_solver` displays it.
"""

import numpy as np
from spring_solver import SpringSolver

from tissue_sim.fem.condensed.model import (
    CondensedBulk,
    ContactSurface,
    make_outline_tables,
    run_now_and_get_completion_check,
)

#: Stiffness of each spring over the shear modulus, m.
STIFFNESS = 1e-3
#: Grid of nodes, m.
GRID = np.linspace(-4e-3, 4e-3, 5)


class WinklerBed:
    """Springs under the nodes of a plane; see `tissue_sim.fem.condensed.model.BulkLineariser`."""

    def __init__(self, model, *, resolution, mesh=None):
        self.solver, self.executor = SpringSolver(model, resolution=resolution), run_now_and_get_completion_check
        self._modulus, self._number, experiment = model.material.mu0, 0, model.experiment
        x, y = np.meshgrid(GRID, GRID)
        places = np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], axis=1)
        count, zeros = len(places), np.zeros_like(places)
        chains, shapes = make_outline_tables([(experiment.tool.profile, 0, True)])
        self.surface = ContactSurface(
            places, np.full(count, 10.0 * STIFFNESS), np.zeros((count, 2)), np.zeros(count, dtype=np.int32), chains,
            shapes, np.zeros(count, dtype=np.int32), zeros, experiment.tool_pose(0.0), 0.0, 1e-9,
            experiment.contact_radius, 1e-9, count)

    def iterate_and_linearise_or_none(self, state, ahead=()):
        """Return the linearisation for a state of the contact; it is the same for all states."""
        self._number += 1
        n, new = len(self.surface.places), self._number
        return CondensedBulk(
            number=new, base=new, epoch=state.epoch, time=state.time, pose=state.pose, nodes=np.arange(n),
            free_displacement=np.zeros((n, 3)), compliance=np.eye(3 * n) / (STIFFNESS * self._modulus),
            tool_coupling=np.zeros((3 * n, 6)), wrench=np.zeros(6), stiffness=np.zeros((6, 6)), reach=np.inf,
            modulus=self._modulus, residual=0.0, tangent_time=state.time, tangent_pose=state.pose)

    def set_material(self, material):
        """Change the material."""
        self._modulus = material.mu0
