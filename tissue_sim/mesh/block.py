"""Generate meshes of rectangular blocks, graded towards a tool or towards the edges of the block."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.mesh.grading import Grading
from tissue_sim.mesh.section import PlanarMesh, make_quarter_circle, make_rectangle_side
from tissue_sim.mesh.solid import (
    SolidMesh,
    add_face_and_free_node_sets,
    compute_inner_ring_radius_fractions,
    create_block_mesh_from_boundaries,
    extrude_section_to_mesh,
)
from tissue_sim.public_names import make_getattr_for_old_names

__getattr__ = make_getattr_for_old_names(__name__, {"block_under_plate": "create_block_mesh_under_plate",
                                                    "block_under_tool": "create_block_mesh_under_tool"})


@dataclass(frozen=True)
class BlockMeshSettings:
    """Proportions of the mesh of a block.

    Attributes:
        box: minimum half width of the box around a tool that contains the rings of elements, in radii of the tool, 1.
        near: distance of a side of the block from the tool, in half widths of the box, below which the side of the
            block is also a side of the box, 1.
        edge_size: size of the elements at the edges of a block between plates, as a fraction of the size at the edge
            of a tool's face, 1.
        edge_growth: minimum ratio of successive elements in a block between plates, 1.
    """

    box: float = 2.0
    near: float = 1.6
    edge_size: float = 0.7
    edge_growth: float = 1.8


_MESH = BlockMeshSettings()


def create_block_mesh_under_plate(length: float, width: float, height: float, grading: Grading) -> SolidMesh:
    """Create the mesh of a block between plates that cover its top and base, with small elements at all edges.

    Args:
        length: length along x, m.
        width: width along y, m.
        height: height along z, m.
        grading: sizes of the elements.
    """
    grading = replace(grading, smallest=_MESH.edge_size * grading.smallest,
                      growth=max(grading.growth, _MESH.edge_growth))
    x, y, z = (grading.divide_line_from_both_ends(size) for size in (length, width, height))
    return create_block_mesh_from_boundaries(x - 0.5 * length, y - 0.5 * width,
                                             grading.insert_interface_heights(z - height, height), grading.element)


def create_block_mesh_under_tool(length: float, width: float, height: float, grading: Grading) -> SolidMesh:
    """Create the mesh of a block under a tool: an O-grid around the tool in a box, and rectangles outside of the box.

    Args:
        length: length along x, m.
        width: width along y, m.
        height: height along z, m.
        grading: sizes of the elements, and circle of the tool.

    Raises:
        InputError: the circle of the tool is not inside the top of the block.
    """
    radius, centre = grading.radius or 0.0, np.array(grading.centre)
    ends = np.array([[-0.5, 0.5]]) * np.array([[length], [width]])
    distances = np.abs(ends - centre[:, None])  # from the tool to the sides
    if (ends[:, 0] >= centre).any() or (centre >= ends[:, 1]).any() or distances.min() <= radius:
        raise InputError(f"the circle of radius {radius:g} m about ({centre[0]:g}, {centre[1]:g}) m must be inside the "
                         f"block of {length:g} x {width:g} m", field="centre")
    reach = max(_MESH.box * radius, distances.min())
    half_widths = np.where(distances < _MESH.near * reach, distances, reach)
    low, high = centre - half_widths[:, 0], centre + half_widths[:, 1]
    section = PlanarMesh(grading.element.order)
    section.add_disc(centre, radius, compute_inner_ring_radius_fractions(grading, radius), grading.around)
    outward = grading.divide_line(float(half_widths.max()) - radius)
    for quarter in range(4):
        section.add_elements_between_curves(make_quarter_circle(quarter, radius, centre),
                                            make_rectangle_side(quarter, low, high, centre),
                                            outward / outward[-1], grading.around)
    last = min(max(outward[-1] - outward[-2], grading.smallest) * grading.growth, grading.largest)
    parts = []
    for axis in range(2):
        sides = replace(grading, smallest=last)
        before, after = (sides.divide_line(float(distance - box)) if distance > box else np.zeros(1)
                         for distance, box in zip(distances[axis], half_widths[axis], strict=True))
        within = np.interp(np.linspace(0.0, 1.0, grading.around + 1), [0.0, 0.5, 1.0],
                           [low[axis], centre[axis], high[axis]])
        parts.append((low[axis] - before[::-1], within, high[axis] + after))
    for i, x in enumerate(parts[0]):
        for j, y in enumerate(parts[1]):
            if (i, j) != (1, 1) and x.size > 1 and y.size > 1:
                section.add_rectangle(x, y)
    mesh = extrude_section_to_mesh(section, grading.insert_interface_heights(-grading.divide_line(height)[::-1],
                                                                             height), grading.element)
    return add_face_and_free_node_sets(mesh, radius, grading.centre)
