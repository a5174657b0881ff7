"""Taichi kernel of the forces and the stiffness of the sampled elements."""

from enum import IntEnum
from functools import cache

from tissue_sim.fem.history import MATERIAL_ARRAYS
from tissue_sim.fem.solid.element import ELEMENT_ARRAYS, AssemblySettingColumn, make_element_kernel_functions
from tissue_sim.fem.taichi.runtime import get_initialised_taichi
from tissue_sim.fem.taichi.shared_fields import LANES
from tissue_sim.laws import KernelEnergy
from tissue_sim.mesh.solid import SOLID_ELEMENTS


class SampledElementSettingColumn(IntEnum):
    """Additional columns of the array ``settings`` of the sampled elements, after those of `AssemblySettingColumn`."""

    #: Whether the pressures are updated with the linearised volume change of the last motion of the nodes.
    UPDATES_PRESSURE = 4
    #: Number of columns.
    COUNT = 5


@cache
def make_sampled_elements_kernel(element_name: str, energy: KernelEnergy):
    """Return the kernel of the nodal forces and, for requested groups of batches, the element stiffness.

    Arrays: ``x`` and ``motion`` are the nodal displacements and their last change, m. ``residual`` receives the nodal
    forces, N, ``blocks`` the stiffness matrix of the element in each lane, row by row, and ``least`` the smallest J.
    ``wanted`` states for each group whether its stiffness is computed. ``standing`` is the residual of the pressure
    equation at rest under self-weight, which is subtracted.
    """
    ti = get_initialised_taichi()
    element = SOLID_ELEMENTS[element_name]
    nodes, pressure_modes = element.node_count, element.pressure_modes
    freedoms = 3 * nodes
    integrate_forces, compute_stiffness_blocks = make_element_kernel_functions(element_name, energy)
    vec = ti.types.vector(LANES, ti.f64)
    real1 = ti.types.ndarray(ti.f64, ndim=1)
    single1 = ti.types.ndarray(ti.f32, ndim=1)
    int1 = ti.types.ndarray(ti.i32, ndim=1)
    vector1 = ti.types.ndarray(vec, ndim=1)

    @ti.func
    def update_batch_pressures_linearly(b, kappa, motion: ti.template(), elements: ti.template()):
        """Update the pressures of batch b by the linearised pressure equation and the last nodal ``motion``."""
        bulk = kappa * elements.moduli[b]
        for m in range(pressure_modes):
            at = b * pressure_modes + m
            gap = elements.gaps[at]
            for a in range(nodes):
                for k in ti.static(range(3)):
                    moved = ti.Vector([motion[elements.dofs[b * nodes + a][l] + k] for l in ti.static(range(LANES))])
                    gap = gap + elements.volume_rates[at * freedoms + 3 * a + k] * moved
            elements.pressures[at] = elements.pressures[at] + bulk * gap

    @ti.func
    def expand_stiffness_to_element_matrices(b, elements: ti.template(), blocks: ti.template()):
        """Copy the stiffness blocks of a batch to one full matrix for each element."""
        for c in range(nodes):
            for a in range(c + 1):
                # Index 3 k + i: force on node a along i for a displacement of node c along k.
                pair = 9 * (c * (c + 1) // 2 + a)
                for l in ti.static(range(LANES)):
                    first = (b * LANES + l) * freedoms * freedoms
                    below, above = first + freedoms * 3 * a + 3 * c, first + freedoms * 3 * c + 3 * a
                    for k in ti.static(range(3)):
                        for i in ti.static(range(3)):
                            K = ti.cast(elements.stiffness[pair + 3 * k + i][l], ti.f32)
                            blocks[below + freedoms * i + k] = K
                            blocks[above + freedoms * k + i] = K

    @ti.kernel
    def compute_sampled_nodal_forces_and_matrices(settings: real1, least: real1, batches: int1, x: real1, motion: real1,
                                                  residual: real1, groups: int1, wanted: real1, blocks: single1,
                                                  standing: vector1, element_table: int1, material_table: int1):
        """Compute nodal forces and the smallest J, and the stiffness matrices of the elements in wanted groups."""
        ti.loop_config(serialize=True)
        for _ in range(1):
            elements, material = ELEMENT_ARRAYS.open_table(element_table), MATERIAL_ARRAYS.open_table(material_table)
            kappa, remembers = settings[AssemblySettingColumn.KAPPA], settings[AssemblySettingColumn.REMEMBERS]
            least[0] = 1e30
            if settings[AssemblySettingColumn.ADDS] == 0.0:
                for i in range(residual.shape[0]):
                    residual[i] = 0.0
            for b in range(batches[0]):
                stiff = wanted[groups[b]]
                if settings[SampledElementSettingColumn.UPDATES_PRESSURE] > 0.0:
                    update_batch_pressures_linearly(b, kappa, motion, elements)
                smallest = integrate_forces(b, kappa, stiff, remembers, x, elements, material)
                least[0] = ti.min(least[0], smallest)
                bulk = kappa * elements.moduli[b]
                for m in range(pressure_modes):
                    at = b * pressure_modes + m
                    elements.gaps[at] = elements.gaps[at] - standing[at]
                for i in range(freedoms):
                    force = elements.forces[b * freedoms + i]
                    for m in range(pressure_modes):
                        at = b * pressure_modes + m
                        force = force - bulk * standing[at] * elements.volume_rates[at * freedoms + i]
                    for l in ti.static(range(LANES)):
                        e = elements.equations[b * freedoms + i][l]
                        residual[e] = residual[e] + force[l]
                if stiff > 0.0:
                    compute_stiffness_blocks(b, kappa, elements)
                    expand_stiffness_to_element_matrices(b, elements, blocks)

    return compute_sampled_nodal_forces_and_matrices
