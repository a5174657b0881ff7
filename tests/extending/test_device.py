"""A haptic device from one file outside of the house: it feels the force of a loop in its own process."""

import importlib
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from haptics.devices.back_ends import HAPTIC_DEVICES, make_haptic_device
from haptics.loop.loop import LoopSettings
from haptics.loop.process import LoopError, LoopProcess
from haptics.safety.limits import ForceLimiter
from haptics.safety.rendering import ForceRendering
from tissue_sim.errors import InputError

HAPTICS = Path(__file__).resolve().parents[1] / "haptics"
STIFFNESS = 300.0


@pytest.fixture
def handle(plugin, registers):
    module = plugin("stiff_handle")
    registers(HAPTIC_DEVICES, module.open_handle, "handle")
    return module


@pytest.fixture
def loop_with(monkeypatch):
    """A loop of a spring, with a device."""
    monkeypatch.syspath_prepend(HAPTICS)
    tissues = importlib.import_module("loop_tissues")

    def loop_with(device):
        return LoopProcess(partial(tissues.Spring, STIFFNESS), device, ForceRendering(ForceLimiter(10.0, 1.0)),
                           LoopSettings(real_time=False))

    return loop_with


def test_it_feels_the_force(handle, loop_with, ticks_of, tmp_path):
    """Hand and spring of the handle against that of the tissue: PUSH = (SPRING + STIFFNESS) depth."""
    with loop_with(make_haptic_device(f"handle:{tmp_path / 'diary'}")) as loop:
        ticks = ticks_of(loop)
    depth = handle.PUSH / (handle.SPRING + STIFFNESS)
    assert ticks["device_depth"][-1] == pytest.approx(depth, rel=1e-6)
    assert ticks["force"][-1] == pytest.approx(STIFFNESS * depth, rel=1e-6)
    # What was rendered in a tick moves it in the next one.
    share = np.minimum(ticks["time"] / 0.1, 1.0)
    np.testing.assert_allclose(ticks["device_depth"][1:],
                               share[1:] * (handle.PUSH - ticks["force"][:-1]) / handle.SPRING, atol=1e-12)
    assert (tmp_path / "diary").read_text(encoding="utf-8").split() == ["start", "stop"]


def test_a_device_that_is_not_there_is_one_sentence(handle, loop_with, tmp_path):
    with loop_with(make_haptic_device(f"handle:{tmp_path}")) as loop, \
            pytest.raises(LoopError, match=r"no handle is there; plug one in$"):
        loop.wait_until_ready(300)


def test_a_running_loop_takes_it_up_and_refuses_one_that_is_not_there(handle, loop_with, tmp_path):
    with loop_with(make_haptic_device("virtual:")) as loop:
        loop.wait_until_ready(300)
        loop.aim(1e-3)
        with pytest.raises(InputError, match="no handle is there"):
            loop.switch_device(make_haptic_device(f"handle:{tmp_path}"))
        loop.aim(2e-3)  # the one before is still there
        loop.switch_device(make_haptic_device(f"handle:{tmp_path / 'diary'}"))
        with pytest.raises(InputError, match="requires a steerable motion; got a StiffHandle"):
            loop.aim(1e-3)
        assert loop.stop().ended_by == "stop"
    assert (tmp_path / "diary").read_text(encoding="utf-8").split() == ["start", "stop"]


def test_a_name_belongs_to_one(handle):
    for name in ("handle", "virtual"):
        with pytest.raises(InputError, match=f"the name '{name}' is taken by another haptic device"):
            HAPTIC_DEVICES.register(lambda text: None, name)
