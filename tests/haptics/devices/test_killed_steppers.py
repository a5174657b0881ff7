"""After the death of a program that moves a stage, the motor stops within `runs_on`."""

import os
import signal
import subprocess
import sys
import time

import pytest
from stepper_benches import bench
from waiting import wait_until

from haptics.devices.back_ends import make_stage
from haptics.emulators.emulator import make_emulator

PROGRAM = """
import sys
from haptics.devices.back_ends import make_stage

stage = make_stage(sys.argv[1])
stage.start()
stage.home()
while not stage.position().homed or stage.position().moving:
    pass
stage.move(stage.limits.highest, stage.limits.speed)
while True:
    sample = stage.position()
    print(sample.position, flush=True)
"""

#: Travel, m, and speed, m/s; the motion would take 50 s.
HIGHEST = 0.1
SPEED = 0.002


@pytest.mark.parametrize(("protocol", "late"), [
    # The timeout runs in a thread of this program, which a busy machine delays.
    ("tic:", 2.0),
    # The queue limits the distance, not the time.
    ("grbl:", 0.0),
])
@pytest.mark.slow
def test_the_motor_stops_soon_after_a_kill(protocol, late, root):
    with make_emulator(protocol, bench(highest=HIGHEST, speed=SPEED)) as emulator:
        program = subprocess.Popen([sys.executable, "-c", PROGRAM, emulator.address], stdout=subprocess.PIPE, text=True,
                                   cwd=root, env=os.environ | {"PYTHONPATH": str(root)})
        try:
            for line in program.stdout:
                if float(line) > 0.2e-3:
                    break
            os.kill(program.pid, signal.SIGKILL)
        finally:
            program.kill()
            program.wait()
            program.stdout.close()
        stage = emulator._stage
        died_at = stage.compute_tool_position_with_stall(time.monotonic())
        wait_until(lambda: not stage.position().moving, event="the motor to stand")
        way = stage.compute_tool_position_with_stall(time.monotonic()) - died_at
        assert 0.2e-3 < died_at < 0.5 * HIGHEST
        assert 0.0 <= way <= SPEED * (make_stage(emulator.address).runs_on + late) + 2e-6
        # Another program can use the stage.
        again = make_stage(emulator.address)
        again.start()
        assert not again.position().moving
        again.stop()
