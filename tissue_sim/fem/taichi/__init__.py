"""Taichi: one runtime for the process, and kernels that start fast."""
