"""Check that the solvers accept the specimens and tools of a campaign before a fit."""

from __future__ import annotations

from calibration.campaign.campaign import Campaign
from calibration.campaign.experiments import ROUND_SOLVER
from calibration.forward.meshes import get_solver_fit_resolutions
from tissue_sim.errors import ConvergenceError, InputError
from tissue_sim.fem.solver import SOLVERS
from tissue_sim.model import Model


def check_solvers_accept_test_geometries(campaign: Campaign) -> None:
    """Build the solver of each three-dimensional test once, with the first material of the campaign.

    Raises:
        InputError: the mesh or the contact cannot be built; with file and field.
    """
    for number, test in enumerate(campaign.tests):
        if test.experiment is None or test.solver == ROUND_SOLVER:
            continue
        try:
            SOLVERS.find(test.solver, "solver")(Model(test.experiment, campaign.fit.placeholder_material_with_effects),
                                                resolution=get_solver_fit_resolutions(test.solver).fast)
        except InputError as error:
            raise InputError(error.problem, file=campaign.path, field=f"test[{number}]") from None
        except ConvergenceError:
            continue  # the specimen may be in equilibrium under its weight with another material
