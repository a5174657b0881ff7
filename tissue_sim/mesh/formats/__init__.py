"""Readers of mesh files of other programs, which return the common type `MeshContent`."""
