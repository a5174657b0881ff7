"""Finite elements: mixed displacement-pressure quadrilaterals, compiled by Taichi, with a band Cholesky inside."""
