"""Plugins: one file each outside the packages, importable here and in the processes that tests start."""

import importlib
import os
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
