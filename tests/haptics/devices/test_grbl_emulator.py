"""The Grbl emulator, with commands sent directly on the terminal."""

import pytest
import serial
from stepper_benches import Clock, bench

from haptics.devices.virtual.faults import Faults
from haptics.emulators.emulator import make_emulator
from haptics.emulators.grbl import GrblEmulator
from tissue_sim.errors import InputError


def test_answers_on_a_terminal_equal_the_documentation():
    """interface.md and commands.md of Grbl 1.1: locked at power-on, and the answer to each command."""
    with GrblEmulator(bench(clock=Clock()), Faults()) as emulator, serial.Serial(
            emulator.path, 115200, timeout=10.0) as line:
        def said(command, count):
            line.write(command)
            return [line.readline().decode().strip() for _ in range(count)]

        assert said(b"?", 1) == ["<Alarm|MPos:0.000,0.000,-1.000|FS:0,0|WCO:0.000,0.000,0.000>"]
        assert said(b"\r", 1) == ["ok"] and said(b"G1X1F100\n", 1) == ["error:9"]
        assert said(b"$J=G91Z-1F60\n", 1) == ["error:8"] and said(b"$Q\n", 1) == ["error:3"]
        assert said(b"$X\n", 2) == ["[MSG:Caution: Unlocked]", "ok"]
        assert said(b"$I\n", 3)[0].startswith("[VER:1.1h.") and said(b"$G\n", 2)[0].startswith("[GC:G0 G54")
        assert said(b"$#\n", 12)[-2:] == ["[PRB:0.000,0.000,0.000:0]", "ok"]
        settings = said(b"$$\n", 35)
        assert settings[-1] == "ok" and "$22=1" in settings and "$132=11.000" in settings
        assert said(b"$J=Z-1\n", 1) == ["error:16"] and said(b"$J=G53Z-20F60\n", 1) == ["error:15"]
        assert said(b"$J=G91 Z-1 F60\n", 1) == ["ok"] and said(b"G1X1F100\n", 1) == ["error:9"]
        assert said(b"?", 1)[0].startswith("<Jog|MPos:0.000,0.000,-1.000|FS:60,0")
        assert said(b"\x18", 3) == ["ALARM:3", "Grbl 1.1h ['$' for help]", "[MSG:'$H'|'$X' to unlock]"]
        assert said(b"$H\n", 1) == ["ok"] and said(b"?", 1)[0].startswith("<Idle|")
        assert said(b"!?", 1)[0].startswith("<Hold:0|") and said(b"~?", 1)[0].startswith("<Idle|")


def test_invalid_settings_of_the_emulator_are_refused():
    for text, field in (("112=-5", "112"), ("speed=1", "speed")):
        with pytest.raises(InputError) as caught:
            make_emulator("grbl:" + text, bench())
        assert caught.value.field == field
