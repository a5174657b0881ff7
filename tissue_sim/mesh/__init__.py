"""Meshes of round specimens as arrays with named node sets, and functions that generate them."""

from tissue_sim.mesh.axisymmetric import (
    Mesh,
    cylinder_mesh,
    cylinder_mesh_refined_under_needle,
    cylinder_mesh_refined_under_tip,
    divide_into_graded_intervals,
    divide_into_growing_intervals,
    insert_interfaces_and_refine_layers,
    structured_mesh,
)
from tissue_sim.public_names import make_getattr_for_old_names

__getattr__ = make_getattr_for_old_names(__name__, {
    "tip_mesh": "cylinder_mesh_refined_under_tip", "needle_mesh": "cylinder_mesh_refined_under_needle",
    "graded_line": "divide_into_graded_intervals", "growing_line": "divide_into_growing_intervals",
    "with_lines": "insert_interfaces_and_refine_layers"})

__all__ = [
    "Mesh",
    "cylinder_mesh",
    "cylinder_mesh_refined_under_needle",
    "cylinder_mesh_refined_under_tip",
    "divide_into_graded_intervals",
    "divide_into_growing_intervals",
    "insert_interfaces_and_refine_layers",
    "structured_mesh",
]
