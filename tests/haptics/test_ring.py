"""The ring and the board: what a reader gets is whole, in order, and what it did not get is counted."""

import importlib
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from child_environment import child_environment
from hypothesis import given, settings
from hypothesis import strategies as st

from haptics.loop.ring import TICK, RingReader, RingWriter
from haptics.loop.shared_slots import (
    SLOTS,
    SlotReader,
    SlotWriter,
    SnapshotReader,
    SnapshotWriter,
    find_unused_path,
    get_or_create_runtime_folder,
)
from tissue_sim.errors import InputError
from tissue_sim.pose import Pose
from tissue_sim.snapshot import Snapshot

HERE = Path(__file__).parent
KIND = b"tsTEST\0\0"


@pytest.fixture
def tissues(monkeypatch):
    monkeypatch.syspath_prepend(HERE)
    return importlib.import_module("loop_tissues")


@pytest.fixture
def path(tmp_path):
    return tmp_path / "ring"


def test_a_tick_comes_back_as_it_was_written(path, tissues):
    with RingWriter(path) as ring, RingReader(path) as reader:
        assert reader.latest() is None and reader.read_ticks_after().records.shape == (0,)
        ring.append_tick(*tissues.record(41))
        ring.append_tick(*tissues.record(42))
        assert tissues.flat(reader.latest()) == tissues.fields_of(42)
        assert reader.latest().dtype == TICK
        assert [tissues.flat(record) for record in reader.read_ticks_after().records] == [tissues.fields_of(n)
                                                                                          for n in (41, 42)]


def test_what_stands_twice_in_a_tick_is_the_same(path, tissues):
    with RingWriter(path) as ring, RingReader(path) as reader:
        ring.append_tick(*tissues.record(3))
        tick = reader.latest()
        for depth, pose in (("device_depth", "device_pose"), ("tool_depth", "tool_pose")):
            assert tick[depth] == -tick[pose][2]
        assert (tick["force"], tick["tissue_force"]) == (tick["wrench"][2], tick["tissue_wrench"][2])
        assert tick["stiffness"] == tick["stiffness_matrix"][2, 2] == 3 + 14
        assert tick["step_stiffness"] == 1700.0
        ring.append_tick(*(None if isinstance(part, Pose) and place == 2 else part
                           for place, part in enumerate(tissues.record(4))))
        assert np.isnan(reader.latest()["device_pose"]).all() and np.isnan(reader.latest()["device_depth"])


def test_the_layout_is_the_promised_one(path, tissues):
    """Byte for byte: a program in another language reads this."""
    with RingWriter(path, 2) as ring:
        ring.append_tick(*tissues.record(7))
        content = path.read_bytes()
    size = 120 + 63 * 8 + 5 * 8
    assert len(content) == 64 + 2 * (16 + size)
    head = np.array([1, 16 + size, 2, 0, os.getpid(), 0], "<u4").tobytes()
    assert content[:8] == b"tsTICKS\0" and content[8:32] == head
    assert content[32:48] == np.array([1, 0], "<u8").tobytes()  # one written, not ended
    assert content[64:76] == np.array([7 - 6, 0, size], "<u4").tobytes()
    assert content[80:88] == np.array([7], "<u8").tobytes() and content[88:96] == np.array([3.5], "<f8").tobytes()
    # Behind the numbers along z: poses, wrenches, stiffness, ages and errors.
    assert content[200:72 + size] == np.array(tissues.fields_of(7)[17:-1], "<f8").tobytes()
    assert content[72 + size:80 + size] == np.array([1], "<u8").tobytes()


def test_ticks_of_a_loop_without_ages_are_read(path, tissues):
    """The ring of a version before: the same fields, without the last five."""
    with RingWriter(path, 4) as ring:
        ring.append_tick(*tissues.record(5))
        record = path.read_bytes()[80:80 + 120 + 63 * 8]
    path.unlink(missing_ok=True)
    with SlotWriter(path, b"tsTICKS\0", 4, len(record)) as old, RingReader(path) as reader:
        old.write(record)
        tick, = reader.read_ticks_after().records
        assert tick.dtype == TICK and reader.latest() is not None
        assert tissues.flat(tick)[:-5] == tissues.fields_of(5)[:-5] and tick["on_axis"] == 1
        assert all(np.isnan(tick[name]) for name in ("stiffness_age", "force_error", "error_age", "least_tool_mass"))


def test_an_unknown_error_is_no_number_in_a_tick(path, tissues):
    *before, answer, compute_time, lateness, late, missed, flags = tissues.record(5)
    with RingWriter(path) as ring, RingReader(path) as reader:
        ring.append_tick(*before, replace(answer, force_error=None), compute_time, lateness, late, missed, flags)
        assert np.isnan(reader.latest()["force_error"])


@settings(max_examples=50, deadline=None)
@given(batches=st.lists(st.integers(0, 25), min_size=1, max_size=8), capacity=st.integers(2, 9))
def test_every_slot_is_read_or_counted_as_lost(batches, capacity, tmp_path_factory):
    path = tmp_path_factory.mktemp("slots") / "s"
    with SlotWriter(path, KIND, capacity, 8) as writer, SlotReader(path, KIND) as reader:
        number, seen, lost, total = 0, [], 0, 0
        for batch in batches:
            for _ in range(batch):
                total += 1
                writer.write(total.to_bytes(8, "little"))
            contents, number, missing = reader.read_contents_and_lost_count_after(number)
            if not seen and total:  # what went by before the first reading is not lost
                missing = max(total - capacity, 0)
            seen += [int.from_bytes(content, "little") for content in contents]
            lost += missing
        assert number == total == len(seen) + lost
        assert seen == sorted(set(seen)) and set(seen[-capacity:]) >= set(range(max(total - capacity, 0) + 1, total))


def test_a_reader_that_begins_late_has_lost_nothing(path):
    with SlotWriter(path, KIND, 4, 8) as writer, SlotReader(path, KIND) as reader:
        for n in range(10):
            writer.write(bytes([n]))
        assert reader.read_contents_and_lost_count_after(0) == ([b"\6", b"\7", b"\10", b"\11"], 10, 0)
        assert reader.read_contents_and_lost_count_after(3) == ([b"\6", b"\7", b"\10", b"\11"], 10, 3)
        assert reader.read_contents_and_lost_count_after(10) == ([], 10, 0)


@pytest.mark.parametrize("part", range(0, 24, 3))
def test_a_half_written_slot_is_not_believed(path, part):
    """A writer that stops after any part of a slot: its old content is gone, its new one is not there."""
    stride = 16 + 8
    with SlotWriter(path, KIND, 2, 8) as writer, SlotReader(path, KIND) as reader:
        for content in (b"11111111", b"22222222"):
            writer.write(content)
        whole = path.read_bytes()
        with SlotWriter(path.with_name("next"), KIND, 2, 8) as other:
            for content in (b"11111111", b"22222222", b"33333333"):
                other.write(content)
            new = other.path.read_bytes()[SLOTS.head_size:SLOTS.head_size + stride]
        with path.open("r+b") as stream:
            stream.seek(SLOTS.head_size)
            stream.write(new[:part] + whole[SLOTS.head_size + part:SLOTS.head_size + stride])
        assert reader.read(3) is None
        assert reader.read(1) == (b"11111111" if part == 0 else None)
        assert reader.read_newest_number_and_content() == (2, b"22222222")
        assert reader.read_contents_and_lost_count_after(1) == ([b"22222222"], 2, 0)


def test_a_slot_that_has_not_arrived_is_left_for_the_next_time(path):
    """A processor with another order of writes can show the count before the content of a slot."""
    with SlotWriter(path, KIND, 4, 8) as writer, SlotReader(path, KIND) as reader:
        writer.write(b"1")
        writer._numbers[0] = 2
        assert reader.read_contents_and_lost_count_after(0) == ([b"1"], 1, 0)
        writer.write(b"2")
        assert reader.read_contents_and_lost_count_after(1) == ([b"2"], 2, 0)


@pytest.mark.slow
def test_no_torn_record_is_seen_from_a_writer_at_full_speed(tmp_path, tissues):
    """Another process writes a ring of 8 ticks, and a board, as fast as it can."""
    ring, board, stop = tmp_path / "ring", tmp_path / "board", tmp_path / "stop"
    with subprocess.Popen([sys.executable, HERE / "loop_tissues.py", "write", ring, board, stop],
                          env=child_environment(HERE), stdout=subprocess.PIPE) as writer:
        assert writer.stdout.readline() == b"writing" + os.linesep.encode()
        pattern = Snapshot(Pose.at_depth(0.0), 0.0, tissues.gel_fields(1.0, np.zeros((1, 500))))
        with RingReader(ring) as ticks, SnapshotReader(board, pattern) as snapshots:
            number = seen = lost = published = 0
            while number < 100_000:
                for _ in range(20):
                    answer = ticks.read_ticks_after(number)
                    for record in answer.records:
                        assert tissues.flat(record) == tissues.fields_of(int(record["tick"]))
                    assert (np.diff(answer.records["tick"].astype(int)) > 0).all()
                    if number:
                        seen, lost = seen + len(answer.records), lost + answer.lost
                        assert len(answer.records) + answer.lost == answer.number - number
                    number = answer.number
                    latest = ticks.latest()
                    assert latest is None or tissues.flat(latest) == tissues.fields_of(int(latest["tick"]))
                seen_whole = snapshots.latest(after=published)
                if seen_whole is not None:
                    time, snapshot = seen_whole.time, seen_whole.snapshot
                    assert (snapshot.fields.displacements == time).all()
                    assert (snapshot.depth, snapshot.datum) == (time, time)
                    assert time == 16 * seen_whole.number
                    published = seen_whole.number
            stop.touch()
            assert writer.wait(300) == 0
            assert ticks.ended and snapshots.ended and not ring.exists() and not board.exists()
            assert seen > 0 and lost > 0 and published > 0, "the reader must be lapped for this to mean anything"


def test_a_snapshot_comes_back_with_its_stresses(path, tissues):
    pattern = Snapshot(Pose.at_depth(0.0), 0.0, tissues.gel_fields(200.0, np.zeros((1, 7)), np.zeros((1, 2, 3, 4))))
    pose = Pose((1e-3, 2e-3, -3e-3), (0.6, 0.0, 0.8, 0.0))
    sent = Snapshot(pose, -1e-4, tissues.gel_fields(200.0, np.arange(7.0)[None], np.arange(24.0).reshape(1, 2, 3, 4)))
    with SnapshotWriter(path, pattern) as board, SnapshotReader(path, pattern) as reader:
        assert reader.latest() is None
        board.publish(0.25, sent)
        seen = reader.latest()
        assert (seen.number, seen.time, seen.snapshot.pose, seen.snapshot.datum) == (1, 0.25, pose, -1e-4)
        assert seen.snapshot.depth == 3e-3
        np.testing.assert_array_equal(seen.snapshot.fields.displacements, sent.fields.displacements)
        np.testing.assert_array_equal(seen.snapshot.fields.stresses, sent.fields.stresses)
        assert reader.latest(after=1) is None
        reader.pattern = Snapshot(pose, 0.0, tissues.gel_fields(200.0, np.zeros((1, 6))))
        with pytest.raises(InputError, match="must have 31 numbers as the file; got 6"):
            reader.latest()


def test_files_that_are_no_ring_are_refused_in_one_sentence(path, tmp_path, tissues):
    with pytest.raises(InputError, match="cannot be read"):
        RingReader(path)
    for content in (b"", b"x", bytes(64), b"tsTICKS\0" + bytes(500)):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"cannot be read|is not a file of kind 'tsTICKS', version 1"):
            RingReader(path)
    with pytest.raises(InputError, match="exists already"):
        RingWriter(path)
    assert path.read_bytes() == b"tsTICKS\0" + bytes(500), "a foreign file is kept"
    with pytest.raises(InputError, match="cannot be shared"):
        RingWriter(tmp_path / "missing" / "ring")
    with pytest.raises(InputError, match="at least 2"):
        RingWriter(tmp_path / "small", 1)
    with RingWriter(tmp_path / "ring2", 4) as ring:
        with pytest.raises(InputError, match="kind 'tsSNAP'"):
            SnapshotReader(ring.path, None)
        whole = ring.path.read_bytes()
        path.write_bytes(whole[:-8])
        with pytest.raises(InputError, match="is not a file of kind"):
            RingReader(path)


@pytest.mark.skipif(os.name == "nt", reason="renamed there")
def test_a_file_is_whole_when_its_name_appears(path, monkeypatch):
    """A reader that waits for the name can open it at once."""
    link = os.link

    def look(source, target, **options):
        with RingReader(source) as reader:
            assert (reader.written_count, reader.count, reader.ended) == (0, 4, False)
        link(source, target, **options)
        looked.append(target)

    looked = []
    monkeypatch.setattr(os, "link", look)
    with RingWriter(path, 4):
        assert looked == [path] == list(path.parent.iterdir())


def test_files_of_a_loop_are_this_users_alone(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    path = find_unused_path("ring")
    assert path.parent == get_or_create_runtime_folder() == tmp_path / "tissue_sim" and path != find_unused_path("ring")
    with RingWriter(path, 2) as ring:
        if os.name != "nt":
            assert path.stat().st_mode & 0o077 == 0 and path.parent.stat().st_mode & 0o077 == 0
        ring.close()
        assert not path.exists()
    blocked = tmp_path / "file"
    blocked.touch()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(blocked))
    with pytest.raises(InputError, match="set XDG_RUNTIME_DIR to a folder that you own"):
        get_or_create_runtime_folder()
    monkeypatch.delenv("XDG_RUNTIME_DIR")
    assert get_or_create_runtime_folder().is_dir()
