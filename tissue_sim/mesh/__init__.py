"""Meshes as arrays with named sets."""

from tissue_sim.mesh.axisymmetric import (
    Mesh,
    cylinder_mesh,
    graded_line,
    growing_line,
    needle_mesh,
    structured_mesh,
    tip_mesh,
    with_lines,
)

__all__ = ["Mesh", "cylinder_mesh", "graded_line", "growing_line", "needle_mesh", "structured_mesh", "tip_mesh",
           "with_lines"]
