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
from tissue_sim.public_names import make_getattr_for_old_names

__getattr__ = make_getattr_for_old_names(__name__, {"tip_mesh": "cylinder_mesh_refined_under_tip"})

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
