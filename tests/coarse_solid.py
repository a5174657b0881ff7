"""The solid in space on a mesh so coarse that it keeps up with a page; other processes import it by name."""

from tissue_sim.fem.solid.discretisation import make_solver
from tissue_sim.mesh.hexahedra import HEX8P0
from tissue_sim.mesh.solid import needle_solid


def make_coarse_solid(model, *, resolution="realtime", mesh=None, topology=None):
    """As `tissue_sim.fem.solver.SolverMaker`; whatever the resolution."""
    experiment = model.experiment
    radius = experiment.tool.require_radius()
    offset = 0.0 if experiment.approach is None else experiment.approach.offset
    coarse = needle_solid(experiment.specimen.radius, experiment.specimen.height, radius, HEX8P0,
                          smallest=0.45 * radius, growth=2.4, largest=3.0 * radius, around=2, centre=(offset, 0.0))
    return make_solver(model, mesh=coarse)
