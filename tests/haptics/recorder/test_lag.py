"""`estimate_force_lag`: the lag of the force behind the position, from a reversal on a stiff spring."""

import numpy as np
import pytest
from virtual_bench import Spring

from haptics.recorder.lag import estimate_force_lag
from tissue_sim import Recording, Rig, read_recording
from tissue_sim.errors import InputError


def make_recording(lag, noise, seed=0, stiffness=2e4, speed=2e-3, unloads=True, period=2e-3):
    time = np.arange(0.0, 2.0 if unloads else 1.0, period)

    def depth(at):
        return speed * np.maximum(1.0 - np.abs(at - 1.0), 0.0)

    delayed = depth(time - lag)
    force = stiffness * delayed * (1 + 40 * delayed) + noise * np.random.default_rng(seed).standard_normal(time.size)
    return Recording({"time": time, "displacement": depth(time), "force": force})


@pytest.mark.parametrize("lag", [0.0, 0.0123, -0.004, 0.1])
def test_the_interval_contains_the_lag(lag):
    found = estimate_force_lag(make_recording(lag, 0.05))
    assert found.interval[0] - 2e-4 <= lag <= found.interval[1] + 2e-4
    assert found.value == pytest.approx(lag, abs=1e-3) and found.interval[1] - found.interval[0] < 2e-3


@pytest.mark.slow
def test_the_interval_covers_the_lag_in_95_percent_of_the_cases():
    intervals = [estimate_force_lag(make_recording(0.0123, 0.2, seed, period=8e-3)).interval for seed in range(200)]
    covered = sum(low <= 0.0123 <= high for low, high in intervals)
    assert 180 <= covered <= 199


def test_a_recorded_run_gives_the_latency_of_its_sensor(bench):
    bench.run(plan=bench.plan("ramp 1mm @4mm/s; unload", replicates=1), rig=bench.rig(Spring(3e3), Rig(latency=0.03)))
    found = estimate_force_lag(read_recording(bench.folder / "spring_1.csv"))
    # The stage is polled every 5 ms, the force sampled every 2 ms.
    assert found.value == pytest.approx(0.03, abs=2e-3)


@pytest.mark.parametrize("recording", [make_recording(0.0, 0.05, unloads=False), make_recording(0.5, 0.05)])
def test_a_recording_without_unloading_or_with_a_long_lag_is_refused(recording):
    with pytest.raises(InputError, match=r"in unloading; got|Press on a stiff"):
        estimate_force_lag(recording)
