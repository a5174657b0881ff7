"""Plugins: one file each outside the packages, importable here and in the processes that tests start."""

import importlib
import os
import time
from pathlib import Path

import pytest

PLUGINS = Path(__file__).with_name("plugins")


@pytest.fixture
def plugin(monkeypatch):
    """Imports a plugin by the name of its file."""
    monkeypatch.syspath_prepend(PLUGINS)
    paths = [str(PLUGINS), os.environ.get("PYTHONPATH")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(filter(None, paths)))
    return importlib.import_module


@pytest.fixture
def registers():
    """Registers things and takes them out again: ``registers(registry, thing, name)``."""
    added = []

    def register(registry, thing, name=None):
        registry.register(thing, name)
        added.append((registry, name or thing.name))
        return thing

    yield register
    for registry, name in added:
        registry.unregister(name)


@pytest.fixture
def ticks_of():
    """``ticks_of(loop)``: the first ticks of a loop that runs until it is stopped, dtype `haptics.loop.ring.TICK`."""
    def ticks_of(loop, count=600, seconds=300.0):
        loop.wait_until_ready(seconds)
        with loop.open_ring_reader() as ring:
            deadline = time.monotonic() + seconds
            while ring.written_count < count:
                assert loop.wait(0.02) is None and time.monotonic() < deadline, loop.message
            loop.stop()
            return ring.read_ticks_after().records

    return ticks_of
