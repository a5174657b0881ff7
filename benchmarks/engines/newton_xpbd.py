"""Newton's soft body with `SolverXPBD`, an engine of the benchmark.

The compliant constraints ``tr(F^T F) - 3`` and ``det F - 1`` of each tetrahedron have the energy density
``W = k_mu/2 (I1 - 3)^2 + k_lambda/2 (J - 1)^2``. Its shear modulus is zero at rest, so that the forces of small
deformations are much too small. Newton states no contact forces of soft bodies for this solver; the force on the tool
is that on the base.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from calibration.targets.newton_vbd import NewtonRunner, VbdBody

#: Iterations of a step.
ITERATIONS = 20
#: Relaxation of the corrections of the elements, which are added at each node, 1; 0.2 diverges on the coarse mesh.
RELAXATION = 0.05


class XpbdBody(VbdBody):
    """Soft body that is stepped with extended position-based dynamics."""

    def _make_solver(self, newton: Any, model: Any) -> Any:
        return newton.solvers.SolverXPBD(model, iterations=ITERATIONS, soft_body_relaxation=RELAXATION)

    def _allocate_observables_or_none(self) -> Any:
        return None

    def _compute_stress(self, gradient: np.ndarray, rate: np.ndarray) -> np.ndarray:
        cofactor = np.stack([np.cross(gradient[:, :, (axis + 1) % 3], gradient[:, :, (axis + 2) % 3])
                             for axis in range(3)], axis=2)
        stretch = np.einsum("nij,nij->n", gradient, gradient) - 3.0
        volume = np.linalg.det(gradient) - 1.0
        return (2.0 * self._constants.mu * stretch[:, None, None] * gradient
                + self._constants.lame * volume[:, None, None] * cofactor)


class XpbdRunner(NewtonRunner):
    """Runner of the benchmark for Newton's XPBD."""

    title = "Newton XPBD"
    body_type = XpbdBody


#: Engine of the benchmark.
ENGINE = XpbdRunner()
