"""Arrays of a scene node, sent in one message.

viser's own way, an assignment to a property, costs 50 us an array: it rebuilds type hints, compares with what was sent
before and copies twice. Twenty arrays a frame are made anew and never touched again, so they go straight into the queue
in which an assignment ends. This is a private part of the version of viser that pyproject.toml pins; a browser that
reloads the page, in the tests, sees that it still does what it did.
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
