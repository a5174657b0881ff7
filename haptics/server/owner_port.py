"""Receive the packets of the owner of a tissue on a separate socket, and limit the replies to all other clients."""

from __future__ import annotations

import os
import socket
from contextlib import suppress
from dataclasses import dataclass

from haptics.server.steps import Address


@dataclass(frozen=True)
class ReplyRateLimit:
    """Token bucket for the replies to clients that do not own the tissue.

    Attributes:
        replies_per_second: replies per second and address, 1/s. A larger value takes more time from the owner.
        burst: replies to one address that may follow each other at once.
        most_addresses: largest number of addresses that are remembered; packets of further addresses are dropped.
    """

    replies_per_second: float = 100.0
    burst: float = 20.0
    most_addresses: int = 64


#: Rate limit of every server.
RATE_LIMIT = ReplyRateLimit()


def open_owner_socket_or_none(owner: Address, port: socket.socket) -> socket.socket | None:
    """Open a socket on the same port that receives only the packets of the owner, so that no flood fills its buffer.

    Linux delivers a packet to the socket that is connected to its sender, and to an unconnected socket otherwise.

    Args:
        owner: address of the owner.
        port: bound socket that receives the packets of all other clients.

    Returns:
        The connected socket. None if the operating system does not allow two sockets on a port; the packets of the
        owner then arrive at `port`.
    """
    if os.name != "posix":
        return None
    connected = socket.socket(port.family, socket.SOCK_DGRAM)
    try:
        connected.setblocking(False)
        # The option is set only during the bind: with it, other programs could also share the port.
        for each in (port, connected):
            each.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        connected.bind(port.getsockname())
        connected.connect(owner)
    except OSError:
        connected.close()
        return None
    finally:
        for each in (port, connected):
            with suppress(OSError):
                each.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 0)
    return connected


class ReplyLimiter:
    """Limit the replies to each address by a token bucket.

    The bucket holds `ReplyRateLimit.burst` tokens and gains `ReplyRateLimit.replies_per_second`; a reply costs one.
    """

    def __init__(self):
        #: Address -> remaining tokens, and time of their last update, s.
        self._buckets: dict[Address, tuple[float, float]] = {}

    def take_token(self, address: Address, now: float) -> bool:
        """Use one token of an address; return False if it has no token, so that its packet must be dropped.

        A new address is refused while `ReplyRateLimit.most_addresses` other addresses are active.

        Args:
            address: address of the sender.
            now: time on the clock of the server, s.
        """
        limit = RATE_LIMIT
        tokens, before = self._buckets.get(address, (limit.burst, now))
        if address not in self._buckets and len(self._buckets) >= limit.most_addresses:
            refill_time = limit.burst / limit.replies_per_second
            self._buckets = {each: bucket for each, bucket in self._buckets.items() if now - bucket[1] < refill_time}
            if len(self._buckets) >= limit.most_addresses:
                return False
        tokens = min(limit.burst, tokens + (now - before) * limit.replies_per_second)
        if tokens < 1.0:
            # Store the new time too, so that each interval adds tokens only once.
            self._buckets[address] = (tokens, now)
            return False
        self._buckets[address] = (tokens - 1.0, now)
        return True
