"""Meshes of round specimens as arrays with named node sets, and functions that generate them."""

from tissue_sim.mesh.axisymmetric import (
    Mesh,
    cylinder_mesh,
    cylinder_mesh_refined_under_tip,
    graded_line,
    growing_line,
    needle_mesh,
    structured_mesh,
    with_lines,
)

__all__ = [
    "Mesh",
    "cylinder_mesh",
    "cylinder_mesh_refined_under_tip",
    "graded_line",
    "growing_line",
    "needle_mesh",
    "structured_mesh",
    "with_lines",
]
