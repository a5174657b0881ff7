"""Compression of a cylinder solved by FElupe: reference of tests/interop and peer of the benchmarks.

FElupe is an independent finite-element program (https://felupe.readthedocs.io). It works in mm, MPa and N here, with
the axis of rotation along its first coordinate. Its axisymmetric integrals run over the full circle (they carry
2 pi r), so its forces compare with ours without a factor.
"""

from __future__ import annotations

import felupe as fem
import numpy as np

from tissue_sim.mesh import Mesh
from tissue_sim.mesh.elements import Q4P0

#: Order of our nodes after r and z change places, which turns elements over: corners, mid-sides, centre.
_TURNED = [0, 3, 2, 1, 7, 6, 5, 4, 8]
_I = np.eye(3)[:, :, None, None]


def reduced_polynomial(C10: float, C20: float) -> fem.Material:
    """W = C10 (I1 - 3) + C20 (I1 - 3)^2 of the isochoric invariant, with analytical stress and tangent; moduli in Pa.

    FElupe's own law of this form differentiates automatically, which is slower.
    """
    C10, C20 = C10 * 1e-6, C20 * 1e-6

    def invariant(F):
        J = fem.math.det(F)
        inverse = fem.math.transpose(fem.math.inv(F, determinant=J))
        trace, scale = np.einsum("ij...,ij...", F, F), J ** (-2 / 3)
        return trace, scale, inverse, 2 * scale * (F - trace / 3 * inverse)

    def gradient(x):
        trace, scale, _, slope = invariant(x[0])
        return [(C10 + 2 * C20 * (scale * trace - 3)) * slope, x[-1]]

    def hessian(x):
        F = x[0]
        trace, scale, inverse, slope = invariant(F)
        outer = fem.math.dya(F, inverse)
        A = 2 / 3 * trace * (2 / 3 * fem.math.dya(inverse, inverse) + fem.math.cdya_il(inverse, inverse))
        A -= 4 / 3 * (outer + np.einsum("ijkl...->klij...", outer))
        A += 2 * fem.math.cdya_ik(_I, _I)
        A *= (C10 + 2 * C20 * (scale * trace - 3)) * scale
        return [A + 2 * C20 * fem.math.dya(slope, slope)]

    return fem.Material(gradient, hessian)


def ogden(mu: float, alpha: float) -> fem.Material:
    """W = 2 mu / alpha^2 (sum of isochoric stretches^alpha - 3), mu in Pa, by the spectral form of the second Piola
    stress (Holzapfel, Nonlinear Solid Mechanics, 2000, section 6.6).
    """
    mu = mu * 1e-6

    def spectral(F):
        square, N = np.linalg.eigh(np.einsum("kiqc,kjqc->qcij", F, F))
        power = (square / np.prod(square, axis=-1, keepdims=True) ** (1 / 3)) ** (alpha / 2)
        t, u = 2 * mu / alpha * power, 2 * mu * power
        tau = t - t.mean(-1, keepdims=True)
        return square, N, tau, u

    def gradient(x):
        square, N, tau, _ = spectral(x[0])
        S = np.einsum("qca,qcia,qcja->ijqc", tau / square, N, N)
        return [np.einsum("ik...,kj...->ij...", x[0], S), x[-1]]

    def hessian(x):
        F = x[0]
        square, N, tau, u = spectral(F)
        S = tau / square
        # d tau_a / d ln(stretch b), then (1 / stretch b) d S_a / d stretch b.
        D = np.eye(3) * u[..., None] - (u[..., :, None] + u[..., None, :] - u.mean(-1)[..., None, None]) / 3
        c = (D - 2 * np.eye(3) * tau[..., None]) / (square[..., :, None] * square[..., None, :])
        gap = square[..., None, :] - square[..., :, None]
        limit = (np.einsum("...bb->...b", c)[..., None, :] - c) / 2
        apart = abs(gap) > 1e-6
        shear = np.where(apart, (S[..., None, :] - S[..., :, None]) / np.where(apart, gap, 1.0), limit)
        shear *= 1 - np.eye(3)
        C = np.einsum("qcab,qcia,qcja,qckb,qclb->ijklqc", c, N, N, N, N, optimize=True)
        for turned in ("qckalb", "qckbla"):
            k, l = turned[2:4], turned[4:6]
            C += np.einsum(f"qcab,qcia,qcjb,qc{k},qc{l}->ijklqc", shear, N, N, N, N, optimize=True)
        A = np.einsum("iI...,kK...,IJKL...->iJkL...", F, F, C, optimize=True)
        stress = np.einsum("qca,qcia,qcja->ijqc", S, N, N)
        return [A + np.einsum("ik,jl...->ijkl...", np.eye(3), stress)]

    return fem.Material(gradient, hessian)


class _LinearModes(fem.Element):
    """The discontinuous pressures 1, xi, eta of the nine-node quad; no nodes of their own."""

    def __init__(self):
        self.points, self.cells, self.cell_type = np.zeros((3, 2)), np.arange(3).reshape(1, -1), "polygon"

    def function(self, rs):
        return np.array([1.0, *rs])

    def gradient(self, rs):
        return np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])


def _mixed(region, cells, element, first) -> fem.FieldContainer:
    """Displacement, pressure and volume ratio; `first`: nodal values of the volume ratio at rest."""
    dual = fem.Mesh(np.zeros((cells.max() + 1, 2)), cells, element.cell_type)
    dual_region = fem.Region(dual, element, region.quadrature, grad=False)
    return fem.FieldContainer([fem.FieldAxisymmetric(region, dim=2), fem.Field(dual_region),
                               fem.Field(dual_region, values=first.reshape(-1, 1))])


def unknowns(mesh: Mesh, pressure: str) -> fem.FieldContainer:
    """Return FElupe's fields on the nodes and elements of this program.

    Args:
        mesh: ours.
        pressure: ``"P0"``: constant in four-node quads, condensed (`SolidBodyNearlyIncompressible`); the others keep
            pressure and volume ratio as unknowns (`NearlyIncompressible`): ``"P0 mixed"``, ``"P-1"`` three
            discontinuous modes, ``"Q1"`` continuous bilinear (Taylor-Hood).
    """
    four = mesh.element is Q4P0
    turned = mesh.connectivity[:, _TURNED[:mesh.element.node_count]]
    felupe_mesh = fem.Mesh(mesh.nodes[:, ::-1] * 1e3, turned, "quad" if four else "quad9")
    region = (fem.RegionQuad if four else fem.RegionBiQuadraticQuad)(felupe_mesh)
    cells = np.arange(len(turned))
    match pressure:
        case "P0":
            return fem.FieldContainer([fem.FieldAxisymmetric(region, dim=2)])
        case "P0 mixed":
            return fem.FieldsMixed(region, n=3, axisymmetric=True)
        case "P-1":
            return _mixed(region, np.arange(3 * cells.size).reshape(-1, 3), _LinearModes(),
                          np.tile([1.0, 0.0, 0.0], cells.size))
        case "Q1":
            corners, numbers = np.unique(turned[:, :4], return_inverse=True)
            return _mixed(region, numbers.reshape(-1, 4), fem.Quad(), np.ones(corners.size))
        case _:
            raise ValueError(f"unknown pressure {pressure!r}")


def solid(law: fem.Material, field: fem.FieldContainer, bulk_modulus: float):
    """Return the body of a law on `unknowns`, condensed for displacements only. `bulk_modulus`: Pa."""
    if len(field.fields) == 1:
        return fem.SolidBodyNearlyIncompressible(law, field, bulk=bulk_modulus * 1e-6)
    return fem.SolidBody(fem.NearlyIncompressible(law, bulk=bulk_modulus * 1e-6), field)


def boundary(field: fem.FieldContainer, mesh: Mesh, name: str, held: str) -> fem.Boundary:
    """Return boundary conditions of a node set in the directions `held`: ``"r"``, ``"z"`` or ``"rz"``."""
    members = np.isin(np.arange(len(mesh.nodes)), mesh.sets[name])
    return fem.Boundary(field[0], mask=members, skip=("z" not in held, "r" not in held))


def compression_curve(mesh: Mesh, law: fem.Material, bulk_modulus: float, depths, *, held: str = "rz",
                      pressure: str = "P0", tolerance: float | None = None) -> np.ndarray:
    """Return the forces on the upper plate.

    Args:
        mesh: our mesh; FElupe uses the same nodes and elements.
        law: isochoric part, such as `reduced_polynomial(...)`.
        bulk_modulus: Pa, of U(J) = K/2 (J - 1)^2.
        depths: m, without rest.
        held: ``"rz"``: both faces bonded; ``"z"``: both lubricated.
        pressure: see `unknowns`.
        tolerance: of FElupe's Newton iteration; its default when None.

    Returns:
        N, shape of `depths`, positive in compression.
    """
    field = unknowns(mesh, pressure)
    boundaries = {"axis": boundary(field, mesh, "axis", "r"), "base": boundary(field, mesh, "base", held),
                  "top": boundary(field, mesh, "top", "z")}
    if held == "rz":
        boundaries["top stays"] = boundary(field, mesh, "top", "r")
    step = fem.Step([solid(law, field, bulk_modulus)], ramp={boundaries["top"]: -1e3 * np.asarray(depths)},
                    boundaries=boundaries)
    curve = fem.CharacteristicCurve([step], boundary=boundaries["top"])
    curve.evaluate(verbose=False, **({} if tolerance is None else {"tol": tolerance}))
    return -np.array(curve.y)[:, 0]
