"""Protocols: segments as text, their samples, and one sentence with its place for every fault."""

import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import tissue_sim as ts
from tissue_sim.experiment.protocol import HOLD_STEPS
from tissue_sim.experiment.protocol_legs import iterate_motion_legs
from tissue_sim.experiment.protocol_text import (
    DISPLACEMENT,
    EXAMPLE,
    FORCE,
    KINDS,
    LOADING_KINDS,
    ProtocolRepeat,
    ProtocolSegment,
    format_protocol,
    parse_protocol,
)


def corners(text: str, **options) -> list[tuple[str, float, float, int]]:
    """(segment, time in s, displacement in mm, cycle) at the last sample of each run of one label."""
    protocol = ts.Protocol.parse(text, **options)
    last = [i for i in range(protocol.time.size) if i + 1 == protocol.time.size
            or (protocol.segment[i], protocol.cycle[i]) != (protocol.segment[i + 1], protocol.cycle[i + 1])]
    return [(str(protocol.segment[i]), pytest.approx(protocol.time[i]), pytest.approx(protocol.displacement[i] * 1e3),
             int(protocol.cycle[i])) for i in last]


class TestSamples:
    @pytest.mark.parametrize("points", [2, 21, 150])
    def test_a_plain_ramp_is_the_ramp(self, points):
        ramp, parsed = ts.Protocol.ramp(0.010, points, 0.248e-3), ts.Protocol.parse("ramp 10mm @0.248mm/s", points)
        np.testing.assert_array_equal(parsed.time, ramp.time)
        np.testing.assert_array_equal(parsed.displacement, ramp.displacement)
        assert set(parsed.segment) == {"ramp"} and set(parsed.cycle) == {1}
        assert ramp.labels == {} and set(parsed.labels) == {"segment", "cycle"}

    def test_ramp_hold_unload(self):
        """10 mm at 0.248 mm/s take 40.3226 s."""
        assert corners("ramp 10mm @0.248mm/s; hold 60s; unload") == [
            ("ramp", 40.3226, 10, 1), ("hold", 100.3226, 10, 1), ("unload", 140.6452, 0, 1)]

    def test_every_segment(self):
        text = ("approach 2mm @1mm/s; ramp 10 mm @ 2 mm/s; unload 4mm; reload; hold 1min; unload; reload 5mm; "
                "retract 3mm")
        assert corners(text) == [
            ("approach", 2, 0, 1), ("ramp", 7, 10, 1), ("unload", 10, 4, 1), ("reload", 13, 10, 2), ("hold", 73, 10, 2),
            ("unload", 78, 0, 2), ("reload", 80.5, 5, 3), ("retract", 84.5, -3, 3)]

    def test_repeats_are_cycles(self):
        assert corners("repeat 2 (ramp 5mm @1mm/s; unload 1mm); hold 3s; ramp 9mm") == [
            ("ramp", 5, 5, 1), ("unload", 9, 1, 1), ("ramp", 13, 5, 2), ("unload", 17, 1, 2), ("hold", 20, 1, 2),
            ("ramp", 28, 9, 3)]

    def test_past_contact_and_back(self):
        assert corners("repeat 2 (approach 2mm @1mm/s; ramp 4mm; retract 2mm)")[-1] == ("retract", 24, -2, 2)

    def test_steps_of_a_stair_are_one_cycle(self):
        assert {corner[3] for corner in corners("ramp 2mm; hold 5s; ramp 4mm; hold 5s")} == {1}

    @pytest.mark.parametrize(("unit", "speed"), [
        ("mm/s", 1e-3), ("um/s", 1e-6), ("µm/s", 1e-6), ("m/s", 1.0), ("mm/min", 1e-3 / 60), ("mm/h", 1e-3 / 3600)])
    def test_units_of_speed(self, unit, speed):
        assert ts.Protocol.parse(f"ramp 3mm @2{unit}").time[-1] == pytest.approx(3e-3 / (2 * speed), rel=1e-14)

    @pytest.mark.parametrize(("amount", "seconds"), [("2s", 2), ("250ms", 0.25), ("1.5min", 90), ("2h", 7200)])
    def test_units_of_time(self, amount, seconds):
        assert ts.Protocol.parse(f"hold {amount}").time[-1] == pytest.approx(seconds, rel=1e-15)

    @pytest.mark.parametrize("length", ["10mm", "10000um", "10000 μm", "0.01m", "1e1mm", "+10.mm"])
    def test_units_of_length(self, length):
        assert ts.Protocol.parse(f"ramp {length}").depth == 0.01

    def test_speed_lasts_until_another_is_named(self):
        assert corners("ramp 1mm; ramp 2mm @0.5mm/s; unload; reload @2mm/s", speed=1e-3) == [
            ("ramp", 3, 2, 1), ("unload", 7, 0, 1), ("reload", 8, 2, 2)]

    def test_samples_of_motion_are_even_in_depth(self):
        protocol = ts.Protocol.parse("ramp 10mm; unload 4mm", points=6)
        np.testing.assert_allclose(protocol.displacement * 1e3, [0, 2, 4, 6, 8, 10, 8.8, 7.6, 6.4, 5.2, 4], atol=1e-12)

    @pytest.mark.parametrize(("hold", "first"), [(60.0, 2.0), (3600.0, 2.0), (4.0, 0.2), (1e-3, 0.05e-3)])
    def test_steps_of_a_hold_grow_from_the_last_step_of_the_motion(self, hold, first):
        """From 2 s, or a twentieth of a short hold, by a quarter each; shortened by less than one more step would."""
        protocol = ts.Protocol.parse(f"ramp 10mm @0.5mm/s; hold {hold!r}s", points=11)
        steps = np.diff(protocol.time[10:])
        np.testing.assert_allclose(steps[1:] / steps[:-1], HOLD_STEPS.growth, rtol=1e-9)
        assert first / HOLD_STEPS.growth**1.5 < steps[0] <= first * (1 + 1e-9)
        assert steps.sum() == pytest.approx(hold) and (protocol.displacement[10:] == 0.010).all()

    def test_cost_of_a_long_hold_is_a_logarithm(self):
        assert ts.Protocol.parse("ramp 1um @1m/s; hold 1000h").time.size < 120

    @pytest.mark.parametrize("text", ["ramp 1mm; hold 1e308s", "hold 1e-300s", "ramp 1um @1e300m/s; hold 1h"])
    def test_extreme_holds_end_where_they_should(self, text):
        end = float(text.split()[-1].rstrip("sh")) * (3600 if text.endswith("h") else 1)
        protocol = ts.Protocol.parse(text)
        assert protocol.time[-1] == pytest.approx(end, rel=1e-9) and protocol.segment[-1] == "hold"

    def test_labels_that_do_not_fit(self):
        for labels in ({"segment": ["ramp"]}, {"segment": [1, 2]}, {"cycle": [1.5, 2]}, {"cycle": [1]}):
            with pytest.raises(ts.InputError, match=f"protocol.{next(iter(labels))}: expected 2 "):
                ts.Protocol([0.0, 1.0], [0.0, 1e-3], **labels)


class TestForceControl:
    def test_creep(self):
        """2 N at 0.5 N/s take 4 s; the hold holds the force, and the unload without an amount ends at no force."""
        protocol = ts.Protocol.parse("ramp 2N @0.5N/s; hold 60s; unload", points=5)
        assert protocol.uses_force_control and protocol.is_force_controlled.all() and protocol.remaining is None
        assert protocol.force[:5].tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]
        np.testing.assert_allclose(protocol.time[:5], [0, 1, 2, 3, 4], rtol=1e-15)
        assert (protocol.force[protocol.segment == "hold"] == 2.0).all() and protocol.force[-1] == 0.0
        assert protocol.time[-1] == pytest.approx(68.0) and np.isnan(protocol.displacement).all()

    @pytest.mark.parametrize(("text", "newton_per_s"), [
        ("ramp 500mN @20mN/s", 0.02), ("ramp 0.5N @1.2N/min", 0.02), ("ramp 0.0005kN @72N/h", 0.02)])
    def test_units(self, text, newton_per_s):
        protocol = ts.Protocol.parse(text)
        assert protocol.force[-1] == 0.5 and protocol.time[-1] == pytest.approx(0.5 / newton_per_s, rel=1e-14)

    def test_cycles_between_forces(self):
        protocol = ts.Protocol.parse("ramp 1N @1N/s; repeat 2 (unload 0.2N; reload 2N); unload; reload", points=2)
        assert protocol.force.tolist() == [0.0, 1.0, 0.2, 2.0, 0.2, 2.0, 0.0, 2.0]
        assert protocol.cycle.tolist() == [1, 1, 1, 2, 2, 3, 3, 4]

    def test_a_hold_keeps_the_control_of_the_segment_before(self):
        held = ts.Protocol.parse("ramp 2mm @1mm/s; hold 2s")
        assert (held.displacement[held.segment == "hold"] == 2e-3).all() and not held.uses_force_control

    def test_force_ramp_after_an_approach_starts_at_no_force(self):
        protocol = ts.Protocol.parse("approach 2mm @1mm/s; ramp 2N @1N/s", points=3)
        assert protocol.remaining is None
        np.testing.assert_array_equal(protocol.displacement, [-2e-3, -1e-3, 0.0, np.nan, np.nan])
        np.testing.assert_array_equal(protocol.force, [np.nan, np.nan, np.nan, 1.0, 2.0])

    def test_a_change_of_control_starts_from_the_response(self):
        """3 mm in 3 s with a response of 0.5 N; then 1.5 N in 3 s with a response of 6 mm; then out in 6 s."""
        protocol = ts.Protocol.parse("ramp 3mm @1mm/s; ramp 2N @0.5N/s; unload 0mm; hold 1s", points=4)
        assert protocol.time.tolist() == pytest.approx([0, 1, 2, 3]) and protocol.uses_force_control
        protocol = protocol.append_remaining_segments(protocol.displacement, np.array([0.0, 0.1, 0.3, 0.5]))
        np.testing.assert_allclose(protocol.force[4:], [1.0, 1.5, 2.0])
        np.testing.assert_allclose(protocol.time[4:], [4, 5, 6])
        response = np.array([0, 1, 2, 3, 4, 5, 6]) * 1e-3
        protocol = protocol.append_remaining_segments(response, protocol.force)
        assert protocol.remaining is None and protocol.append_remaining_segments(response, response) is protocol
        np.testing.assert_allclose(protocol.displacement[7:10], [4e-3, 2e-3, 0.0], atol=1e-18)
        assert protocol.time[9] == pytest.approx(12.0) and protocol.time[-1] == pytest.approx(13.0)
        assert set(protocol.segment[:10]) == {"ramp", "unload"} and set(protocol.segment[10:]) == {"hold"}

    def test_a_response_from_which_a_segment_cannot_start(self):
        protocol = ts.Protocol.parse("ramp 3mm @1mm/s; ramp 2N @0.5N/s", points=2)
        with pytest.raises(ts.InputError, match="column 18: a ramp must increase the force, but the force is 3 N alre"):
            protocol.append_remaining_segments(protocol.displacement, np.array([0.0, 3.0]))

    def test_samples_with_none_or_both(self):
        nan = float("nan")
        for displacement, force in (([0.0, nan], None), ([0.0, nan], [nan, nan]), ([0.0, 1e-3], [nan, 1.0])):
            with pytest.raises(ts.InputError, match="each sample must have one finite displacement or one finite"):
                ts.Protocol([0.0, 1.0], displacement, force=force)
        with pytest.raises(ts.InputError, match="lists of the same length"):
            ts.Protocol([0.0, 1.0], force=[0.0])

    def test_pickled(self):
        protocol = ts.Protocol.parse("ramp 3mm @1mm/s; ramp 2N @0.5N/s", points=2)
        copied = pickle.loads(pickle.dumps(protocol))
        assert copied.remaining == protocol.remaining and copied.time.tolist() == protocol.time.tolist()

    def test_segments_that_state_what_they_cannot(self):
        with pytest.raises(ts.InputError, match="a hold keeps the control"):
            ProtocolSegment("hold", 3.0, control=FORCE)
        with pytest.raises(ts.InputError, match="control of retract must be 'displacement'; got 'force'"):
            ProtocolSegment("retract", 3.0, control=FORCE)

    def test_legs_for_machines_refuse_a_force(self):
        for text in ("ramp 2N @1N/s", "ramp 2mm; ramp 2N @1N/s"):
            with pytest.raises(ts.InputError, match="must prescribe displacements here; got a ramp that prescribes a"):
                list(iterate_motion_legs(parse_protocol(text), 1e-3))

    def test_old_names_of_the_module(self):
        from tissue_sim.experiment import protocol

        for name, new in (("format_protocol", format_protocol), ("iterate_motion_legs", iterate_motion_legs)):
            with pytest.warns(DeprecationWarning, match=name):
                assert getattr(protocol, name) is new


FAULTS = {
    "": "column 1, at the end: expected a segment",
    "ramp": "column 5, at the end: expected a length or a force after 'ramp', such as 10mm",
    "ramp 10": "column 8, at the end: '10' has no unit",
    "ramp 10s": "column 8, at 's': 's' is not a unit of length or force; use mm, um, m, N, mN, kN",
    "hold 60mm": "column 8, at 'mm': 'mm' is not a unit of time; use s, ms, min, h",
    "ramp 10mm @0.248": "column 17, at the end: '0.248' has no unit; expected a speed such as 0.248mm/s",
    "ramp 10mm @1mm": "column 13, at 'mm': 'mm' is not a unit of speed; use mm/s",
    "ramp 10mm @0,248mm/s": "column 13, at ',248mm/s': the decimal mark must be a point, not a comma",
    "ramp 10mm @": "column 12, at the end: expected a speed after '@'",
    "ramp 10mm; hld 60s": "column 12, at 'hld 60s': unknown segment 'hld'; did you mean 'hold'?",
    "ramp 10mm unload": "column 11, at 'unload': expected ';' between two segments",
    "ramp 10mm;; unload": "column 11, at '; unload': expected a segment",
    "ramp 10mm;\nhold 60": "line 2, column 8, at the end: '60' has no unit",
    "hold 60s @1mm/s": "column 10, at '@1mm/s': a hold has no speed",
    "hold 0s": "column 6, at '0s': '0' is not a finite time above zero",
    "ramp -3mm": "column 6, at '-3mm': '-3' is not a finite length above zero",
    "ramp 1e999mm": "column 6, at '1e999mm': '1e999' is not a finite length",
    "ramp 1mm @0mm/s": "column 11, at '0mm/s': '0' is not a finite speed above zero",
    "ramp 5mm)": "column 9, at ')': this bracket closes nothing",
    "repeat (ramp 5mm)": "column 8, at '(ramp 5mm)': expected the number of repetitions",
    "repeat 0 (ramp 5mm)": "column 8, at '0 (ramp 5mm)': expected the number of repetitions, an integer of at least 1",
    "repeat 2: ramp 5mm": "column 9, at ': ramp 5mm': expected the repeated segments in brackets",
    "repeat 2 (ramp 5mm": "column 1, at 'repeat 2 (ramp 5...': the brackets of this repeat are not closed",
    "repeat 2 (repeat 2 (hold 1s))":
        "column 11, at 'repeat 2 (hold 1...': a repeat must not be inside of another repeat",
    "ramp 5mm; ramp 5mm": "column 11: a ramp must go deeper, but the tool is at 5 mm already",
    "repeat 2 (ramp 5mm)": "column 11: a ramp must go deeper",
    "unload": "column 1: an unload must go outwards, but the tool is at 0 mm already; its end is 0 mm",
    "retract 1mm; unload": "column 14: an unload must go outwards, but the tool is at -1 mm already; its end is 0 mm",
    "retract 1mm; retract 1mm": "column 14: a retract must go outwards",
    "reload": "column 1: a reload needs an earlier ramp or a depth",
    "ramp 5mm; reload": "column 11: a reload must go deeper",
    "approach": "column 1: the first approach needs the height above the touch",
    "ramp 5mm; approach 2mm": "column 11: an approach starts 2 mm above the touch, but the tool is at 5 mm",
    "hold 1e12h; ramp 1um @1m/s": "column 13: this ramp is too short: its samples coincide",
    "ramp 1e300mm @1e-300mm/s": "column 1: the end time of this ramp is not finite",
    "ramp 2N": "column 1: the first ramp that prescribes a force needs a loading rate, such as ramp 2N @0.5N/s",
    "ramp 2N @1mm/s": "column 11, at 'mm/s': 'mm/s' is not a unit of loading rate; use N/s, mN/s, kN/s",
    "ramp 2mm @1N/s": "column 12, at 'N/s': 'N/s' is not a unit of speed; use mm/s",
    "unload @": "column 9, at the end: expected a speed or a loading rate after '@', such as 0.248mm/s",
    "retract 2N": "column 10, at 'N': 'N' is not a unit of length",
    "approach 2mm @1N/s": "column 16, at 'N/s': 'N/s' is not a unit of speed",
    "hold 2N": "column 7, at 'N': 'N' is not a unit of time",
    "ramp -1N @1N/s": "column 6, at '-1N @1N/s': '-1' is not a finite force above zero",
    "ramp 2N @1N/s; ramp 1N": "column 16: a ramp must increase the force, but the force is 2 N already; name a larger "
                              "force, or unload before it",
    "ramp 2N @1N/s; unload 3N": "column 16: an unload must reduce the force, but the force is 2 N already; its end is",
    "reload @1N/s": "column 1: a reload needs an earlier ramp or a force; ramp first, or name a force",
    "repeat 1000000000 (ramp 5mm; unload)": "the protocol has more than 100000 samples at this segment",
}


@pytest.mark.parametrize("text", FAULTS)
def test_a_fault_is_told_with_its_place_and_an_example(text):
    with pytest.raises(ts.InputError) as error:
        ts.Protocol.parse(text)
    assert FAULTS[text] in str(error.value)
    assert error.value.field == "protocol" and str(error.value).endswith(f"example {EXAMPLE!r}")


def test_sampling_that_cannot_be():
    for options in ({"points": 1}, {"points": 10**9}, {"speed": 0.0}, {"speed": float("nan")}):
        with pytest.raises(ts.InputError, match=next(iter(options))):
            ts.Protocol.parse(EXAMPLE, **options)


_AMOUNTS = st.floats(1e-9, 1e6)


def segments_of(kind):
    """Segments of a kind: all combinations of amount, speed and control that a text can state."""
    amounts = _AMOUNTS | st.just(0.0) if kind == "unload" else _AMOUNTS if KINDS[kind][1] else _AMOUNTS | st.none()
    speeds = st.none() if kind == "hold" else _AMOUNTS | st.none()

    def make(amount, speed, control):
        is_stated = kind in LOADING_KINDS and (amount is not None or speed is not None)
        return ProtocolSegment(kind, amount, speed, control=control if is_stated else None)

    return st.builds(make, amounts, speeds, st.sampled_from([DISPLACEMENT, FORCE]))


_SEGMENTS = st.sampled_from(list(KINDS)).flatmap(segments_of)
_STEPS = st.lists(_SEGMENTS | st.builds(ProtocolRepeat, st.integers(1, 10**6),
                                        st.lists(_SEGMENTS, min_size=1, max_size=3).map(tuple)), min_size=1, max_size=5)


@pytest.mark.slow
@given(_STEPS)
def test_text_of_a_protocol_gives_it_back(steps):
    assert parse_protocol(format_protocol(steps)) == tuple(steps)


_PIECES = st.sampled_from([*KINDS, "repeat", "2", "3", "10", "0.5", "-1", "1e9", "mm", "um", "s", "h", "mm/s", "m/s",
                           "N", "kN", "mN", "N/s", "N/min",
                           "@", ";", "(", ")", " ", "\n", ",", "µm", "1e400", "."])
_TEXTS = st.one_of(st.text(max_size=30), st.lists(_PIECES, max_size=16).map(" ".join),
                   st.lists(_PIECES, max_size=12).map("".join))


@settings(max_examples=400, deadline=None)
@given(_TEXTS)
def test_any_text_is_a_protocol_or_a_sentence(text):
    try:
        ts.Protocol.parse(text, points=3)
    except ts.InputError as error:
        assert "column " in str(error)


_LOADS = st.lists(st.sampled_from(["ramp 3N", "ramp 7N @9N/min", "hold 2s", "unload", "unload 1N", "reload",
                                   "reload 5N", "repeat 2 (reload 6N; unload 2N)"]), max_size=6)


@settings(deadline=None)
@given(_LOADS, st.integers(2, 9))
def test_forces_and_lengths_have_the_same_segments(segments, points):
    """A protocol of forces is that of lengths with N instead of mm."""
    text = "; ".join(["ramp 2N @1N/s", *segments])
    try:
        forces = ts.Protocol.parse(text, points)
    except ts.InputError:
        with pytest.raises(ts.InputError):
            ts.Protocol.parse(text.replace("N", "mm"), points)
        return
    lengths = ts.Protocol.parse(text.replace("N", "mm"), points)
    np.testing.assert_allclose(forces.force, lengths.displacement * 1e3, rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(forces.time, lengths.time, rtol=1e-12)
    assert forces.segment.tolist() == lengths.segment.tolist() and forces.cycle.tolist() == lengths.cycle.tolist()


_RUNS = st.lists(st.sampled_from(["ramp 3mm", "ramp 7mm @9mm/min", "hold 2s", "hold 1h", "unload", "unload 1mm",
                                  "reload", "reload 5mm", "retract 1mm", "approach",
                                  "repeat 2 (reload 6mm; unload 2mm)"]), max_size=6)


@settings(deadline=None)
@given(_RUNS, st.integers(2, 9))
def test_motion_is_at_the_named_speeds_and_without_gaps(segments, points):
    """Of the runs that can be: time increases, the speed is the named one everywhere, labels cover every sample, and a
    cycle begins exactly where the tool turns inwards."""
    try:
        protocol = ts.Protocol.parse("; ".join(["ramp 2mm @1mm/s", *segments]), points)
    except ts.InputError:
        return
    way, time = np.diff(protocol.displacement), np.diff(protocol.time)
    assert (time > 0).all() and set(protocol.segment) <= set(KINDS)
    moving = way != 0
    assert ((protocol.segment[1:] == "hold") == ~moving).all()
    speeds = np.abs(way[moving]) / time[moving]
    assert (np.isclose(speeds, 1e-3) | np.isclose(speeds, 0.15e-3)).all()
    signs, cycles = np.sign(way[moving]), protocol.cycle[1:][moving]
    assert (np.diff(cycles) == (signs[:-1] < 0) * (signs[1:] > 0)).all()
