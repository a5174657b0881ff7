"""Files of meshes: what other programs write, as one type."""
