"""Assembly of the elements of a solid: nodal forces and sparse stiffness matrix, as a Taichi kernel."""

from functools import cache

from tissue_sim.fem.history import MATERIAL_ARRAYS
from tissue_sim.fem.solid.element import ELEMENT_ARRAYS, AssemblySettingColumn, make_element_kernel_functions
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.fem.taichi.shared_fields import LANES
from tissue_sim.laws import KernelEnergy
from tissue_sim.mesh.solid import SOLID_ELEMENTS


@cache
def make_assembly_kernel(element_name: str, energy: KernelEnergy):
    """Return the kernel that assembles the nodal forces, and the tangent if the array `settings` requests it.

    The kernel adds the forces, N, to the array ``residual`` and the stiffness, N/m, to ``data``, and writes the
    smallest volume ratio J of all quadrature points to ``least[0]``. ``batches[0]`` is the number of batches. The
    columns of ``settings`` are `AssemblySettingColumn`.

    Args:
        element_name: a key of `SOLID_ELEMENTS`.
        energy: strain energy of the material.
    """
    ti = get_initialised_taichi()
    nodes = SOLID_ELEMENTS[element_name].node_count
    pairs = nodes * (nodes + 1) // 2
    integrate_forces, compute_stiffness_blocks = make_element_kernel_functions(element_name, energy)
    real1, int1 = ti.types.ndarray(ti.f64, ndim=1), ti.types.ndarray(ti.i32, ndim=1)

    @ti.kernel
    def assemble_forces_and_tangent(settings: real1, least: real1, batches: int1, x: real1, residual: real1,
                                    data: real1, element_table: int1, material_table: int1):
        """Assemble the nodal forces of all batches, and the stiffness if requested; see `make_assembly_kernel`."""
        # One pass of one serial task, started without waking a thread pool.
        ti.loop_config(serialize=True)
        for _ in range(1):
            elements, material = ELEMENT_ARRAYS.open_table(element_table), MATERIAL_ARRAYS.open_table(material_table)
            kappa, tangent = settings[AssemblySettingColumn.KAPPA], settings[AssemblySettingColumn.TANGENT]
            remembers = settings[AssemblySettingColumn.REMEMBERS]
            if settings[AssemblySettingColumn.ADDS] == 0.0:
                for i in range(residual.shape[0]):
                    residual[i] = 0.0
            if tangent > 0.0 and settings[AssemblySettingColumn.ADDS] == 0.0:
                for i in range(data.shape[0]):
                    data[i] = 0.0
            least[0] = 1e30
            for b in range(batches[0]):
                smallest = integrate_forces(b, kappa, tangent, remembers, x, elements, material)
                least[0] = ti.min(least[0], smallest)
                for i in range(3 * nodes):
                    f, at = elements.forces[3 * b * nodes + i], elements.equations[3 * b * nodes + i]
                    for l in ti.static(range(LANES)):
                        residual[at[l]] = residual[at[l]] + f[l]
                if tangent > 0.0:
                    compute_stiffness_blocks(b, kappa, elements)
                    for i in range(9 * pairs):
                        place = b * 9 * pairs + i
                        at, mirror = elements.places[place], elements.mirrored[place]
                        stiffness = elements.stiffness[i]
                        for l in ti.static(range(LANES)):
                            data[at[l]] = data[at[l]] + stiffness[l]
                            data[mirror[l]] = data[mirror[l]] + stiffness[l]

    return assemble_forces_and_tangent
