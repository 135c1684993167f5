"""The file of a capture that is being taken: states, columns, journal, closing record, each at its place."""

import contextlib
import errno
import os
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest

from acquisition.capture import state_file
from acquisition.capture.state_file import LINE_BYTES, StateFile
from acquisition.capture.text_box import TextBox
from acquisition.capture.writer import CaptureWriter
from acquisition.errors import AcquisitionError
from processing.instrument.states import StateTable
from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import CLOSING_BYTES, SEGMENTS_BYTES, CaptureHeader
from processing.storage.captures.segments import decode_lines, encode_line

SHAPE, STATES = (4, 5), 3
HEADER = CaptureHeader(title="three states", simulated=True, mode="drr", wavelength_nm=662)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A layout that no program has open."""
    table = StateTable(
        angles_deg={"psg": np.arange(STATES) * 9.0, "psa": np.arange(STATES) * 5.0},
        exposure_s=np.full(STATES, 0.02),
        role=("sample",) * STATES,
        repeats=np.full(STATES, 2),
    )
    CaptureWriter.create(tmp_path / "c.h5", HEADER, table, SHAPE, start_time="2026-01-01T00:00:00").abandon()
    (file,) = tmp_path.iterdir()
    return file


@pytest.fixture
def file(path: Path):
    opened = StateFile(path)
    yield opened
    opened.close()


class Bytes:
    """The bytes of the file at its places, seen and changed past the program that writes it."""

    def __init__(self, path: Path) -> None:
        self.descriptor = os.open(path, os.O_RDWR)
        with h5py.File(path, locking=False) as h5:
            self.segments, self.closing = (
                TextBox(self.descriptor, h5[f"entry/{name}/json"]) for name in ("segments", "closing")
            )

    def read(self, length: int, offset: int) -> bytes:
        return os.pread(self.descriptor, length, offset)

    @property
    def journal_end(self) -> int:
        return decode_lines(self.segments.read(self.descriptor))[1]


@pytest.fixture
def raw(path: Path, file: StateFile):
    opened = Bytes(path)
    yield opened
    os.close(opened.descriptor)


def test_the_disc_begins_with_an_image_while_it_is_written(path, file, monkeypatch):
    """In one piece, with all the work left to the sync, a capture took twice as long to be on the disc."""
    monkeypatch.setattr(state_file, "PIECE", 16)
    calls = []
    for name in ("pwrite", "posix_fadvise", "fdatasync"):
        real = getattr(os, name)

        def watched(*arguments, name=name, real=real):
            calls.append((name, arguments[1:]))
            return real(*arguments)

        monkeypatch.setattr(os, name, watched)
    pixels = np.arange(20, dtype=np.uint16).reshape(1, *SHAPE)
    file.write_state(1, pixels, {"psg": (9.5, 9500), "psa": (0, 0)}, {})
    first = calls[0][1][1]
    for k, size in enumerate((16, 16, 8)):
        (wrote, (data, offset)), (call, advice) = calls[2 * k : 2 * k + 2]
        assert (wrote, offset, len(data)) == ("pwrite", first + 16 * k, size)
        assert (call, advice) == ("posix_fadvise", (first + 16 * k, size, os.POSIX_FADV_DONTNEED))
    assert "fdatasync" not in [name for name, _ in calls[:6]]
    file.close()
    with Capture(path) as reader:
        np.testing.assert_array_equal(reader.frames(0), pixels)


def test_a_file_system_that_takes_no_advice_gets_the_state_as_well(path, file, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOSYS, "not implemented")

    monkeypatch.setattr(os, "posix_fadvise", refuse)
    file.write_state(2, np.ones((1, *SHAPE)), {"psg": (9.5, 9500), "psa": (0, 0)}, {})
    file.close()
    with Capture(path) as reader:
        assert reader.done.tolist() == [2]


def test_a_state_is_written_at_its_own_place(path, file):
    for k in (2, 0):
        pixels = np.arange(20).reshape(1, *SHAPE) + 100 * k
        file.write_state(k, pixels, {"psg": (9.5 + k, 9500 + k), "psa": (-k, -1000 * k)}, {"exposure_s": 0.03 + k})
    file.close()
    with Capture(path) as reader:
        assert reader.done.tolist() == [0, 2]
        assert reader.damaged_states() == []
        assert reader.angles_deg["psg"].tolist() == [9.5, 11.5]
        assert reader.angles_deg["psa"].tolist() == [0.0, -2.0]
        assert reader.column("exposure_s").tolist() == [0.03, 2.03]
        assert reader.planned_column("exposure_s")[1] == 0.02
        np.testing.assert_array_equal(reader.frames(1), np.arange(20).reshape(1, *SHAPE) + 200)
    with h5py.File(path) as h5:
        assert h5["entry/instrument/psg/raw_value"][...].tolist()[0::2] == [9500, 9502]


def test_columns_are_read_and_replaced_whole(path, file):
    assert file.read_column("exposure_s").tolist() == [0.02] * STATES
    file.write_column("exposure_s", [0.1, 0.2, 0.3])
    assert file.read_column("exposure_s").tolist() == [0.1, 0.2, 0.3]
    file.write_column("exposure_s", [1, 2, 3])
    assert file.read_column("exposure_s").tolist() == [1.0, 2.0, 3.0]
    assert file.read_column("repeats").tolist() == [2] * STATES
    # A copy: what is done to it is not done to the file.
    file.read_column("repeats")[:] = 0
    assert file.read_column("repeats").tolist() == [2] * STATES


def test_journal_keeps_its_lines_and_takes_over_what_was_cut_off(file, raw):
    box = raw.segments
    beyond = raw.read(256, box.offset + box.room)
    assert file.segment_records() == []
    file.add_segment_record({"event": "begin", "n": 1})
    file.add_segment_record({"event": "end"}, part=0.5)
    assert file.segment_records() == [{"event": "begin", "n": 1}, {"event": "end"}]
    # A line whose end never reached the disc is not there, and the next one covers all of it.
    end = raw.journal_end
    box.set_length(raw.descriptor, end + 400)
    os.pwrite(raw.descriptor, b"12345678 {" + 300 * b"x", box.offset + end)
    file.add_segment_record({"event": "begin", "n": 2})
    assert [r.get("n") for r in file.segment_records()] == [1, None, 2]
    assert not raw.read(box.room, box.offset)[raw.journal_end :].strip(b"\0")
    # What comes after the journal in the file is not touched.
    assert raw.read(256, box.offset + box.room) == beyond


def test_a_record_is_cut_to_its_part_of_the_room_and_a_full_journal_is_told(file, raw):
    room = raw.segments.room
    file.add_segment_record({"event": "end", "messages": ["m" * 100] * (room // 50)}, part=0.5)
    (record,) = file.segment_records()
    assert record["left_out"]["messages"] > 0
    used = raw.journal_end
    assert 0.4 * room < used <= 0.5 * room
    # A line as long as the room takes all of it, one byte more does not fit, and nothing is written then.
    part = room - used - LINE_BYTES - len('{"t": ""}')
    with pytest.raises(AcquisitionError, match="its journal is full"):
        file.add_segment_record({"t": "x" * (part + 1)})
    assert raw.journal_end == used
    file.add_segment_record({"t": "x" * part})
    assert raw.journal_end == room
    with pytest.raises(AcquisitionError, match="its journal is full"):
        file.add_segment_record({}, part=0.5)


def test_closing_record_and_status_are_replaced(path, file):
    file.write_closing({"end_time": "a long time after it began", "messages": []})
    file.write_closing({"end_time": "now"})
    file.write_status("aborted")
    file.write_status("failed")
    file.close()
    with Capture(path) as reader:
        assert reader.closing == {"end_time": "now"}
        assert reader.status == "failed"


def _texts(path):
    with h5py.File(path, locking=False) as h5:
        return h5["entry/closing/json"][()], h5["entry/segments/json"][()]


def test_every_reader_is_shown_texts_of_their_own_length(path, file):
    """No zero bytes behind them, in a file that is under way either; the room stays."""
    assert _texts(path) == (b"", b"")
    file.add_segment_record({"event": "begin"})
    file.write_closing({"end_time": "a long time after it began"})
    file.write_closing({"end_time": "now"})
    file.add_segment_record({"event": "end"})
    closing, segments = _texts(path)
    assert closing == b'{"end_time": "now"}'
    assert segments == encode_line(b'{"event": "begin"}') + encode_line(b'{"event": "end"}')
    with h5py.File(path, locking=False) as h5:
        for name, text, room in (("closing", closing, CLOSING_BYTES), ("segments", segments, SEGMENTS_BYTES)):
            dataset = h5[f"entry/{name}/json"]
            assert dataset.dtype == h5py.string_dtype("utf-8", len(text))
            assert dataset.id.get_storage_size() == room


@pytest.mark.parametrize("records", [("short", "much longer than that"), ("much longer than that", "short")])
def test_a_text_that_is_cut_off_anywhere_reads_as_before_or_as_it_is_now(path, file, monkeypatch, records):
    old, new = ({"end_time": text} for text in records)
    file.write_closing(old)
    file.add_segment_record(old)
    sync, closings = file.sync, []

    def look():
        copy = Path(shutil.copy(path, path.with_name("copy.h5")))
        with Capture(copy) as reader:
            assert reader.closing in (old, new)
            assert file.segment_records() in ([old], [old, new])
            closings.append(reader.closing)

    monkeypatch.setattr(file, "sync", lambda: (sync(), look()))
    file.write_closing(new)
    file.add_segment_record(new)
    # Two steps each: the length of a text, and what stands in it.
    assert len(closings) == 4
    assert closings[-1] == new


def test_padded_texts_of_an_older_file_are_gone_on_with(path, file, raw):
    """Where the length was that of the room; the next text ends where it ends."""
    file.add_segment_record({"event": "begin"})
    for box in (raw.segments, raw.closing):
        box.set_length(raw.descriptor, box.room)
    file.close()
    with Capture(path) as reader:
        assert reader.closing == {}
    with contextlib.closing(StateFile(path)) as older:
        assert older.segment_records() == [{"event": "begin"}]
        older.add_segment_record({"event": "end"})
        older.write_closing({"end_time": "now"})
    closing, segments = _texts(path)
    assert closing == b'{"end_time": "now"}'
    assert segments == encode_line(b'{"event": "begin"}') + encode_line(b'{"event": "end"}')


def test_a_closing_record_that_is_too_long_says_what_it_lost(path, file):
    file.write_closing({"end_time": "now", "messages": ["m" * 1000] * 5000})
    file.close()
    with Capture(path) as reader:
        assert reader.closing["left_out"]["messages"] > 0


def test_it_knows_whether_it_is_still_the_file_of_its_name(path, file):
    def lost():
        return pytest.raises(AcquisitionError, match="was deleted or moved while it was written")

    file.require_at(path)
    with lost():
        file.require_at(path.with_name("other"))
    path.rename(path.with_name("moved"))
    with lost():
        file.require_at(path)
    path.write_bytes(b"")
    with lost():
        file.require_at(path)


def test_a_file_system_without_locks_is_good_enough_and_a_broken_one_is_not(path, monkeypatch):
    def refuse(number: int) -> None:
        def flock(*args: object) -> None:
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(state_file.fcntl, "flock", flock)

    refuse(errno.ENOLCK)
    opened = StateFile(path)
    assert (opened.states, opened.frame_shape) == (STATES, SHAPE)
    opened.close()
    refuse(errno.EIO)
    with pytest.raises(AcquisitionError, match="cannot be opened to resume"):
        StateFile(path)


def test_one_program_at_a_time_and_nothing_but_whole_captures(path, file, tmp_path):
    with pytest.raises(AcquisitionError, match="another program has it open"):
        StateFile(path)
    file.close()
    file.close()
    StateFile(path).close()
    with pytest.raises(AcquisitionError, match=r"cannot be opened to resume \(No such file"):
        StateFile(tmp_path / "nowhere.h5")
    (tmp_path / "text.h5").write_text("no HDF5")
    with pytest.raises(AcquisitionError, match="begin a new capture"):
        StateFile(tmp_path / "text.h5")
