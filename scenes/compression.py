"""Compression of a cylinder between plates."""

from scenes.scene import Scene

LUBRICATED = Scene("lubricated_compression", "Lubricated compression", friction="frictionless",
                   friction_base="frictionless")
BONDED = Scene("bonded_compression", "Bonded compression", friction="bonded", friction_base="bonded")
#: Dry plates: from about 0.5 on more friction makes no difference, as nearly all of the faces sticks.
FRICTION = Scene("friction_compression", "Compression with friction", friction=0.7, friction_base=0.7)
