"""Kinematics, stress and tangent at the quadrature points of the axisymmetric solid, as Taichi functions.

The order of the components of the deformation gradient F and of the first Piola stress is rR, rZ, zR, zZ, hoop. The
isochoric energy is W(F / J^(1/3)); the pressure adds p (J - 1). Memory acts on the isochoric part: softening multiplies
the stress, relaxation multiplies the stress and adds the inherited stress (hereditary integral).

Every function works on lists of numbers (one point) and on lists of vectors (several points at once).

The components of a displacement gradient have the same order. The indices are b for the batch, q for the quadrature
point and a for the node of an element. Intermediate results of a batch are stored in a scratch field.

The six stress components of effects are reduced to four (RR, RZ, ZZ, hoop); stress and tangent are expressed by the
deformation gradient.
"""

from functools import cache
from typing import NamedTuple

from tissue_sim.fem.elements.energy import (
    list_lower_triangle_index_pairs,
    make_domain_margin_function,
    make_energy_derivatives_by_invariants,
    make_isochoric_chain_rule,
    make_principal_plane_moduli_function,
    make_stretch_derivatives_function,
)
from tissue_sim.fem.history import sum_effect_responses
from tissue_sim.fem.taichi import runtime as shared
from tissue_sim.fem.taichi.runtime import LANES, CountsInLargestElement, get_initialised_taichi
from tissue_sim.fem.taichi.trace import FormulaClassAndConstants, extract_expressions, wrap_as_traced_numbers
from tissue_sim.laws import KernelEnergy
from tissue_sim.mesh.elements import ELEMENTS, MAX_NODES

#: Size of the largest element.
_LARGEST = CountsInLargestElement(nodes=MAX_NODES, points=MAX_NODES, modes=3)
#: Names and sizes of the arrays in the scratch field. Nodes: displacements UR and UZ, forces FR and FZ, increments SR
#: and SZ. Pressure modes: amplitude PRESSURE, volume residual GAP, volume derivatives VR and VZ. Quadrature points:
#: STRESS, TANGENT, COFACTOR (dJ/dF), MODE (pressure modes), RATE (stress increments). CENTRE: stiffness rows of the
#: interior node. Sensitivities: LAW (records of the law), ENERGY_RATE, PAST (derivative of the inherited stress),
#: BEFORE and CHANGE (stress of the last step and its change).
_SIZES = (
    ("UR", _LARGEST.nodes), ("UZ", _LARGEST.nodes), ("FR", _LARGEST.nodes), ("FZ", _LARGEST.nodes),
    ("SR", _LARGEST.nodes), ("SZ", _LARGEST.nodes), ("PRESSURE", _LARGEST.modes), ("GAP", _LARGEST.modes),
    ("VR", _LARGEST.modes * _LARGEST.nodes), ("VZ", _LARGEST.modes * _LARGEST.nodes),
    ("STRESS", 5 * _LARGEST.points), ("TANGENT", 15 * _LARGEST.points), ("COFACTOR", 5 * _LARGEST.points),
    ("MODE", _LARGEST.modes * _LARGEST.points), ("RATE", 10 * _LARGEST.points), ("CENTRE", 4 * _LARGEST.nodes),
    ("LAW", 22 * _LARGEST.points), ("ENERGY_RATE", _LARGEST.points), ("PAST", 4), ("BEFORE", 4 * _LARGEST.points),
    ("CHANGE", 4 * _LARGEST.points))
#: Name -> offset in the scratch field.
AT = {name: sum(size for _, size in _SIZES[:i]) for i, (name, _) in enumerate(_SIZES)}
_SIZE = sum(size for _, size in _SIZES)


def get_axisymmetric_scratch_field():
    """Return the Taichi field, shared by all kernels, for intermediate results of the batch that is evaluated.

    The offsets of the arrays are `AT`. Each of the `_SIZE` entries is a vector with one component for each element of
    the batch (`LANES` elements).
    """
    return shared.get_shared_scratch_field(LANES, _SIZE)


class KinematicFunctions(NamedTuple):
    """Taichi functions of one element type.

    Attributes:
        gather_node_vector: ``gather_node_vector(values, elements, i) -> (r, z)``: components of nodal values, stored
            as r0, z0, r1, z1, ..., at the nodes in row i of ``elements.dofs``, one element in each lane.
        gather_node_vector_of_row: the same for row k of a matrix: ``(values, k, elements, i)``.
        compute_gradient_of_stored_displacements: ``(b, q, elements) -> h0, ..., h4``: displacement gradient of the
            displacements UR and UZ in the scratch field at quadrature point q.
        compute_node_force_from_stresses: ``(a, b, first, elements) -> (r, z)``: force on node a from the stresses times
            weights in the scratch field, five for each quadrature point from `first` on.
    """

    gather_node_vector: object
    gather_node_vector_of_row: object
    compute_gradient_of_stored_displacements: object
    compute_node_force_from_stresses: object


@cache
def make_kinematic_functions(element_name: str) -> KinematicFunctions:
    """Return the Taichi functions of an element type, a key of `tissue_sim.mesh.elements.ELEMENTS`."""
    ti = get_initialised_taichi()
    element = ELEMENTS[element_name]
    nodes, points = element.node_count, element.quadrature[1].size
    vec = ti.types.vector(LANES, ti.f64)
    s = get_axisymmetric_scratch_field()
    UR, UZ = AT["UR"], AT["UZ"]

    @ti.func
    def gather_node_vector(values: ti.template(), elements: ti.template(), i):
        """Return the components (r, z) of nodal values at the nodes of row i, one element in each lane."""
        return (ti.Vector([values[elements.dofs[i][l]] for l in ti.static(range(LANES))]),
                ti.Vector([values[elements.dofs[i][l] + 1] for l in ti.static(range(LANES))]))

    @ti.func
    def gather_node_vector_of_row(values: ti.template(), k, elements: ti.template(), i):
        """Return the components (r, z) of row k of nodal values at the nodes of row i, one element in each lane."""
        return (ti.Vector([values[k, elements.dofs[i][l]] for l in ti.static(range(LANES))]),
                ti.Vector([values[k, elements.dofs[i][l] + 1] for l in ti.static(range(LANES))]))

    @ti.func
    def compute_gradient_of_stored_displacements(b, q, elements: ti.template()):
        """Return the gradient (rR, rZ, zR, zZ, hoop) of the stored nodal displacements at quadrature point q."""
        h0, h1, h2, h3, h4 = vec(0.0), vec(0.0), vec(0.0), vec(0.0), vec(0.0)
        for a in range(nodes):
            g = (b * points + q) * nodes + a
            gr, gz, gh = elements.gradient_r[g], elements.gradient_z[g], elements.value_r[g]
            ur, uz = s[UR + a], s[UZ + a]
            h0 = h0 + ur * gr
            h1 = h1 + ur * gz
            h2 = h2 + uz * gr
            h3 = h3 + uz * gz
            h4 = h4 + ur * gh
        return h0, h1, h2, h3, h4

    @ti.func
    def compute_node_force_from_stresses(a, b, first, elements: ti.template()):
        """Return the force (r, z) on node a from the stored stresses times weights, whose first entry is `first`."""
        fr, fz = vec(0.0), vec(0.0)
        for q in range(points):
            g, at = (b * points + q) * nodes + a, first + 5 * q
            gr, gz, gh = elements.gradient_r[g], elements.gradient_z[g], elements.value_r[g]
            fr = fr + s[at] * gr + s[at + 1] * gz + s[at + 4] * gh
            fz = fz + s[at + 2] * gr + s[at + 3] * gz
        return fr, fz

    return KinematicFunctions(gather_node_vector, gather_node_vector_of_row, compute_gradient_of_stored_displacements,
                              compute_node_force_from_stresses)


#: Row and column of each entry of the packed symmetric 5 x 5 tangent.
PACKED = list_lower_triangle_index_pairs(5)
#: Second derivatives of the in-plane determinant: (F_zZ, F_rR) and (F_zR, F_rZ).
COFACTOR_SIGNS = {(3, 0): 1.0, (2, 1): -1.0}


#: Index of entry (i, k) in the packed tangent.
PLACE = tuple(tuple(PACKED.index((max(i, k), min(i, k))) for k in range(5)) for i in range(5))


@cache
def make_pressure_term_function():
    """Return the Taichi function ``add_pressure_terms(F, p, P, A) -> (P, A)``: P + p dJ/dF and A + p d2J/dF2."""
    ti = get_initialised_taichi()

    @ti.func
    def add_pressure_terms(F, p, P, A):
        """Return stress P + p dJ/dF and tangent A + p d2J/dF2 for the pressure p."""
        c = F[4]
        cofactor = [F[3], -F[2], -F[1], F[0]]
        stress = [P[i] + 0.0 * c for i in ti.static(range(5))]
        tangent = [A[n] + 0.0 * c for n in ti.static(range(15))]
        for i in ti.static(range(4)):
            stress[i] += p * c * cofactor[i]
            tangent[ti.static(PLACE[4][i])] += p * cofactor[i]
        stress[4] += p * (F[0] * F[3] - F[1] * F[2])
        for place, sign in ti.static(tuple(COFACTOR_SIGNS.items())):
            tangent[ti.static(PLACE[place[0]][place[1]])] += sign * p * c
        return stress, tangent

    return add_pressure_terms


@cache
def make_relaxation_function():
    """Return the Taichi function of the hereditary integral.

    Its form is ``compute_relaxed_stress_and_tangent(F, instant, h, P, A) -> (S, P, A)``.
    """
    ti = get_initialised_taichi()

    @ti.func
    def compute_relaxed_stress_and_tangent(F, instant, h, P, A):
        """Replace the instantaneous stress P = F S by F (instant S + h), and the tangent likewise; return S as well.

        S is the instantaneous and h the inherited isochoric second Piola stress (RR, RZ, ZZ, hoop); see
        `tissue_sim.material.viscoelasticity`.
        """
        j = F[0] * F[3] - F[1] * F[2]
        S = [(F[3] * P[0] - F[1] * P[2]) / j, (F[3] * P[1] - F[1] * P[3]) / j, (F[0] * P[3] - F[2] * P[1]) / j,
             P[4] / F[4]]
        pushed = [F[0] * h[0] + F[1] * h[1], F[0] * h[1] + F[1] * h[2], F[2] * h[0] + F[3] * h[1],
                  F[2] * h[1] + F[3] * h[2], F[4] * h[3]]
        tangent = [instant * A[n] for n in ti.static(range(15))]
        for i in ti.static(range(2)):
            tangent[ti.static(PLACE[2 * i][2 * i])] += h[0]
            tangent[ti.static(PLACE[2 * i + 1][2 * i])] += h[1]
            tangent[ti.static(PLACE[2 * i + 1][2 * i + 1])] += h[2]
        tangent[ti.static(PLACE[4][4])] += h[3]
        return S, [instant * P[i] + pushed[i] for i in ti.static(range(5))], tangent

    return compute_relaxed_stress_and_tangent


@cache
def make_stress_function(energy: KernelEnergy, tangents: bool = True):
    """Return the Taichi function ``compute_stress_and_tangent(F, root, coefficients) -> (W, P, A, margin)``.

    The Taichi function takes the deformation gradient F (5 components, positive determinant), root = J^(-1/3), and the
    array of the energy's coefficients. It returns the isochoric energy density W, the first Piola stress P = dW/dF (5
    components) and its derivative A (15 components, packed as `PACKED`), in units of the coefficients, and a number
    that is positive inside the domain of the law.

    Args:
        energy: energy of a law.
        tangents: whether A is computed; otherwise A is zero.
    """
    if energy.family == "invariants":
        return _make_stress_function_of_invariants(energy, tangents)
    return _make_stress_function_of_stretches(energy, tangents)


def _make_stress_function_of_invariants(energy: KernelEnergy, tangents: bool):
    """Return `compute_stress_and_tangent` of an energy that depends on the isochoric invariants."""
    ti = get_initialised_taichi()
    count, values = energy.coefficient_count, 6 + len(energy.domain_conditions)

    derivatives, compute_margin = make_energy_derivatives_by_invariants(energy, tangents), make_domain_margin_function()
    # In axisymmetry the invariants are functions of a, the sum of squares of the in-plane deformation gradient, j, its
    # determinant, and c, the hoop stretch.
    chain = make_isochoric_chain_rule("a + c**2", "j**2 + a*c**2", "j*c", "a j c", tangents)

    @ti.func
    def compute_stress_and_tangent(F, root, coefficients: ti.template()):
        a = F[0] * F[0] + F[1] * F[1] + F[2] * F[2] + F[3] * F[3]
        j = F[0] * F[3] - F[1] * F[2]
        c = F[4]
        scale = root * root
        first = (a + c * c) * scale
        second = (j * j + a * c * c) * scale * scale
        w = [v + 0.0 * c for v in ti.static(derivatives(first, second, [coefficients[i] for i in range(count)]))]
        d = [v + 0.0 * c for v in ti.static(chain(a, j, c, scale, w[1], w[2], w[3], w[4], w[5]))]
        # dW/dF = d_a 2F + d_j cof F + d_c e, and the same vectors span the second derivative.
        twice = [2.0 * F[i] for i in ti.static(range(4))]
        cofactor = [F[3], -F[2], -F[1], F[0]]
        P = [d[0] * twice[0] + d[1] * cofactor[0], d[0] * twice[1] + d[1] * cofactor[1],
             d[0] * twice[2] + d[1] * cofactor[2], d[0] * twice[3] + d[1] * cofactor[3], 1.0 * d[2]]
        A = [0.0 * c for _n in ti.static(range(15))]
        if ti.static(tangents):
            for i in ti.static(range(4)):
                for k in ti.static(range(i + 1)):
                    A[ti.static(PLACE[i][k])] = (
                        d[3] * twice[i] * twice[k] + d[4] * (twice[i] * cofactor[k] + cofactor[i] * twice[k])
                        + d[5] * cofactor[i] * cofactor[k] + ti.static(COFACTOR_SIGNS.get((i, k), 0.0)) * d[1])
                A[ti.static(PLACE[i][i])] += 2.0 * d[0]
                A[ti.static(PLACE[4][i])] = d[6] * twice[i] + d[7] * cofactor[i]
            A[ti.static(PLACE[4][4])] = d[8]
        return w[0], P, A, compute_margin([w[n] for n in ti.static(range(6, values))], c)

    return compute_stress_and_tangent


def _make_stress_function_of_stretches(energy: KernelEnergy, tangents: bool):
    """Return `compute_stress_and_tangent` of an energy that is a sum over the isochoric principal stretches."""
    ti = get_initialised_taichi()
    compute_stretch_derivatives = make_stretch_derivatives_function(energy)
    compute_principal_plane_moduli = make_principal_plane_moduli_function()

    @ti.func
    def compute_stress_and_tangent(F, root, coefficients: ti.template()):
        # Singular value decomposition of the in-plane part; all expressions have a limit for equal stretches. The
        # singular vectors are rotated by half the sum and half the difference of the angles of (e, h) and (f, g); only
        # their products are needed, without trigonometric functions.
        e, h = 0.5 * (F[0] + F[3]), 0.5 * (F[2] - F[1])
        f, g = 0.5 * (F[0] - F[3]), 0.5 * (F[2] + F[1])
        q, r = ti.sqrt(e * e + h * h), ti.sqrt(f * f + g * g)
        turned, least = r > 1e-300, ti.max(r, 1e-300)
        cs, ss = e / q, h / q
        cd, sd = ti.select(turned, f / least, 0.0 * r + 1.0), ti.select(turned, g / least, 0.0 * r)
        s = [q + r, q - r, F[4]]
        density, w1, w2, margin = compute_stretch_derivatives(s, root, coefficients)
        # Directions of the in-plane stretches, as 4-vectors rR, rZ, zR, zZ.
        n1 = [0.5 * (cs + cd), 0.5 * (sd - ss), 0.5 * (sd + ss), 0.5 * (cs - cd)]
        n2 = [0.5 * (cs - cd), -0.5 * (sd + ss), -0.5 * (sd - ss), 0.5 * (cs + cd)]
        P = [w1[0] * n1[0] + w1[1] * n2[0], w1[0] * n1[1] + w1[1] * n2[1], w1[0] * n1[2] + w1[1] * n2[2],
             w1[0] * n1[3] + w1[1] * n2[3], 1.0 * w1[2]]
        A = [0.0 * q for _n in ti.static(range(15))]
        if ti.static(tangents):
            twist, flip = compute_principal_plane_moduli(0, 1, s, w1, w2)
            # Directions of in-plane rotation and of in-plane shear of the principal axes.
            turn, shear = [ss, cs, -cs, ss], [-sd, cd, cd, sd]
            for i in ti.static(range(4)):
                for k in ti.static(range(i + 1)):
                    A[ti.static(PLACE[i][k])] = (
                        w2[0][0] * n1[i] * n1[k] + w2[1][1] * n2[i] * n2[k]
                        + w2[0][1] * (n1[i] * n2[k] + n2[i] * n1[k])
                        + 0.5 * twist * turn[i] * turn[k] + 0.5 * flip * shear[i] * shear[k])
                A[ti.static(PLACE[4][i])] = w2[2][0] * n1[i] + w2[2][1] * n2[i]
            A[ti.static(PLACE[4][4])] = w2[2][2]
        return density, P, A, margin

    return compute_stress_and_tangent


#: Indices of RR, RZ, ZZ and hoop among the six components of a symmetric tensor.
_COMPONENTS = (0, 3, 1, 2)


@cache
def make_effect_stress_function(formulas: tuple[FormulaClassAndConstants, ...]):
    """Return the Taichi function ``add_effect_stresses(F, P, A, states, settings) -> (S, P, A, states)``.

    The function adds the first Piola stress F S of the effects to P and its derivative to A. S is the second Piola
    stress of the effects. All arguments are vectors; see `tissue_sim.fem.history.PointEffects`.
    """
    ti = get_initialised_taichi()
    count = 1 + sum(len(formula.parameter_names) for formula in formulas)

    def trace_effect_expressions(F, P, A, states, settings):
        return _add_effects_to_stress_expressions(formulas, F, P, A, states, settings)

    @ti.func
    def add_effect_stresses(F, P, A, states, settings: ti.template()):
        return ti.static(trace_effect_expressions(F, P, A, states, [settings[i] for i in range(count)]))

    return add_effect_stresses


def _add_effects_to_stress_expressions(formulas: tuple[FormulaClassAndConstants, ...], F: list, P: list, A: list,
                                       states: list, settings: list) -> tuple:
    """Return the expressions (S, P, A, states) of the summed effects at a quadrature point.

    Arguments and results are lists of Taichi expressions, as in `make_effect_stress_function`.
    """
    F, P, A = (wrap_as_traced_numbers(each, lanes=True) for each in (F, P, A))
    states, settings = wrap_as_traced_numbers(states, lanes=True), wrap_as_traced_numbers(settings, lanes=False)
    C = [F[0] * F[0] + F[2] * F[2], F[1] * F[1] + F[3] * F[3], F[4] * F[4], F[0] * F[1] + F[2] * F[3], 0.0, 0.0]
    S, D, found = sum_effect_responses(formulas, _COMPONENTS, C, states, settings)
    # Derivative of the Green strains RR, 2 RZ, ZZ and hoop with respect to F.
    B = [[F[0], 0.0, F[2], 0.0, 0.0], [F[1], F[0], F[3], F[2], 0.0], [0.0, F[1], 0.0, F[3], 0.0],
         [0.0, 0.0, 0.0, 0.0, F[4]]]
    DB = [[sum((D[i][m] * B[m][k] for m in range(4)), 0.0) for k in range(5)] for i in range(4)]
    geometric = {(0, 0): S[0], (1, 0): S[1], (1, 1): S[2], (2, 2): S[0], (3, 2): S[1], (3, 3): S[2], (4, 4): S[3]}
    P = [P[k] + sum((B[i][k] * S[i] for i in range(4)), 0.0) for k in range(5)]
    A = [A[n] + geometric.get((i, k), 0.0) + sum((B[m][i] * DB[m][k] for m in range(4)), 0.0)
         for n, (i, k) in enumerate(PACKED)]
    like = F[0]
    return (extract_expressions(S, like), extract_expressions(P, like), extract_expressions(A, like),
            extract_expressions(found, like))
