"""Meshes of rectangular blocks, graded towards a tool or towards their edges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tissue_sim.errors import InputError
from tissue_sim.mesh.grading import Grading
from tissue_sim.mesh.section import Section, arc, side_of_box
from tissue_sim.mesh.solid import SolidMesh, block_mesh, inward_of, raised, with_tool_sets

#: Least half width of the box about a tool in which rings of elements lie, in radii of the tool; a side of the block
#: that is nearer than so many half widths is a side of the box.
_BOX, _NEAR = 2.0, 1.6
#: Between plates elements are finest at the edges, by this share of what they are at the edge of a tool's face, and
#: grow at least so fast.
_EDGE_SHARE, _EDGE_GROWTH = 0.7, 1.8


def block_under_plate(length: float, width: float, height: float, grading: Grading) -> SolidMesh:
    """A block between plates, fine towards all edges.

    Args:
        length, width, height: along x, y and z, m. grading: of its elements.
    """
    grading = replace(grading, smallest=_EDGE_SHARE * grading.smallest, growth=max(grading.growth, _EDGE_GROWTH))
    x, y, z = (grading.line_between(size) for size in (length, width, height))
    return block_mesh(x - 0.5 * length, y - 0.5 * width, grading.with_interfaces(z - height, height), grading.element)


def block_under_tool(length: float, width: float, height: float, grading: Grading) -> SolidMesh:
    """A block with rings of elements round a circle on its top (an O-grid), in a box of a few radii; rectangles beside
    it.

    Args:
        length, width, height: along x, y and z, m. grading: of its elements.

    Raises:
        InputError: a circle that reaches beyond the block.
    """
    radius, centre = grading.radius or 0.0, np.array(grading.centre)
    ends = np.array([[-0.5, 0.5]]) * np.array([[length], [width]])
    ways = np.abs(ends - centre[:, None])  # from the tool to the sides
    if (ends[:, 0] >= centre).any() or (centre >= ends[:, 1]).any() or ways.min() <= radius:
        raise InputError(f"a circle of radius {radius:g} m about ({centre[0]:g}, {centre[1]:g}) m reaches beyond the "
                         f"block of {length:g} x {width:g} m", field="centre")
    reach = max(_BOX * radius, ways.min())
    box_ways = np.where(ways < _NEAR * reach, ways, reach)
    low, high = centre - box_ways[:, 0], centre + box_ways[:, 1]
    section = Section(grading.element.order)
    section.add_disc(centre, radius, inward_of(grading, radius), grading.around)
    outward = grading.line(float(box_ways.max()) - radius)
    for quarter in range(4):
        section.add_ring(arc(quarter, radius, centre), side_of_box(quarter, low, high, centre),
                         outward / outward[-1], grading.around)
    last = min(max(outward[-1] - outward[-2], grading.smallest) * grading.growth, grading.largest)
    parts = []
    for axis in range(2):
        sides = replace(grading, smallest=last)
        before, after = (sides.line(float(way - box)) if way > box else np.zeros(1)
                         for way, box in zip(ways[axis], box_ways[axis], strict=True))
        beside = np.interp(np.linspace(0.0, 1.0, grading.around + 1), [0.0, 0.5, 1.0],
                           [low[axis], centre[axis], high[axis]])
        parts.append((low[axis] - before[::-1], beside, high[axis] + after))
    for i, x in enumerate(parts[0]):
        for j, y in enumerate(parts[1]):
            if (i, j) != (1, 1) and x.size > 1 and y.size > 1:
                section.add_rectangle(x, y)
    mesh = raised(section, grading.with_interfaces(-grading.line(height)[::-1], height), grading.element)
    return with_tool_sets(mesh, radius, grading.centre)
