"""`tissue-sim devices` lists devices, and `tissue-sim emulate` emulates them."""

import json
import subprocess
import sys

import pytest
from child_environment import child_environment

from haptics.devices.virtual.force_sensor import VirtualForceSensor
from haptics.emulators.rdt import RdtEmulator
from haptics.protocols import rdt
from scenes.cli import main


def still(time):
    return (0.0,) * 6


def test_devices_that_open_describe_themselves_and_others_give_the_reason(capsys):
    with RdtEmulator(VirtualForceSensor(still, rdt.CHANNELS)) as emulator:
        names = [emulator.address, "virtual:", "tic:/dev/nowhere", "ati-daq:none.cal"]
        assert main(["devices", *names, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["devices"]
    opens = {each["name"]: each["opens"] for each in found if each["kind"] == "force sensor"}
    assert opens == {emulator.address: True, "virtual:": True, "ati-daq:none.cal": False}
    assert all(each["says"] for each in found)
    tic, = (each for each in found if each["name"] == "tic:/dev/nowhere")
    assert not tic["opens"] and "there is no port /dev/nowhere" in tic["says"]


def test_the_list_names_every_back_end(capsys, monkeypatch):
    monkeypatch.setattr("haptics.devices.back_ends.list_serial_port_names", lambda: [])
    monkeypatch.setattr("haptics.devices.back_ends._DEFAULT_ADDRESSES", {"virtual": ""})
    assert main(["devices"]) == 0
    said = capsys.readouterr().out
    for name in ("virtual:", "rdt:", "ati-serial:", "ati-daq:", "replay:", "tic:", "grbl:", "phidget:", "haply:"):
        assert name in said
    assert "no serial port was found" in said


def test_an_unknown_device_is_refused(capsys):
    assert main(["devices", "tik:/dev/ttyACM0"]) == 2
    assert "names: the name of a device must begin with one of ati-daq, ati-serial, " in capsys.readouterr().err


@pytest.mark.slow
def test_emulators_can_be_opened(capsys):
    """Sensor and stage of one virtual rig, emulated by a separate process."""
    program = subprocess.Popen([sys.executable, "-c", "import sys; from scenes.cli import main; sys.exit(main())",
                                "emulate", "rdt", "tic", "--rate-hz", "200", "--json"],
                               env=child_environment(), stdout=subprocess.PIPE,
                               text=True)
    try:
        lines = []
        while not lines or lines[-1] != "}\n":
            lines.append(program.stdout.readline())
            assert lines[-1], "the emulator ended"
        addresses = json.loads("".join(lines))["emulators"]
        assert main(["devices", addresses["rdt"], addresses["tic"], "--json"]) == 0
        assert all(each["opens"] for each in json.loads(capsys.readouterr().out)["devices"])
    finally:
        program.terminate()
        assert program.wait(60) == 0


@pytest.mark.slow
def test_unknown_fault_and_emulator_name_the_nearest(capsys):
    assert main(["emulate", "rdt", "--faults", "los=0.1"]) == 2
    assert "did you mean 'loss'" in capsys.readouterr().err
    assert main(["emulate", "rtd"]) == 2
    assert "did you mean 'rdt'" in capsys.readouterr().err
