"""Forces and stiffness of sampled elements at places of their nodes, as a Taichi kernel."""

from functools import cache

from tissue_sim.fem.solid.batches import LANES
from tissue_sim.fem.solid.element import SettingColumn, element_functions
from tissue_sim.fem.taichi.runtime import initialise
from tissue_sim.laws import KernelEnergy
from tissue_sim.mesh.solid import SOLID_ELEMENTS

#: Places in `settings` beside those of the elements: whether the pressures follow a motion of the nodes.
FOLLOWS, SETTINGS = 4, 5


@cache
def elements_kernel(element_name: str, energy: KernelEnergy):
    """Kernel of the forces of the nodes, and of the stiffness of those groups of batches that are wanted.

    ``x`` and ``motion`` are displacements of the nodes and their last change, ``residual`` gets their forces,
    ``blocks`` the stiffness of each lane's element, row by row; ``least`` gets the smallest J. ``standing`` is by how
    much volumes miss less than they seem to.
    """
    ti = initialise()
    element = SOLID_ELEMENTS[element_name]
    nodes, pressure_modes = element.nodes, element.pressure_modes
    freedoms = 3 * nodes
    integrate, stiffen = element_functions(element_name, energy)
    vec = ti.types.vector(LANES, ti.f64)
    real1, real2, real3 = (ti.types.ndarray(ti.f64, ndim=n) for n in (1, 2, 3))
    single1 = ti.types.ndarray(ti.f32, ndim=1)
    int1, int2 = (ti.types.ndarray(ti.i32, ndim=n) for n in (1, 2))
    vector1 = ti.types.ndarray(vec, ndim=1)

    @ti.func
    def follow(b, kappa, motion: ti.template(), dofs: ti.template(), pressures: ti.template(), moduli: ti.template(),
               volume_rates: ti.template(), gaps: ti.template()):
        """Let the pressures of a batch follow a linear solution."""
        bulk = kappa * moduli[b]
        for m in range(pressure_modes):
            at = b * pressure_modes + m
            gap = gaps[at]
            for a in range(nodes):
                for k in ti.static(range(3)):
                    moved = ti.Vector([motion[dofs[b * nodes + a, l] + k] for l in ti.static(range(LANES))])
                    gap = gap + volume_rates[at * freedoms + 3 * a + k] * moved
            pressures[at] = pressures[at] + bulk * gap

    @ti.func
    def spread(b, stiffness: ti.template(), blocks: ti.template()):
        """Write the stiffness of a batch element by element."""
        for c in range(nodes):
            for a in range(c + 1):
                # The force on a along i for a motion of c along k stands at 3 k + i.
                pair = 9 * (c * (c + 1) // 2 + a)
                for l in ti.static(range(LANES)):
                    first = (b * LANES + l) * freedoms * freedoms
                    below, above = first + freedoms * 3 * a + 3 * c, first + freedoms * 3 * c + 3 * a
                    for k in ti.static(range(3)):
                        for i in ti.static(range(3)):
                            K = ti.cast(stiffness[pair + 3 * k + i][l], ti.f32)
                            blocks[below + freedoms * i + k] = K
                            blocks[above + freedoms * k + i] = K

    @ti.kernel
    def evaluate(settings: real1, least: real1, x: real1, motion: real1, residual: real1, pressures: vector1,
                 dofs: int2, equations: int2, gradient_x: vector1, gradient_y: vector1, gradient_z: vector1,
                 weights: vector1, mode_values: vector1, moduli: vector1, coefficients: real1, elements: int2,
                 past: real1, inherited: real3, largest: real2, stresses: real3, energies: real2,
                 volume_rates: vector1, gaps: vector1, forces: vector1, stiffness: vector1, groups: int1,
                 wanted: real1, blocks: single1, standing: vector1):
        ti.loop_config(serialize=True)
        for _ in range(1):
            kappa, remembers = settings[SettingColumn.KAPPA], settings[SettingColumn.REMEMBERS]
            least[0] = 1e30
            if settings[SettingColumn.ADDS] == 0.0:
                for i in range(residual.shape[0]):
                    residual[i] = 0.0
            for b in range(moduli.shape[0]):
                stiff = wanted[groups[b]]
                if settings[FOLLOWS] > 0.0:
                    follow(b, kappa, motion, dofs, pressures, moduli, volume_rates, gaps)
                smallest = integrate(b, kappa, stiff, remembers, x, pressures, dofs, gradient_x, gradient_y,
                                     gradient_z, weights, mode_values, moduli, coefficients, elements, past, inherited,
                                     largest, stresses, energies, volume_rates, gaps, forces)
                least[0] = ti.min(least[0], smallest)
                bulk = kappa * moduli[b]
                for m in range(pressure_modes):
                    gaps[b * pressure_modes + m] = gaps[b * pressure_modes + m] - standing[b * pressure_modes + m]
                for i in range(freedoms):
                    force = forces[b * freedoms + i]
                    for m in range(pressure_modes):
                        at = b * pressure_modes + m
                        force = force - bulk * standing[at] * volume_rates[at * freedoms + i]
                    for l in ti.static(range(LANES)):
                        e = equations[b * freedoms + i, l]
                        residual[e] = residual[e] + force[l]
                if stiff > 0.0:
                    stiffen(b, kappa, moduli, gradient_x, gradient_y, gradient_z, stiffness)
                    spread(b, stiffness, blocks)

    return evaluate
