"""The lag between force and position, from a reversal on something stiff."""

import numpy as np
import pytest
from virtual_bench import Spring

from haptics.recorder.lag import measure_lag
from tissue_sim import Recording, Rig, read_recording
from tissue_sim.errors import InputError


def pressed(lag, noise, seed=0, stiffness=2e4, speed=2e-3, out=True, period=2e-3):
    time = np.arange(0.0, 2.0 if out else 1.0, period)

    def depth(at):
        return speed * np.maximum(1.0 - np.abs(at - 1.0), 0.0)

    place = depth(time - lag)
    force = stiffness * place * (1 + 40 * place) + noise * np.random.default_rng(seed).standard_normal(time.size)
    return Recording({"time": time, "displacement": depth(time), "force": force})


@pytest.mark.parametrize("lag", [0.0, 0.0123, -0.004, 0.1])
def test_a_lag_is_found_within_its_interval(lag):
    found = measure_lag(pressed(lag, 0.05))
    assert found.interval[0] - 2e-4 <= lag <= found.interval[1] + 2e-4
    assert found.value == pytest.approx(lag, abs=1e-3) and found.interval[1] - found.interval[0] < 2e-3


def test_the_interval_holds_as_often_as_it_says():
    held = sum(low <= 0.0123 <= high for low, high in (measure_lag(pressed(0.0123, 0.2, seed, period=8e-3)).interval
                                                       for seed in range(200)))
    assert 180 <= held <= 199


def test_a_run_on_a_stiff_spring_shows_the_latency_of_its_sensor(bench):
    bench.run(plan=bench.plan("ramp 1mm @4mm/s; unload", replicates=1), rig=bench.rig(Spring(3e3), Rig(latency=0.03)))
    found = measure_lag(read_recording(bench.folder / "spring_1.csv"))
    # Between two looks at the stage, 5 ms, and two samples, 2 ms.
    assert found.value == pytest.approx(0.03, abs=2e-3)


@pytest.mark.parametrize("recording", [pressed(0.0, 0.05, out=False), pressed(0.5, 0.05)])
def test_what_shows_no_lag_is_refused(recording):
    with pytest.raises(InputError, match=r"in unloading; got|Press on a stiff"):
        measure_lag(recording)
