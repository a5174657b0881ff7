"""Arrays and places of scene nodes, sent in one message each.

viser's own way, an assignment to a property, costs 50 us an array: it rebuilds type hints, compares with what was sent
before and copies twice; a place costs as much, for it is compared with tolerances. Twenty arrays and three places a
frame are made anew, so they go straight into the queue in which an assignment ends. This is a private part of the
version of viser that pyproject.toml pins; a browser that reloads the page, in the tests, sees that it still does what
it did.
"""

from __future__ import annotations

import numpy as np
import viser
from viser import _messages


def send_arrays(handle: viser.SceneNodeHandle, **arrays: np.ndarray) -> None:
    """Replace arrays of a node for everybody who looks, and for those who come later.

    Args:
        handle: of the node. It does not know what was sent: reading the property gives what was assigned last.
        arrays: by property, in its type; they belong to the message from now on.
    """
    handle._impl.api._queue_scene_message(_messages.SceneNodeUpdateMessage(handle.name, arrays))


def send_position(handle: viser.SceneNodeHandle, position: tuple[float, float, float]) -> None:
    """Move a node, for everybody who looks, and for those who come later; where it stands there already, do nothing.

    Args:
        handle: of the node.
        position: in its parent.
    """
    known = handle._impl.position
    if tuple(known) != position:
        known[:] = position
        handle._impl.api._queue_scene_message(_messages.SetPositionMessage(handle.name, position))
