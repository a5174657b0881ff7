"""Taichi: initialisation, fast launch of kernels, scratch memory, and tracing of plug-in formulas into kernels."""
