"""Finite-element solvers of soft tissue under a rigid tool (axisymmetric, 3D solid, reduced), and shared modules."""
