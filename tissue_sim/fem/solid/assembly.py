"""Assembly of the elements of a solid: nodal forces and sparse stiffness matrix, as a Taichi kernel."""

from functools import cache

from tissue_sim.fem.solid.element import AssemblySettingColumn, make_element_functions
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.fem.taichi.shared_fields import LANES
from tissue_sim.laws import KernelEnergy
from tissue_sim.mesh.solid import SOLID_ELEMENTS


@cache
def make_assembly_kernel(element_name: str, energy: KernelEnergy):
    """Return the kernel that assembles the nodal forces, and the tangent if the array `settings` requests it.

    The kernel adds the forces, N, to the array ``residual`` and the stiffness, N/m, to ``data``, and writes the
    smallest volume ratio J of all quadrature points to ``least[0]``. The columns of ``settings`` are
    `AssemblySettingColumn`.

    Args:
        element_name: a key of `SOLID_ELEMENTS`.
        energy: strain energy of the material.
    """
    ti = get_initialised_taichi()
    nodes = SOLID_ELEMENTS[element_name].node_count
    pairs = nodes * (nodes + 1) // 2
    integrate_forces, compute_stiffness_blocks = make_element_functions(element_name, energy)
    vec = ti.types.vector(LANES, ti.f64)
    real1, real2, real3 = (ti.types.ndarray(ti.f64, ndim=n) for n in (1, 2, 3))
    int2 = ti.types.ndarray(ti.i32, ndim=2)
    vector1 = ti.types.ndarray(vec, ndim=1)

    @ti.kernel
    def assemble_forces_and_tangent(settings: real1, least: real1, x: real1, pressures: vector1, dofs: int2,
                                    equations: int2,
                                    gradient_x: vector1, gradient_y: vector1, gradient_z: vector1, weights: vector1,
                                    mode_values: vector1,
                                    moduli: vector1, coefficients: real1, elements: int2, past: real1, inherited: real3,
                                    largest: real2,
                                    stresses: real3, energies: real2, volume_rates: vector1, gaps: vector1,
                                    forces: vector1,
                                    stiffness: vector1, scattered: real1, places: int2, mirrored: int2, residual: real1,
                                    data: real1):
        """Assemble the nodal forces of all batches, and the stiffness if requested; see `make_assembly_kernel`."""
        # One pass of one serial task, started without waking a thread pool.
        ti.loop_config(serialize=True)
        for _ in range(1):
            kappa, tangent = settings[AssemblySettingColumn.KAPPA], settings[AssemblySettingColumn.TANGENT]
            remembers = settings[AssemblySettingColumn.REMEMBERS]
            if settings[AssemblySettingColumn.ADDS] == 0.0:
                for i in range(residual.shape[0]):
                    residual[i] = 0.0
            if tangent > 0.0 and settings[AssemblySettingColumn.ADDS] == 0.0:
                for i in range(data.shape[0]):
                    data[i] = 0.0
            least[0] = 1e30
            for b in range(moduli.shape[0]):
                smallest = integrate_forces(b, kappa, tangent, remembers, x, pressures, dofs, gradient_x, gradient_y,
                                            gradient_z, weights, mode_values, moduli, coefficients, elements, past,
                                            inherited, largest, stresses, energies, volume_rates, gaps, forces)
                least[0] = ti.min(least[0], smallest)
                for i in range(3 * nodes):
                    f = forces[3 * b * nodes + i]
                    for l in ti.static(range(LANES)):
                        at = equations[3 * b * nodes + i, l]
                        residual[at] = residual[at] + f[l]
                if tangent > 0.0:
                    compute_stiffness_blocks(b, kappa, moduli, gradient_x, gradient_y, gradient_z, stiffness)
                    for i in range(9 * pairs * LANES):
                        at, mirror = places[b, i], mirrored[b, i]
                        data[at] = data[at] + scattered[i]
                        data[mirror] = data[mirror] + scattered[i]

    return assemble_forces_and_tangent
