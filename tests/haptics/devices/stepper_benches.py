"""Shared parts of the tests of stepper stages: a bench with a clock set by the test, and ports with invalid answers."""

import os
import threading
import time
import tty
from contextlib import contextmanager

from haptics.devices.contracts import Bench, StageLimits
from haptics.devices.virtual.force_sensor import VirtualForceSensor
from haptics.devices.virtual.stage import VirtualStage


class Clock:
    """Clock in s, advanced by the test."""

    def __init__(self):
        self.now = 100.0

    def __call__(self):
        return self.now


def no_load(time):
    return (0.0,)


def bench(lowest=0.0, highest=0.01, speed=0.004, start_at=0.0, clock=time.monotonic):
    return Bench(VirtualForceSensor(no_load), VirtualStage(StageLimits(lowest, highest, speed), start_at=start_at,
                                                           clock=clock))


@contextmanager
def port_that_answers(answer):
    """A serial port whose answers are a function of the received bytes."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    ending = threading.Event()

    def run():
        while not ending.wait(0.001):
            try:
                data = os.read(master, 4096)
            except BlockingIOError:
                continue
            back = answer(data)
            if back:
                os.write(master, back)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield os.ttyname(slave)
    finally:
        ending.set()
        thread.join()
        os.close(master)
        os.close(slave)
