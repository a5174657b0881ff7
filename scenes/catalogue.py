"""The scenes by name."""

from scenes.compression import BONDED, FRICTION, LUBRICATED
from scenes.needle import NEEDLE
from scenes.scene import Scene

SCENES: dict[str, Scene] = {scene.name: scene for scene in (LUBRICATED, BONDED, FRICTION, NEEDLE)}
