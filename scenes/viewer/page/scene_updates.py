"""Fast updates of scene nodes: each array or position is queued as one message, without viser's property setters.

A property assignment of viser costs 50 us per array, because viser rebuilds type hints, compares the array with the
previous one and copies it twice; a position costs the same, because it is compared with tolerances. A frame has twenty
new arrays and three new positions, so this module puts them directly into the message queue that the setters use. The
queue is a private part of the viser version that pyproject.toml pins; the browser tests check its behaviour by
reloading the page.
"""

from __future__ import annotations

import numpy as np
import viser
from viser import _messages


def send_scene_node_arrays(handle: viser.SceneNodeHandle, **arrays: np.ndarray) -> None:
    """Replace arrays of a node in all browsers, including those that connect later.

    Args:
        handle: Handle of the node. Its properties do not change: they return the arrays that were assigned last.
        arrays: Property name -> array in the type of the property. The caller must not modify the arrays afterwards.
    """
    handle._impl.api._queue_scene_message(_messages.SceneNodeUpdateMessage(handle.name, arrays))


def send_scene_node_position(handle: viser.SceneNodeHandle, position: tuple[float, float, float]) -> None:
    """Move a node in all browsers, including those that connect later; do nothing if the position is unchanged.

    Args:
        handle: Handle of the node.
        position: Position (x, y, z) relative to the parent node, browser units.
    """
    known = handle._impl.position
    if tuple(known) != position:
        known[:] = position
        handle._impl.api._queue_scene_message(_messages.SetPositionMessage(handle.name, position))
