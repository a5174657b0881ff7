"""The recording itself: what it refuses and what it keeps."""

import numpy as np
import pytest

from tissue_sim import InputError, Recording


def ramp():
    return Recording({"time": np.arange(5.0), "displacement": np.linspace(0, 4e-3, 5), "force": np.arange(5.0)})


def test_channels_are_copies_that_cannot_be_written():
    force = np.arange(5.0)
    recording = Recording({"force": force})
    force[0] = 9.0
    assert recording.force[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        recording.force[0] = 1.0
    with pytest.raises(TypeError):
        recording.channels["force"] = force


@pytest.mark.parametrize(("channels", "labels", "message"), [
    ({"frce": [1.0]}, {}, "did you mean 'force'"),
    ({}, {}, "at least one channel"),
    ({"force": [[1.0]]}, {}, "shape"),
    ({"force": [1.0, 2.0], "displacement": [1.0]}, {}, "expected 2 numbers"),
    ({"force": [1.0, np.nan]}, {}, "value 2 is nan"),
    ({"force": [1.0, np.inf]}, {}, "value 2 is inf"),
    ({"time": [0.0, 2.0, 1.0]}, {}, "runs backwards after sample 2"),
    ({"force": [1.0]}, {"colour": ["red"]}, "unknown label channel"),
    ({"force": [1.0]}, {"cycle": [1, 2]}, "must have one label per sample; got 2 labels for 1 samples"),
])
def test_bad_recordings_are_refused(channels, labels, message):
    with pytest.raises(InputError, match=message):
        Recording(channels, labels)


def test_time_may_stand_still():
    assert len(Recording({"time": [0.0, 1.0, 1.0], "force": [0.0, 1.0, 2.0]})) == 3


def test_absent_channel_is_named():
    with pytest.raises(InputError, match=r"no 'stretch'.*time, displacement, force"):
        ramp().channel("stretch")


def test_select_takes_samples_of_channels_and_labels():
    recording = Recording({"force": np.arange(4.0)}, {"cycle": [1, 1, 2, 2]}, {"name": "a"}, fields="of 4 samples")
    second = recording.select(recording.labels["cycle"] == 2)
    assert second.force.tolist() == [2.0, 3.0]
    assert second.labels["cycle"].tolist() == [2, 2]
    assert second.name == "a" and second.fields is None


def test_with_channels_and_metadata_keep_the_rest():
    recording = ramp().with_metadata(device="frame")
    shifted = recording.with_channels(force=recording.force + 1.0)
    assert shifted.force.tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    assert shifted.displacement.tolist() == recording.displacement.tolist()
    assert shifted.metadata["device"] == "frame" and "device" not in ramp().metadata
    assert "force" in shifted and "stretch" not in shifted


def test_labels_are_read_only():
    recording = Recording({"displacement": [0.0, 1.0], "force": [0.0, 1.0]}, labels={"cycle": [1, 1]})
    with pytest.raises(ValueError, match="read-only"):
        recording.labels["cycle"][0] = 2
