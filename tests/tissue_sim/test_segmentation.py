"""Segments of a motion: one definition, whether its samples come at once or one after another."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import tissue_sim as ts
from tissue_sim.recording.segmentation import (
    ReversalDetector,
    append_numbers_to_repeated_runs,
    label_reloads_and_cycles,
    label_samples_ramp_hold_unload,
)

CYCLES = "ramp 5mm @0.5mm/s; hold 20s; unload 1mm; hold 5s; reload; unload"


def moved(protocol, step=0.05):
    """Samples of a protocol at even times."""
    known = ts.Protocol.parse(protocol, points=101)
    time = np.arange(0.0, known.time[-1] + step / 2, step)
    return known, time, np.interp(time, known.time, known.displacement)


@pytest.mark.parametrize("noise", [0.0, 2e-6])
def test_labels_are_those_of_the_protocol(noise):
    known, time, displacement = moved(CYCLES)
    displacement = displacement + noise * np.random.default_rng(1).standard_normal(time.size)
    labels, cycles = label_reloads_and_cycles(label_samples_ramp_hold_unload(time, displacement))
    stated = np.searchsorted(known.time, time).clip(0, known.time.size - 1)
    # Of a noisy motion the corners are found to within a few samples.
    near = np.abs(time[:, None] - known.time[np.flatnonzero(known.segment[1:] != known.segment[:-1])]).min(axis=1)
    clear = near > (0.3 if noise else 1e-6)
    assert (labels == known.segment[stated])[clear].all()
    assert (cycles == known.cycle[stated])[clear].all()
    assert clear.mean() > 0.9


@given(turns=st.lists(st.floats(0.4e-3, 8e-3), min_size=2, max_size=8))
def test_reversals_one_by_one_are_the_turns_of_the_labels(turns):
    """A motion to and fro: incremental branches go where the labels of the whole go."""
    ends = np.concatenate([[0.0], np.cumsum([way * (-1) ** i for i, way in enumerate(turns)])])
    time = np.arange(ends.size * 20 - 19) / 20.0
    displacement = np.interp(time, np.arange(ends.size), ends)
    reversals = ReversalDetector(0.05e-3)
    for index, value in enumerate(displacement.tolist()):
        reversals.add_sample(index, value)
    ways = [direction for direction, *_ in reversals.list_branch_directions_and_ranges(time.size - 1)]
    labels = label_samples_ramp_hold_unload(time, displacement, 0.025e-3)
    runs = list(dict.fromkeys(append_numbers_to_repeated_runs(labels).tolist()))
    assert [1 if run.startswith("ramp") else -1 for run in runs] == ways


def test_a_short_stop_is_no_hold_of_a_hand():
    _, time, displacement = moved("ramp 5mm @1mm/s; hold 0.5s; unload 2mm @1mm/s; hold 3s; unload @1mm/s", 0.02)
    labels = label_samples_ramp_hold_unload(time, displacement, 0.025e-3, shortest_hold=1.0)
    assert list(dict.fromkeys(append_numbers_to_repeated_runs(labels).tolist())) == ["ramp", "unload", "hold",
                                                                                     "unload 2"]
