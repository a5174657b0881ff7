"""What tests of the commands and of the viewer share."""

import importlib
import math

import pytest

from haptics.loop.process import LoopProcess


@pytest.fixture(autouse=True)
def no_log_lines(monkeypatch):
    """What a command says does not depend on how long it took here."""
    monkeypatch.setattr("scenes.commands.shared.log_lines.MIN_INTERVAL", math.inf)


@pytest.fixture
def of_gel(monkeypatch, root):
    """Loops whose tissue is a spring of 200 N/m: their processes begin without kernels, seconds earlier."""
    monkeypatch.syspath_prepend(root / "tests" / "haptics")  # the process of the loop inherits it
    gel = importlib.import_module("loop_tissues").Gel

    class OfGel(LoopProcess):
        def __init__(self, build, *others, **options):
            super().__init__(gel, *others, **options)

    monkeypatch.setattr("scenes.viewer.live_simulation.LoopProcess", OfGel)
