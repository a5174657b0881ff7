"""Partial slip of bonded faces: interpolation between the recordings of bonded and frictionless faces."""

import numpy as np

import tissue_sim as ts
from tissue_sim.simulation import blend_bonded_and_frictionless_recordings


def make_recording(force, **solver):
    time = np.arange(3.0)
    return ts.Recording({"time": time, "displacement": 1e-3 * time, "force": np.array(force)}, {}, {"solver": solver})


def test_each_part_of_the_faces_carries_the_force_of_its_interface():
    held = make_recording([0.0, 2.0, 6.0], force_error=0.01, warnings=["coarse mesh"])
    free = make_recording([0.0, 1.0, 2.0], force_error=0.03, warnings=["coarse mesh", "few samples"])
    blended = blend_bonded_and_frictionless_recordings(held, free, 0.25)
    np.testing.assert_allclose(blended.force, [0.0, 1.75, 5.0])
    np.testing.assert_array_equal(blended.displacement, held.displacement)
    assert blended.metadata["solver"] == {"force_error": 0.03, "warnings": ["coarse mesh", "few samples"]}


def test_an_unknown_error_of_one_interface_is_unknown_for_both():
    held, free = make_recording([1.0, 2.0, 3.0], force_error=0.01), make_recording([1.0, 1.0, 1.0], force_error=None)
    assert blend_bonded_and_frictionless_recordings(held, free, 0.5).metadata["solver"]["force_error"] is None
