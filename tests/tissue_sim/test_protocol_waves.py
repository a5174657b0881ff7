"""Sinusoids and chirps of a protocol: samples, sweeps, labels, control, and errors with their position."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import tissue_sim as ts
from tissue_sim.experiment.protocol_legs import iterate_motion_legs
from tissue_sim.experiment.protocol_text import FORCE, ProtocolSegment, format_protocol, parse_protocol
from tissue_sim.experiment.protocol_waves import SAMPLES_PER_CYCLE, Wave


def waves_of(text: str, **options):
    """Return time since the start of the first wave, s, and displacement, m, of its samples with the sample before."""
    protocol = ts.Protocol.parse(text, **options)
    first = int(np.argmax(np.isin(protocol.segment, ("sine", "chirp")))) - 1
    return protocol.time[first:] - protocol.time[first], protocol.displacement[first:]


class TestSine:
    @pytest.mark.parametrize("points", [2, 21, 66])
    def test_samples_are_those_of_the_sinusoid(self, points):
        time, displacement = waves_of("ramp 2mm @1mm/s; sine 0.1mm @2Hz for 3 cycles", points=points)
        np.testing.assert_allclose(displacement, 2e-3 + 0.1e-3 * np.sin(4 * np.pi * time), atol=1e-15)
        assert time[-1] == pytest.approx(1.5) and displacement[-1] == displacement[0]
        assert displacement.max() == 2.1e-3 and displacement.min() == 1.9e-3
        assert time.size - 1 == 3 * {2: SAMPLES_PER_CYCLE, 21: SAMPLES_PER_CYCLE, 66: 68}[points]

    def test_about_zero(self):
        time, displacement = waves_of("ramp 1um @1mm/s; unload; sine 0.5mm @10Hz for 1 cycle")
        np.testing.assert_allclose(displacement, 0.5e-3 * np.sin(20 * np.pi * time), atol=1e-15)

    def test_each_cycle_is_a_load_cycle(self):
        protocol = ts.Protocol.parse("ramp 2mm @1mm/s; unload 1mm; sine 0.1mm @1Hz for 2 cycles; unload; ramp 1mm",
                                     points=2)
        ends = protocol.cycle[[1, 2, 3, 34, 35, 66, 67, 68]]
        assert ends.tolist() == [1, 1, 2, 2, 3, 3, 3, 4]
        assert protocol.segment[[1, 2, 3, 66, 67]].tolist() == ["ramp", "unload", "sine", "sine", "unload"]

    def test_a_reload_returns_to_the_largest_displacement(self):
        assert ts.Protocol.parse("ramp 2mm; sine 1mm @1Hz for 1 cycles; reload").displacement[-1] == 3e-3

    def test_about_a_force(self):
        protocol = ts.Protocol.parse("ramp 2N @1N/s; sine 500mN @2Hz for 1 cycles")
        assert protocol.is_force_controlled.all() and protocol.remaining is None
        assert protocol.force.max() == 2.5 and protocol.force[-1] == 2.0

    def test_force_after_displacement_starts_from_the_response(self):
        protocol = ts.Protocol.parse("ramp 2mm @1mm/s; sine 0.1N @2Hz for 1 cycles", points=3)
        whole = protocol.append_remaining_segments(protocol.displacement, np.array([0.0, 1.0, 1.7]))
        assert whole.force[3:].max() == pytest.approx(1.8) and whole.force[-1] == 1.7

    def test_frequency_sweep(self):
        text = "ramp 1mm; sine 0.1mm @0.1Hz to 10Hz in 5 steps for 2 cycles"
        frequencies = [segment.wave.frequency for segment in parse_protocol(text)[1:]]
        np.testing.assert_allclose(frequencies, [0.1, 10**-0.5, 1.0, 10**0.5, 10.0], rtol=1e-14)

    def test_amplitude_sweep(self):
        segments = parse_protocol("sine 10um to 1mm in 3 steps @1Hz for 5 cycles")
        np.testing.assert_allclose([segment.amount for segment in segments], [1e-5, 1e-4, 1e-3], rtol=1e-14)


class TestChirp:
    @pytest.mark.parametrize(("text", "phase"), [
        # Number of cycles after t s; 20 s of the mean frequency 5.5 Hz are 110 cycles.
        ("chirp 0.1mm @1Hz to 10Hz for 20s linear", lambda t: t + 9.0 * t**2 / 40.0),
        ("chirp 0.1mm @1Hz to 10Hz for 23.793s", lambda t: (10.0**(t / T) - 1.0) * T / np.log(10.0)),
        ("chirp 0.1mm @10Hz to 1Hz for 20s linear", lambda t: 10.0 * t - 9.0 * t**2 / 40.0)])
    def test_phase(self, text, phase):
        time, displacement = waves_of(f"ramp 1mm; {text}")
        np.testing.assert_allclose(displacement, 1e-3 + 1e-4 * np.sin(2 * np.pi * phase(time)), atol=1e-12)

    def test_ends_after_a_whole_cycle(self):
        protocol = ts.Protocol.parse("chirp 0.1mm @0.1Hz to 10Hz for 60s")
        assert abs(protocol.time[-1] - 60.0) < 0.05 and protocol.displacement[-1] == 0.0

    def test_equal_frequencies_are_a_sinusoid(self):
        chirp, sine = (ts.Protocol.parse(text) for text in ("chirp 1mm @2Hz to 2Hz for 3s",
                                                            "sine 1mm @2Hz for 6 cycles"))
        np.testing.assert_allclose(chirp.time, sine.time, rtol=1e-14)
        np.testing.assert_array_equal(chirp.displacement, sine.displacement)


#: Duration of the logarithmic chirp with 93 cycles, s: cycles over the mean frequency 9 Hz / ln 10.
T = 93.0 * np.log(10.0) / 9.0

FAULTS = {
    "sine": "column 5, at the end: expected a length or a force after 'sine', such as 10mm",
    "sine 1mm": "column 9, at the end: expected '@' and a frequency after the amplitude of a sine, such as @1Hz",
    "sine 1mm @1mm/s for 2 cycles": "column 12, at 'mm/s for 2 cycle...': 'mm/s' is not a unit of frequency; use Hz",
    "sine 1mm @1Hz": "column 14, at the end: a sine needs its number of cycles, as in sine 0.1mm @1Hz for 10 cycles",
    "sine 1mm @1Hz for 0 cycles": "column 19, at '0 cycles': expected the number of cycles, an integer of at least 1",
    "sine 1mm @1Hz for 2s": "column 20, at 's': a sine needs the word cycles after their number",
    "sine 1mm @1Hz to 2Hz for 2 cycles": "column 22, at 'for 2 cycles': a sweep needs its number of steps",
    "sine 1mm @1Hz to 2Hz in 1 steps": "column 25, at '1 steps': expected the number of steps, an integer from 2 to",
    "sine 1mm to 2N in 2 steps": "column 14, at 'N in 2 steps': 'N' is not a unit of length",
    "sine 1mm to 2mm in 2 steps @1Hz to 2Hz in 2 steps for 1 cycles": "a segment must sweep the amplitude or the",
    "sine 1mm @1Hz for 4000 cycles": "column 1: this sine has more than 100000 samples; use fewer cycles or points",
    "chirp 1mm @1Hz for 2s": "column 16, at 'for 2s': a chirp needs its last frequency, as in chirp 0.1mm",
    "chirp 1mm @1Hz to 2Hz": "column 22, at the end: a chirp needs its duration, as in chirp 0.1mm",
    "chirp 1mm @1Hz to 2Hz for 2 cycles": "column 29, at 'cycles': 'cycles' is not a unit of time",
    "sin 1mm": "column 1, at 'sin 1mm': unknown segment 'sin'; did you mean 'sine'?",
}


@pytest.mark.parametrize("text", FAULTS)
def test_an_error_has_its_position_and_an_example(text):
    with pytest.raises(ts.InputError) as error:
        ts.Protocol.parse(text)
    assert FAULTS[text] in str(error.value) and error.value.field == "protocol"


def test_machines_with_straight_motions_refuse_a_sinusoid():
    with pytest.raises(ts.InputError, match="segments must be straight here, because the machine moves at constant"):
        list(iterate_motion_legs(parse_protocol("sine 1mm @1Hz for 1 cycles"), 1e-3))


def test_a_segment_without_its_wave():
    for kind, wave in (("sine", None), ("ramp", Wave(1.0, 2))):
        with pytest.raises(ts.InputError, match="sine and chirp need an amplitude and a wave"):
            ProtocolSegment(kind, 1e-3, wave=wave)


_FREQUENCIES = st.floats(1e-3, 1e3)
_WAVES = st.builds(Wave, _FREQUENCIES, st.integers(1, 1000)) | st.builds(
    Wave, _FREQUENCIES, st.integers(1, 1000), _FREQUENCIES, st.sampled_from(["linear", "logarithmic"]))


@settings(deadline=None)
@given(st.lists(st.builds(lambda amount, wave, control: ProtocolSegment(
    "sine" if wave.end_frequency is None else "chirp", amount, control=control, wave=wave),
    st.floats(1e-9, 1e6), _WAVES, st.sampled_from(["displacement", FORCE])), min_size=1, max_size=3))
def test_text_gives_the_segments_back(segments):
    assert parse_protocol(format_protocol(segments)) == tuple(segments)


@settings(deadline=None)
@given(_WAVES)
def test_time_increases_and_ends_with_the_duration(wave):
    _, time = wave.compute_samples(2)
    assert (np.diff(time) > 0).all() and time[-1] == pytest.approx(wave.duration, rel=1e-9)
