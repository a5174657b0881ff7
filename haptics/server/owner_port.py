"""Packets of the owner of a tissue, kept apart from those of everybody else; and how often strangers are answered."""

from __future__ import annotations

import os
import socket
from contextlib import suppress

from haptics.server.steps import Address

#: A stranger is answered so often a second, and so often at once at most; so many are remembered.
ANSWERS_PER_SECOND, BURST, MOST_STRANGERS = 100.0, 20.0, 64


def open_for(owner: Address, port: socket.socket) -> socket.socket | None:
    """A socket on the same port that takes the owner's packets only, so that no flood fills its buffer.

    Linux gives a packet to the socket that is connected to its sender before it gives it to one that is not. Where the
    system does not let two sockets share a port the answer is None, and the owner's packets come with all others.

    Args:
        owner: where its packets come from.
        port: bound; it takes those of all others.
    """
    if os.name != "posix":
        return None
    own = socket.socket(port.family, socket.SOCK_DGRAM)
    try:
        own.setblocking(False)
        # Only for the moment: with it another program could share the port, too.
        for each in (port, own):
            each.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        own.bind(port.getsockname())
        own.connect(owner)
    except OSError:
        own.close()
        return None
    finally:
        for each in (port, own):
            with suppress(OSError):
                each.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
    return own


class Allowance:
    """How often each stranger may be answered: `ANSWERS_PER_SECOND`, after `BURST` at once."""

    def __init__(self):
        #: Address -> answers that are left, and when that was, s.
        self._left: dict[Address, tuple[float, float]] = {}

    def takes(self, address: Address, now: float) -> bool:
        """Whether a packet from there is looked at; `now` in s.

        Strangers beyond the number that is remembered are not, until one of those has been quiet for long enough.
        """
        left, before = self._left.get(address, (BURST, now))
        if address not in self._left and len(self._left) >= MOST_STRANGERS:
            quiet = BURST / ANSWERS_PER_SECOND
            self._left = {each: known for each, known in self._left.items() if now - known[1] < quiet}
            if len(self._left) >= MOST_STRANGERS:
                return False
        left = min(BURST, left + (now - before) * ANSWERS_PER_SECOND)
        if left < 1.0:
            # The time since the packet before counts once.
            self._left[address] = (left, now)
            return False
        self._left[address] = (left - 1.0, now)
        return True
