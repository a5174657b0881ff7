"""Age of the picture in a browser: frames of the viewer and their arrival, for `viewer`."""

from bisect import bisect_right

import numpy as np

#: Difference of heights that count as equal, in units of the browser.
_SAME = 1e-6
#: Longest duration of a message, s.
_LONGEST = 2.0


def pictures(frames: list, messages: list) -> dict:
    """Return the time from the tick of a picture to its arrival, and its parts, ms.

    Args:
        frames: frames of `worker`, in a run in which the tool moves.
        messages: messages of `client`.
    """
    sent = [message[0] for message in messages]
    ways = []
    for made, tick, _, height, _ in frames:
        if tick is None:
            continue
        for message in messages[bisect_right(sent, made):]:
            if message[0] > made + _LONGEST:
                break
            if any(abs(height - other) < _SAME for other in message[3]):
                ways.append((message[1] - tick, made - tick, message[0] - made, message[1] - message[0]))
                break
    columns = np.array(ways).reshape(-1, 4).T
    return {name: quantiles(column) for name, column
            in zip(("all", "until_the_frame", "until_sent", "until_arrived"), columns, strict=True)}


def readouts(frames: list, arrivals: list[tuple[float, str]]) -> dict:
    """Return the time from the tick of the read-outs to their arrival, ms.

    Args:
        frames: frames of `worker`. arrivals: times (s) and texts of the read-outs in the browser.
    """
    made, ages = [frame[0] for frame in frames], []
    for came, text in arrivals:
        candidates = frames[bisect_right(made, came - _LONGEST):bisect_right(made, came)]
        tick = next((frame[2] for frame in reversed(candidates) if frame[4] == text), None)
        if tick is not None:
            ages.append(came - tick)
    return quantiles(np.array(ages))


def sizes(frames: list, messages: list) -> dict:
    """Return messages and bytes per second of a run."""
    began, ended = frames[0][0], frames[-1][0]
    during = [message[2] for message in messages if began <= message[0] <= ended]
    return {"messages_per_s": len(during) / (ended - began), "kB_per_s": sum(during) / (ended - began) / 1e3}


def quantiles(seconds: np.ndarray) -> dict:
    """Return count, median and 95th percentile of times, ms.

    Args:
        seconds: times, s.
    """
    if not len(seconds):
        return {"count": 0, "p50": None, "p95": None}
    return {"count": len(seconds), **{name: 1e3 * float(np.quantile(seconds, share))
                                      for name, share in (("p50", 0.5), ("p95", 0.95))}}
