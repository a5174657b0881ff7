"""CPU time and lost packets of a force sensor at 7 kHz: RDT over loopback, with two sizes of the receive buffer.

Three clients take turns, each in a separate process, at our emulator in another one: ours with its receive buffer,
ours with the system's, and pynetft (PyPI), whose receiver is compiled. Each gives every sample to Python: ours in lists
of what came in 5 ms, pynetft by a call for each. The emulator is Python, and sends what its sensor has sampled at most
every half millisecond: datagrams come a few at a time, closer together than those of a box.
"""

import argparse
import json
import multiprocessing
import os
import platform
import socket
import statistics
import time
from contextlib import ExitStack
from dataclasses import replace
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from multiprocessing.connection import Connection
from typing import Any

from haptics.devices import rdt as client
from haptics.devices.virtual.force_sensor import VirtualForceSensor
from haptics.emulators.rdt import RdtEmulator
from haptics.protocols import rdt

#: Sampling rate of the sensor, Hz.
RATE = 7000.0
#: Time between two readings of the client, s.
LOOK = 5e-3
LOAD = (0.1, -0.2, 3.0, 0.01, 0.02, -0.03)
CLIENTS = {"ours": "ours, large buffer", "ours_default": "ours, the system's buffer", "pynetft": "pynetft"}
#: The emulator and the client start before the numbers count, s.
_SETTLE = 0.5


def emulate(pipe: Connection, rate: float) -> None:
    """Run the emulator: report its address, and at the end the number of packets and its CPU time."""
    with RdtEmulator(VirtualForceSensor(lambda time: LOAD, rdt.CHANNELS, rate, 1e-4)) as emulator:
        pipe.send(emulator.address)
        pipe.recv()
    pipe.send({"sent": emulator.sent, "cpu_s": time.process_time()})


def receive(pipe: Connection, name: str, address: str, seconds: float) -> None:
    """Run a client: report received and faulty packets and the CPU time of the process."""
    host, _, rest = address.removeprefix("rdt://").partition(":")
    port, _, http_port = rest.partition(",http_port=")
    pipe.send((_pynetft if name == "pynetft" else _ours)(host, int(port), int(http_port), seconds, name))


def _ours(host: str, port: int, http_port: int, seconds: float, name: str) -> dict[str, Any]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as fresh:
        default = fresh.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
        if name == "ours_default":
            # Linux doubles the requested size.
            client.STREAM = replace(client.STREAM, receive_buffer=default // 2)
        fresh.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, client.STREAM.receive_buffer)
        buffer = fresh.getsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF)
    sensor = client.RdtSensor(host, port, http_port)
    sensor.start()
    time.sleep(_SETTLE)
    sensor.read()
    before, cpu, began = sensor.describe(), time.process_time(), time.monotonic()
    taken = 0
    while (passed := time.monotonic() - began) < seconds:
        time.sleep(LOOK)
        taken += len(sensor.read())
    cpu, after = time.process_time() - cpu, sensor.describe()
    sensor.stop()
    counted = {key: after[key] - before[key] for key in ("records", "lost", "late", "twice", "garbled", "overflowed")}
    return {**counted, "taken": taken, "seconds": passed, "cpu_s": cpu, "buffer_bytes": buffer}


def _pynetft(host: str, port: int, http_port: int, seconds: float, name: str) -> dict[str, Any]:
    import pynetft

    taken = 0

    def take(sample: Any) -> None:
        nonlocal taken
        taken += 1

    peer = pynetft.Client(pynetft.Config(sensor_host=host, rdt_port=port, http_port=http_port, receive_timeout=5.0,
                                         configuration_timeout=10.0), queue_size=1 << 16)
    peer.start(take)
    time.sleep(_SETTLE)
    before, first, cpu, began = peer.health(), taken, time.process_time(), time.monotonic()
    while (passed := time.monotonic() - began) < seconds:
        time.sleep(LOOK)
    cpu, after, last = time.process_time() - cpu, peer.health(), taken
    peer.stop()
    return {"records": after.received_count - before.received_count, "lost": after.lost_count - before.lost_count,
            "late": after.out_of_order_count - before.out_of_order_count,
            "twice": after.duplicate_count - before.duplicate_count,
            "garbled": after.malformed_count - before.malformed_count, "overflowed": None,
            "taken": last - first, "seconds": passed, "cpu_s": cpu, "buffer_bytes": None}


def spin() -> None:
    """Keep one core busy for ever."""
    while True:
        pass


def measure(name: str, seconds: float, rate: float) -> dict[str, Any]:
    """Measure one client for a number of seconds."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    emulator = context.Process(target=emulate, args=(theirs, rate))
    emulator.start()
    address = ours.recv()
    here, there = context.Pipe()
    process = context.Process(target=receive, args=(there, name, address, seconds))
    process.start()
    there.close()
    try:
        answer = here.recv()
    finally:
        process.join()
        ours.send(None)
        sent = ours.recv()
        emulator.join()
    packets = answer["records"]
    return {**answer, "client": name, "rate_Hz": packets / answer["seconds"],
            "cpu_us_per_packet": 1e6 * answer["cpu_s"] / packets,
            "lost_percent": 100 * answer["lost"] / (packets + answer["lost"]),
            "emulator_cpu_us_per_packet": 1e6 * sent["cpu_s"] / sent["sent"]}


def summary(runs: list[dict[str, Any]], name: str) -> dict[str, Any]:
    """Return medians with smallest and largest values of a client, and the sum of lost packets."""
    chosen = [run for run in runs if run["client"] == name]
    sums = {key: sum(run[key] for run in chosen) for key in ("records", "lost", "late", "twice", "garbled")}
    medians = {key: [statistics.median(values), min(values), max(values)]
               for key in ("rate_Hz", "cpu_us_per_packet", "lost_percent", "emulator_cpu_us_per_packet")
               if (values := [run[key] for run in chosen])}
    return {"client": CLIENTS[name], "runs": len(chosen), **sums, **medians, "buffer_bytes": chosen[0]["buffer_bytes"]}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0, help="of each run (%(default)g)")
    parser.add_argument("--runs", type=int, default=3, help="of each client, in turn (%(default)d)")
    parser.add_argument("--rate-hz", type=float, default=RATE, help="of the sensor (%(default)g)")
    parser.add_argument("--busy", type=int, default=0, metavar="N", help="processes that keep the cores busy meanwhile")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--quick", action="store_true", help="one run of 3 s each")
    arguments = parser.parse_args()
    seconds, count = (3.0, 1) if arguments.quick else (arguments.seconds, arguments.runs)
    names = list(CLIENTS)
    try:
        peer = version("pynetft")
    except PackageNotFoundError:
        peer = None
        names.remove("pynetft")
    with ExitStack() as stack:
        for _ in range(arguments.busy):
            each = multiprocessing.get_context("spawn").Process(target=spin, daemon=True)
            each.start()
            stack.callback(each.terminate)
        # Taken in turn, and the other way round every second time: what else runs here meets all of them.
        order = [name for number in range(count) for name in (names if number % 2 == 0 else names[::-1])]
        runs = [measure(name, seconds, arguments.rate_hz) for name in order]
    result = {"date": date.today().isoformat(), "machine": f"{os.cpu_count()} cores {platform.machine()}",
              "python": platform.python_version(), "pynetft": peer, "load": os.getloadavg()[0], "busy": arguments.busy,
              "seconds": seconds, "wanted_Hz": arguments.rate_hz, "clients": [summary(runs, name) for name in names],
              "runs": runs}
    if arguments.json:
        print(json.dumps(result))
        return 0
    print(f"{result['machine']}, Python {result['python']}, pynetft {peer}, load {result['load']:.1f}, "
          f"{arguments.busy} busy processes in parallel, {count} runs of {seconds:g} s each")
    for row in result["clients"]:
        cpu, rate, lost = row["cpu_us_per_packet"], row["rate_Hz"], row["lost_percent"]
        print(f"{row['client']}: {rate[0]:.0f} packets/s ({rate[1]:.0f} to {rate[2]:.0f}), {row['records']} received, "
              f"{row['lost']} lost ({lost[0]:.3f} %, at most {lost[2]:.3f} %), {row['late']} late, "
              f"{row['twice']} twice; CPU {cpu[0]:.1f} us a packet ({cpu[1]:.1f} to {cpu[2]:.1f}), emulator "
              f"{row['emulator_cpu_us_per_packet'][0]:.0f}"
              + ("" if row["buffer_bytes"] is None else f"; buffer {row['buffer_bytes'] / 1024:.0f} KiB"))
    if peer is None:
        print("pynetft is not installed: no peer (pip install pynetft)")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
