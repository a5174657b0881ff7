"""Fixtures for tests of the commands and of the viewer."""

import importlib
import math

import pytest

from haptics.loop.process import LoopProcess


@pytest.fixture(autouse=True)
def no_log_lines(monkeypatch):
    """Suppress log lines, so that the output of a command does not depend on the speed of this computer."""
    monkeypatch.setattr("scenes.commands.shared.console.MIN_INTERVAL", math.inf)


@pytest.fixture
def of_gel(monkeypatch, root):
    """Replace the tissue of loops by a spring of 200 N/m: their processes start without kernels, seconds earlier."""
    monkeypatch.syspath_prepend(root / "tests" / "haptics")  # the loop process inherits the path
    gel = importlib.import_module("loop_tissues").Gel

    class OfGel(LoopProcess):
        def __init__(self, build, *others, **options):
            super().__init__(gel, *others, **options)

    monkeypatch.setattr("scenes.viewer.live_simulation.LoopProcess", OfGel)
