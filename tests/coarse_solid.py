"""The solid in space on a mesh that keeps up with a page, and on which the force of a ball is CONVERGED.

Elements of half the radius of the ball have a faceting error of 40 % at a depth of an eighth of the radius, those of a
quarter 9 %. Other processes import this module by name.
"""

from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.mesh.solid import create_cylinder_mesh_under_needle
from tissue_sim.mesh.solid_element import HEX8P0


def make_coarse_solid(model, *, resolution="realtime", mesh=None, topology=None):
    """Return a coarse solid solver for any resolution; see `tissue_sim.fem.solver.SolverMaker`."""
    experiment = model.experiment
    radius = experiment.tool.require_radius()
    offset = 0.0 if experiment.approach is None else experiment.approach.offset
    coarse = create_cylinder_mesh_under_needle(experiment.specimen.radius, experiment.specimen.height, radius, HEX8P0,
                                               smallest=0.25 * radius, growth=2.4, largest=3.0 * radius, around=4,
                                               centre=(offset, 0.0))
    return make_solver(model, mesh=coarse)
