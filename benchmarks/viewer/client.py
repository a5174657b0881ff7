"""Client of the viewer's page that reads all messages and draws nothing, for `viewer`.

    python -m benchmarks client PORT

Says ``connected`` when it has all that a page begins with. When its input ends it prints one JSON object: the messages
that came, each as when it was sent and when it came (s of `time.monotonic`), bytes, heights of what was moved along the
axis, and the read-outs, or None.
"""

import json
import re
import sys
import threading
import time
from importlib.metadata import version

import msgspec
import zstandard
from websockets.sync.client import connect

#: What tells one frame's read-outs from another's.
READOUTS = ("force", "depth", "stiffness", "step-time")
#: viser takes a client for connected when it says where it looks from.
CAMERA = {"type": "ViewerCameraMessage", "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (0.0, -5.0, 2.0), "fov": 0.7,
          "near": 0.01, "far": 1000.0, "image_height": 700, "image_width": 1000, "look_at": (0.0, 0.0, 0.0),
          "up_direction": (0.0, 0.0, 1.0)}
_BEGINNING = "ReplayDoneMessage"


def readouts_in(html: str) -> str | None:
    """Return the read-outs in a piece of the page as one line; None: no read-outs."""
    found = dict(re.findall(r'data-testid="([a-z-]+)"[^>]*>([^<]*)<', html))
    return "|".join(found[name] for name in READOUTS) if all(name in found for name in READOUTS) else None


def decoded(packet: bytes) -> dict:
    """Decode the part before the arrays of a packet of viser 1.1: ``messages`` and ``timestampSec``."""
    length = int.from_bytes(packet[8:16], "little")
    return msgspec.msgpack.decode(zstandard.decompress(packet[16:16 + length]))


def described(came: float, size: int, packet: bytes) -> tuple:
    """Return a row of the report."""
    content = decoded(packet)
    heights, shown = [], None
    for message in content["messages"]:
        if message["type"] == "SetPositionMessage" and message["position"][:2] == [0.0, 0.0]:
            heights.append(message["position"][2])
        elif message["type"] == "GuiUpdateMessage" and isinstance(html := message["updates"].get("content"), str):
            shown = readouts_in(html) or shown
    return content["timestampSec"], came, size, heights, shown


def run_process() -> None:
    done, packets = threading.Event(), []
    threading.Thread(target=lambda: (sys.stdin.read(), done.set()), daemon=True).start()
    with connect(f"ws://127.0.0.1:{int(sys.argv[1])}/", subprotocols=[f"viser-v{version('viser')}"], compression=None,
                 max_size=None, proxy=None) as socket:
        socket.send(msgspec.msgpack.encode(CAMERA))
        while not any(message["type"] == _BEGINNING for message in decoded(socket.recv(timeout=30))["messages"]):
            pass
        print("connected", flush=True)
        while not done.is_set():
            try:
                packet = socket.recv(timeout=0.1)
            except TimeoutError:
                continue
            came, head = time.monotonic(), 16 + int.from_bytes(packet[8:16], "little")
            packets.append((came, len(packet), packet[:head]))
    print(json.dumps([described(*packet) for packet in packets]), flush=True)


if __name__ == "__main__":
    run_process()
