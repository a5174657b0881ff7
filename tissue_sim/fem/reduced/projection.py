"""Forces and stiffness of sampled elements on the modes of a reduced solid, as a Taichi kernel."""

from functools import cache

from tissue_sim.fem.solid.batches import LANES
from tissue_sim.fem.solid.element import KAPPA, REMEMBERS, TANGENT, element_functions
from tissue_sim.fem.taichi.runtime import initialise
from tissue_sim.laws import KernelEnergy
from tissue_sim.mesh.hexahedra import HEXAHEDRA

#: Places in `settings` beside those of the elements: whether the pressures follow a change of the amplitudes, and the
#: batches whose stiffness is computed anew.
FOLLOWS, FIRST, LAST, SETTINGS = 3, 4, 5, 6


@cache
def projection_kernel(element_name: str, energy: KernelEnergy):
    """Kernel of the forces on each mode, and of the stiffness between them where `settings` ask for it.

    ``basis`` holds what each mode moves, shape (batches times freedoms of an element times modes), with the lanes last;
    ``tangent`` is added to, its upper half only; ``least`` gets the smallest J.
    """
    ti = initialise()
    element = HEXAHEDRA[element_name]
    nodes, pressure_modes = element.nodes, element.pressure_modes
    freedoms = 3 * nodes
    integrate, stiffen, _ = element_functions(element_name, energy)
    vec = ti.types.vector(LANES, ti.f64)
    row = ti.Vector.field(LANES, ti.f64, shape=freedoms)
    real1, real2, real3 = (ti.types.ndarray(ti.f64, ndim=n) for n in (1, 2, 3))
    int2 = ti.types.ndarray(ti.i32, ndim=2)
    vector1 = ti.types.ndarray(vec, ndim=1)

    @ti.func
    def follow(b, modes, kappa, change: ti.template(), basis: ti.template(), pressures: ti.template(),
               moduli: ti.template(), volume_rates: ti.template(), gaps: ti.template()):
        """Let the pressures of a batch follow a linear solution."""
        bulk = kappa * moduli[b]
        for i in range(freedoms):
            moved = vec(0.0)
            for j in range(modes):
                moved = moved + basis[(b * freedoms + i) * modes + j] * change[j]
            row[i] = moved
        for m in range(pressure_modes):
            at = b * pressure_modes + m
            gap = gaps[at]
            for i in range(freedoms):
                gap = gap + volume_rates[at * freedoms + i] * row[i]
            pressures[at] = pressures[at] + bulk * gap

    @ti.func
    def project(b, modes, basis: ti.template(), stiffness: ti.template(), tangent: ti.template()):
        """Add the stiffness of a batch between the modes."""
        for j in range(modes):
            for i in range(freedoms):
                row[i] = vec(0.0)
            for c in range(nodes):
                at_c = (b * freedoms + 3 * c) * modes + j
                c0, c1, c2 = basis[at_c], basis[at_c + modes], basis[at_c + 2 * modes]
                y0, y1, y2 = row[3 * c], row[3 * c + 1], row[3 * c + 2]
                for a in range(c):
                    # The force on a along i for a motion of c along k stands at 3 k + i.
                    pair = 9 * (c * (c + 1) // 2 + a)
                    at_a = (b * freedoms + 3 * a) * modes + j
                    a0, a1, a2 = basis[at_a], basis[at_a + modes], basis[at_a + 2 * modes]
                    k00, k01, k02 = stiffness[pair], stiffness[pair + 1], stiffness[pair + 2]
                    k10, k11, k12 = stiffness[pair + 3], stiffness[pair + 4], stiffness[pair + 5]
                    k20, k21, k22 = stiffness[pair + 6], stiffness[pair + 7], stiffness[pair + 8]
                    row[3 * a] = row[3 * a] + k00 * c0 + k10 * c1 + k20 * c2
                    row[3 * a + 1] = row[3 * a + 1] + k01 * c0 + k11 * c1 + k21 * c2
                    row[3 * a + 2] = row[3 * a + 2] + k02 * c0 + k12 * c1 + k22 * c2
                    y0 = y0 + k00 * a0 + k01 * a1 + k02 * a2
                    y1 = y1 + k10 * a0 + k11 * a1 + k12 * a2
                    y2 = y2 + k20 * a0 + k21 * a1 + k22 * a2
                own = 9 * (c * (c + 1) // 2 + c)
                row[3 * c] = y0 + stiffness[own] * c0 + stiffness[own + 3] * c1 + stiffness[own + 6] * c2
                row[3 * c + 1] = y1 + stiffness[own + 1] * c0 + stiffness[own + 4] * c1 + stiffness[own + 7] * c2
                row[3 * c + 2] = y2 + stiffness[own + 2] * c0 + stiffness[own + 5] * c1 + stiffness[own + 8] * c2
            for h in range(j + 1):
                sum0, sum1, sum2 = vec(0.0), vec(0.0), vec(0.0)
                for c in range(nodes):
                    at = (b * freedoms + 3 * c) * modes + h
                    sum0 = sum0 + basis[at] * row[3 * c]
                    sum1 = sum1 + basis[at + modes] * row[3 * c + 1]
                    sum2 = sum2 + basis[at + 2 * modes] * row[3 * c + 2]
                tangent[h, j] = tangent[h, j] + (sum0 + sum1 + sum2).sum()

    @ti.kernel
    def evaluate(settings: real1, least: real1, amplitudes: real1, change: real1, basis: vector1, x: real1,
                 pressures: vector1, dofs: int2, gradient_x: vector1, gradient_y: vector1, gradient_z: vector1,
                 weights: vector1, mode_values: vector1, moduli: vector1, coefficients: real1, elements: int2,
                 past: real1, inherited: real3, largest: real2, stresses: real3, energies: real2,
                 volume_rates: vector1, gaps: vector1, forces: vector1, stiffness: vector1, on_modes: real1,
                 tangent: real2):
        ti.loop_config(serialize=True)
        for _ in range(1):
            kappa, remembers = settings[KAPPA], settings[REMEMBERS]
            modes = amplitudes.shape[0]
            for j in range(modes):
                on_modes[j] = 0.0
            least[0] = 1e30
            for b in range(moduli.shape[0]):
                stiff = 0.0
                if settings[TANGENT] > 0.0 and settings[FIRST] <= b and b < settings[LAST]:
                    stiff = 1.0
                if settings[FOLLOWS] > 0.0:
                    follow(b, modes, kappa, change, basis, pressures, moduli, volume_rates, gaps)
                for a in range(nodes):
                    at = (b * freedoms + 3 * a) * modes
                    u0, u1, u2 = vec(0.0), vec(0.0), vec(0.0)
                    for j in range(modes):
                        u0 = u0 + basis[at + j] * amplitudes[j]
                        u1 = u1 + basis[at + modes + j] * amplitudes[j]
                        u2 = u2 + basis[at + 2 * modes + j] * amplitudes[j]
                    for l in ti.static(range(LANES)):
                        place = dofs[b * nodes + a, l]
                        x[place], x[place + 1], x[place + 2] = u0[l], u1[l], u2[l]
                smallest = integrate(b, kappa, stiff, remembers, x, pressures, dofs, gradient_x, gradient_y,
                                     gradient_z, weights, mode_values, moduli, coefficients, elements, past, inherited,
                                     largest, stresses, energies, volume_rates, gaps, forces)
                least[0] = ti.min(least[0], smallest)
                for j in range(modes):
                    f0, f1, f2 = vec(0.0), vec(0.0), vec(0.0)
                    for a in range(nodes):
                        at, i = (b * freedoms + 3 * a) * modes + j, b * freedoms + 3 * a
                        f0 = f0 + basis[at] * forces[i]
                        f1 = f1 + basis[at + modes] * forces[i + 1]
                        f2 = f2 + basis[at + 2 * modes] * forces[i + 2]
                    on_modes[j] = on_modes[j] + (f0 + f1 + f2).sum()
                if stiff > 0.0:
                    stiffen(b, kappa, moduli, gradient_x, gradient_y, gradient_z, stiffness)
                    project(b, modes, basis, stiffness, tangent)

    return evaluate
