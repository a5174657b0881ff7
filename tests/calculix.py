"""CalculiX on a mesh of ours: a tool that holds some of its nodes, and a base that stays."""

from dataclasses import replace

import numpy as np
import pytest

from calibration.targets.calculix import RUNNER
from calibration.targets.runner import TargetTest
from tissue_sim.experiment.tools.shapes import Plate


def require_calculix():
    if missing := RUNNER.describe_missing_program():
        pytest.skip(f"compares with CalculiX, a system package that pip cannot install. {missing} .ci/run installs it")


def held_force(mesh, material, motion, held="face"):
    """Force on what holds a set of nodes, N.

    Args:
        mesh: with the sets `held` and ``base``. motion: of the held nodes, m, shape (3,).
    """
    require_calculix()
    mesh = replace(mesh, sets={**mesh.sets, "face": mesh.sets[held]})
    curve = RUNNER.run(TargetTest(mesh, Plate(), np.array([np.zeros(3), motion]), is_bonded=True, max_seconds=600.0),
                       material)
    assert not curve.ended, curve.ended
    return curve.forces[-1]
