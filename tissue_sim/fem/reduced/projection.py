"""Forces and stiffness of sampled elements on the modes of a reduced solid, as a Taichi kernel."""

from functools import cache

from tissue_sim.fem.solid.batches import LANES
from tissue_sim.fem.solid.element import KAPPA, REMEMBERS, SCRATCH, element_functions
from tissue_sim.fem.taichi.runtime import initialise
from tissue_sim.fem.taichi.scratch import scratch
from tissue_sim.laws import KernelEnergy
from tissue_sim.mesh.solid import SOLID_ELEMENTS

#: Places in `settings` beside those of the elements: whether the pressures follow a change of the amplitudes.
FOLLOWS, SETTINGS = 4, 5


@cache
def projection_kernel(element_name: str, energy: KernelEnergy):
    """Kernel of the forces on each mode, and of the stiffness between them of those groups of batches that are wanted.

    ``basis`` holds what each mode moves, shape (batches times freedoms of an element times modes), with the lanes last;
    there is an even number of them. ``tangents`` of the groups get their upper halves; ``least`` gets the smallest J.
    """
    ti = initialise()
    element = SOLID_ELEMENTS[element_name]
    nodes, pressure_modes = element.nodes, element.pressure_modes
    freedoms = 3 * nodes
    integrate, stiffen = element_functions(element_name, energy)
    vec = ti.types.vector(LANES, ti.f64)
    s = scratch(LANES, SCRATCH + 2 * freedoms)
    real1, real2, real3 = (ti.types.ndarray(ti.f64, ndim=n) for n in (1, 2, 3))
    int1, int2 = (ti.types.ndarray(ti.i32, ndim=n) for n in (1, 2))
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
            s[SCRATCH + i] = moved
        for m in range(pressure_modes):
            at = b * pressure_modes + m
            gap = gaps[at]
            for i in range(freedoms):
                gap = gap + volume_rates[at * freedoms + i] * s[SCRATCH + i]
            pressures[at] = pressures[at] + bulk * gap

    @ti.func
    def project(b, modes, group, basis: ti.template(), stiffness: ti.template(), tangents: ti.template()):
        """Add the stiffness of a batch between the modes to that of its group; two modes at a time share what is read
        of the stiffness."""
        for half in range(modes // 2):
            j = 2 * half
            for i in range(2 * freedoms):
                s[SCRATCH + i] = vec(0.0)
            for c in range(nodes):
                at_c = (b * freedoms + 3 * c) * modes + j
                C = [basis[at_c + k * modes] for k in ti.static(range(3))]
                D = [basis[at_c + k * modes + 1] for k in ti.static(range(3))]
                Y = [s[SCRATCH + 6 * c + i] for i in ti.static(range(6))]
                for a in range(c):
                    # The force on a along i for a motion of c along k stands at 3 k + i.
                    pair = 9 * (c * (c + 1) // 2 + a)
                    at_a = (b * freedoms + 3 * a) * modes + j
                    for i in ti.static(range(3)):
                        moved_a, moved_e = basis[at_a + i * modes], basis[at_a + i * modes + 1]
                        one, other = s[SCRATCH + 6 * a + i], s[SCRATCH + 6 * a + 3 + i]
                        for k in ti.static(range(3)):
                            K = stiffness[pair + 3 * k + i]
                            one = one + K * C[k]
                            other = other + K * D[k]
                            Y[k] = Y[k] + K * moved_a
                            Y[ti.static(3 + k)] = Y[ti.static(3 + k)] + K * moved_e
                        s[SCRATCH + 6 * a + i] = one
                        s[SCRATCH + 6 * a + 3 + i] = other
                own = 9 * (c * (c + 1) // 2 + c)
                for i in ti.static(range(3)):
                    one, other = Y[i], Y[ti.static(3 + i)]
                    for k in ti.static(range(3)):
                        K = stiffness[own + 3 * k + i]
                        one = one + K * C[k]
                        other = other + K * D[k]
                    s[SCRATCH + 6 * c + i] = one
                    s[SCRATCH + 6 * c + 3 + i] = other
            for h in range(j + 2):
                y0, y1, y2 = vec(0.0), vec(0.0), vec(0.0)
                z0, z1, z2 = vec(0.0), vec(0.0), vec(0.0)
                for c in range(nodes):
                    at = (b * freedoms + 3 * c) * modes + h
                    m0, m1, m2 = basis[at], basis[at + modes], basis[at + 2 * modes]
                    row = SCRATCH + 6 * c
                    y0, y1, y2 = y0 + m0 * s[row], y1 + m1 * s[row + 1], y2 + m2 * s[row + 2]
                    z0, z1, z2 = z0 + m0 * s[row + 3], z1 + m1 * s[row + 4], z2 + m2 * s[row + 5]
                if h <= j:
                    tangents[group, h, j] = tangents[group, h, j] + (y0 + y1 + y2).sum()
                tangents[group, h, j + 1] = tangents[group, h, j + 1] + (z0 + z1 + z2).sum()

    @ti.kernel
    def evaluate(settings: real1, least: real1, amplitudes: real1, change: real1, basis: vector1, x: real1,
                 pressures: vector1, dofs: int2, gradient_x: vector1, gradient_y: vector1, gradient_z: vector1,
                 weights: vector1, mode_values: vector1, moduli: vector1, coefficients: real1, elements: int2,
                 past: real1, inherited: real3, largest: real2, stresses: real3, energies: real2,
                 volume_rates: vector1, gaps: vector1, forces: vector1, stiffness: vector1, on_modes: real1,
                 groups: int1, wanted: real1, tangents: real3):
        ti.loop_config(serialize=True)
        for _ in range(1):
            kappa, remembers = settings[KAPPA], settings[REMEMBERS]
            modes = amplitudes.shape[0]
            for j in range(modes):
                on_modes[j] = 0.0
            least[0] = 1e30
            for g in range(wanted.shape[0]):
                if wanted[g] > 0.0:
                    for h in range(modes):
                        for j in range(modes):
                            tangents[g, h, j] = 0.0
            for b in range(moduli.shape[0]):
                stiff = wanted[groups[b]]
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
                    project(b, modes, groups[b], basis, stiffness, tangents)

    return evaluate
