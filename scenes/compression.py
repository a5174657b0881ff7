"""Compression of a cylinder between plates."""

from scenes.scene import Scene

LUBRICATED = Scene("lubricated_compression", "Lubricated compression", friction="frictionless",
                   friction_base="frictionless")
BONDED = Scene("bonded_compression", "Bonded compression", friction="bonded", friction_base="bonded")
