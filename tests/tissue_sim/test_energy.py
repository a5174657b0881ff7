"""Stress and tangent at one point, as the kernels compute them, against an energy written out from singular values."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import tissue_sim as ts
from tissue_sim.fem.axisymmetric import energy
from tissue_sim.fem.taichi.runtime import get_initialised_taichi

CASES = {
    "mooney_rivlin": ([1000.0, 500.0], lambda l, p: p[0] * ((l**2).sum() - 3) + p[1] * ((l**-2).sum() - 3)),
    "reduced_polynomial_3": ([1000.0, 500.0, 300.0],
                             lambda l, p: sum(c * ((l**2).sum() - 3)**i for i, c in enumerate(p, start=1))),
    "ogden_1": ([3225.9, 14.8], lambda l, p: 2 * p[0] / p[1]**2 * ((l**p[1]).sum() - 3)),
    "ogden_2": ([1000.0, 3.0, 500.0, -2.0],
                lambda l, p: sum(2 * m / a**2 * ((l**a).sum() - 3) for m, a in zip(p[::2], p[1::2], strict=True))),
    "ogden_4": ([1000.0, 3.0, 500.0, -2.0, 200.0, 1.0, 50.0, 5.0],
                lambda l, p: sum(2 * m / a**2 * ((l**a).sum() - 3) for m, a in zip(p[::2], p[1::2], strict=True))),
    "gent": ([1000.0, 40.0], lambda l, p: -p[0] * p[1] / 2 * np.log(1 - ((l**2).sum() - 3) / p[1])),
    "fung_demiray": ([1000.0, 0.4], lambda l, p: p[0] / (2 * p[1]) * np.expm1(p[1] * ((l**2).sum() - 3))),
    "arruda_boyce": ([1000.0, 1.6], lambda l, p: p[0] * sum(
        c * ((l**2).sum()**i - 3**i) / p[1]**(2 * i - 2)
        for i, c in enumerate((1 / 2, 1 / 20, 11 / 1050, 19 / 7000, 519 / 673750), start=1))),
}
every_law = pytest.mark.parametrize("name", CASES)
PRESSURE = 700.0


@pytest.fixture(scope="module")
def point():
    """Function (law, F of 5 components) -> P (5,), A (5, 5)."""
    ti = get_initialised_taichi()
    reals = ti.types.ndarray(dtype=ti.f64, ndim=1)
    kernels = {}

    def compile_for(name):
        function = energy.make_stress_function(ts.find_law(name).kernel_energy)
        add_pressure_terms = energy.make_pressure_term_function()

        @ti.kernel
        def evaluate(passes: ti.i32, F: reals, p: ti.f64, coefficients: reals, P: reals, A: reals):
            for _ in range(passes):
                gradient = [F[i] for i in ti.static(range(5))]
                root = ti.pow((F[0] * F[3] - F[1] * F[2]) * F[4], -1.0 / 3.0)
                _density, isochoric, rate, _margin = function(gradient, root, coefficients)
                stress, tangent = add_pressure_terms(gradient, p, isochoric, rate)
                for i in ti.static(range(5)):
                    P[i] = stress[i]
                for i in ti.static(range(15)):
                    A[i] = tangent[i]

        return evaluate

    def evaluate(name, F, p=PRESSURE):
        law = ts.find_law(name)
        kernel = kernels.setdefault(law.kernel_energy.key, None) or compile_for(name)
        kernels[law.kernel_energy.key] = kernel
        P, packed, A = np.zeros(5), np.zeros(15), np.zeros((5, 5))
        kernel(1, np.ascontiguousarray(F, dtype=float), p, law.kernel_coefficients(CASES[name][0]), P, packed)
        for (i, k), value in zip(energy.PACKED, packed, strict=True):
            A[i, k] = A[k, i] = value
        return P, A

    return evaluate


def potential(name, F, p=PRESSURE):
    """W(F / J^(1/3)) + p (J - 1), from the singular values of the 3 x 3 deformation gradient."""
    full = np.array([[F[0], F[1], 0], [F[2], F[3], 0], [0, 0, F[4]]])
    stretches = np.linalg.svd(full, compute_uv=False)
    J = np.linalg.det(full)
    values, W = CASES[name]
    return W(stretches * J**(-1 / 3), values) + p * (J - 1)


def slopes(function, F, h):
    """Central differences of fourth order along the five components."""
    columns = []
    for e in np.eye(5):
        ahead, behind, far_ahead, far_behind = (np.asarray(function(F + k * h * e)) for k in (1, -1, 2, -2))
        columns.append((8 * (ahead - behind) - (far_ahead - far_behind)) / (12 * h))
    return np.stack(columns, axis=-1)


def rotation(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def components(in_plane, hoop):
    return np.array([*in_plane.ravel(), hoop])


STRAINED = components(np.array([[1.2, 0.1], [-0.2, 0.8]]), 1.1)
EQUAL = {
    "at rest": components(np.eye(2), 1.0),
    "swollen": components(1.1 * np.eye(2), 0.9),
    "turned": components(1.05 * rotation(0.7), 0.92),
    "all but equal": components(np.array([[1.1, 1e-7], [0.0, 1.1]]), 0.85),
    "near the switch": components(np.array([[1.1, 2.1e-5], [0.0, 1.1]]), 0.85),
    "nearly equal": components(np.array([[1.1, 1e-4], [0.0, 1.1]]), 0.85),
    "on the axis": components(np.array([[1.1, 0.0], [0.0, 0.8]]), 1.1),
}


@every_law
@pytest.mark.parametrize("F", [STRAINED, *EQUAL.values()], ids=["strained", *EQUAL])
def test_stress_and_tangent_are_derivatives_of_the_energy(name, F, point):
    """Equal stretches, where a law of the stretches has a limit to take, are among the points."""
    P, A = point(name, F)
    scale = 5e3
    np.testing.assert_allclose(P, slopes(lambda x: potential(name, x), F, 1e-3), atol=1e-7 * scale, rtol=1e-6)
    np.testing.assert_allclose(A, slopes(lambda x: point(name, x)[0], F, 1e-4), atol=1e-7 * scale, rtol=1e-7)


@every_law
@settings(max_examples=40, deadline=None)
@given(entries=st.lists(st.floats(-0.5, 0.5), min_size=5, max_size=5), left=st.floats(-3, 3), right=st.floats(-3, 3))
def test_objective_isotropic_and_symmetric(name, entries, left, right, point):
    """P(Q F) = Q P(F), P(F Q) = P(F) Q, and F^-1 P, the second Piola stress, is symmetric."""
    in_plane, hoop = np.eye(2) + np.reshape(entries[:4], (2, 2)), 1 + entries[4]
    assume(np.linalg.det(in_plane) > 0.2)
    P, _ = point(name, components(in_plane, hoop))
    stress, scale = P[:4].reshape(2, 2), 1e-9 * (1 + np.abs(P).max())
    for Q in (rotation(left), rotation(right)):
        turned, _ = point(name, components(Q @ in_plane, hoop))
        np.testing.assert_allclose(turned, components(Q @ stress, P[4]), atol=scale)
        turned, _ = point(name, components(in_plane @ Q, hoop))
        np.testing.assert_allclose(turned, components(stress @ Q, P[4]), atol=scale)
    second = np.linalg.solve(in_plane, stress)
    np.testing.assert_allclose(second, second.T, atol=10 * scale)
