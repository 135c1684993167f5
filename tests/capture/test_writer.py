"""What the writer does to the file, in which order: a state is on the disc before it is marked done."""

import errno
import multiprocessing
import os
import pickle
import signal
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import h5py
import numpy as np
import pytest

from acquisition.capture import layout, partial_file
from acquisition.capture.partial_file import as_partial, bytes_needed, check_space, mark_not_taken, seal_whole
from acquisition.capture.state_file import StateFile
from acquisition.capture.writer import DEAD_S, LOOK_S, CaptureWriter, StateRecord
from acquisition.disc import disc, on_disc
from acquisition.errors import AcquisitionError
from acquisition.stop_request import StopRequest
from drivers.motion import Position
from processing.instrument.states import StateTable
from processing.storage.captures.capture import Capture
from processing.storage.captures.schema import CaptureHeader
from simulators.clock import ManualClock

HEADER = CaptureHeader(title="three states", simulated=True, mode="drr", wavelength_nm=662)
SHAPE = (4, 5)


def table(states: int = 3) -> StateTable:
    return StateTable(
        angles_deg={"psg": np.arange(states) * 9.0},
        exposure_s=np.full(states, 0.02),
        role=("sample",) * states,
        repeats=np.full(states, 2),
    )


def record(state: int) -> StateRecord:
    pixels = np.full(SHAPE, 100 + state, np.uint16)
    return StateRecord(state, pixels, {"psg": Position(9.0 * state, 1000 * state, True)}, {"exposure_s": 0.03})


@pytest.fixture
def create(tmp_path: Path):
    opened = []

    def make(name: str = "c.h5", **options: Any) -> CaptureWriter:
        opened.append(
            CaptureWriter.create(tmp_path / name, HEADER, table(), SHAPE, start_time="2026-01-01T00:00:00", **options)
        )
        return opened[-1]

    yield make
    for writer in opened:
        writer.abandon()


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory):
    """System calls of the disc process that concern the disc, in their order, since the last look."""
    record = tmp_path_factory.mktemp("calls") / "record"
    record.touch()

    def watch(name: str, note: Any) -> None:
        call = getattr(os, name)

        def watched(*arguments: Any) -> Any:
            with record.open("ab") as file:
                pickle.dump((name, *note(*arguments)), file)
            return call(*arguments)

        monkeypatch.setattr(os, name, watched)

    watch("pwrite", lambda file, data, offset: (offset, bytes(data)))
    watch("fdatasync", lambda file: ())
    watch("fsync", lambda file: (os.readlink(f"/proc/self/fd/{file}").rpartition("/")[2],))
    watch("rename", lambda old, new: (Path(old).name, Path(new).name))

    def seen() -> list[tuple[Any, ...]]:
        with record.open("rb") as file:
            records = []
            while file.peek():
                records.append(pickle.load(file))
        record.write_bytes(b"")
        return records

    return seen


def test_a_state_is_synced_before_it_is_marked_done_and_the_mark_after(create, calls):
    writer = create()
    with h5py.File(writer.path, locking=False) as h5:
        mark = h5["entry/states/done"].id.get_offset()
    calls()
    writer.put(record(1))
    writer.settle()
    records = calls()
    names = [call[0] for call in records]
    assert names[-3:] == ["fdatasync", "pwrite", "fdatasync"]
    assert "fdatasync" not in names[:-3]
    assert records[-2][1] == mark + records[-2][2].__len__()
    assert any(call[0] == "pwrite" and record(1).pixels.tobytes() in call[2] for call in records[:-3])
    # Nothing of the state is written after its mark.
    assert int.from_bytes(records[-2][2], "little") == 1


def test_the_file_has_its_final_name_when_all_is_on_the_disc(create, calls, tmp_path):
    writer = create()
    records = calls()
    assert ("fsync", "c.h5.new") in records
    assert records.index(("fsync", "c.h5.new")) < records.index(("rename", "c.h5.new", "c.h5.partial"))
    assert records[-1] == ("fsync", tmp_path.name)
    assert writer.seal("complete", {"end_time": "now"}) == tmp_path / "c.h5"
    # The closing record and the status are synced before the file has its name, and its folder after.
    records = calls()
    assert records[-3][0] in ("fdatasync", "fsync")
    assert records[-2:] == [("rename", "c.h5.partial", "c.h5"), ("fsync", tmp_path.name)]
    assert writer.path == tmp_path / "c.h5"


def test_states_are_read_back_as_they_were_handed_over(create, tmp_path):
    writer = create(begin={"event": "begin", "segment": 0})
    writer.segment = 0
    for state in (0, 2):
        writer.put(record(state))
    path = writer.seal("aborted", {"end_time": "now"}, keep_partial=True)
    assert path == tmp_path / "c.h5.partial"
    with Capture(path) as capture:
        assert capture.status == "aborted"
        assert capture.done.tolist() == [0, 2]
        assert [int(capture.frames(k)[0][0, 0]) for k in range(2)] == [100, 102]
        assert capture.angles_deg["psg"].tolist() == [0.0, 18.0]
        assert capture.column("exposure_s").tolist() == [0.03, 0.03]
        assert capture.column("repeats").tolist() == [2, 2]
        assert capture.planned_column("exposure_s")[1] == 0.02


def test_going_on_with_a_partial_file_fills_what_is_missing(create, tmp_path):
    writer = create()
    writer.put(record(0))
    path = writer.seal("failed", {}, keep_partial=True)
    assert seal_whole(path) is None
    second = CaptureWriter(path)
    for state in (1, 2):
        second.put(record(state))
    second.settle()
    second.abandon()
    assert seal_whole(path) == tmp_path / "c.h5"
    with Capture(tmp_path / "c.h5") as capture:
        assert capture.status == "complete"
        assert capture.done.tolist() == [0, 1, 2]


def test_an_exposure_found_later_and_states_that_are_forgotten(create):
    writer = create()
    writer.put(record(0))
    writer.set_exposure(np.array([0.1, 0.2, 0.3]))
    writer.forget()
    path = writer.seal("failed", {}, keep_partial=True)
    with Capture(path) as capture:
        assert capture.done.tolist() == []
        assert capture.planned_column("exposure_s").tolist() == [0.1, 0.2, 0.3]


def test_states_to_be_taken_again_make_the_capture_partial(create):
    writer = create()
    for state in range(3):
        writer.put(record(state))
    final = writer.seal("complete", {})
    path = mark_not_taken(final, [1])
    assert path.name == "c.h5.partial"
    assert not final.exists()
    assert as_partial(path) == path
    with Capture(path) as capture:
        assert capture.status == "failed"
        assert capture.done.tolist() == [0, 2]
        assert np.isnan(capture.planned_column("exposure_s")[1])


def test_nothing_is_overwritten(create, tmp_path):
    (tmp_path / "c.h5").write_bytes(b"whole")
    (tmp_path / "d.h5.partial").write_bytes(b"part")
    for name, existing in (("c.h5", "c.h5"), ("d.h5", "d.h5.partial")):
        with pytest.raises(AcquisitionError, match=rf"{existing} exists already; nothing was changed"):
            create(name)
    assert (tmp_path / "c.h5").read_bytes() == b"whole"
    assert not list(tmp_path.glob("*.new"))


def test_room_that_is_too_small_is_refused_with_both_numbers(monkeypatch, tmp_path):
    needed = bytes_needed(3, 2, SHAPE)
    assert needed == 3 * (2 * 4 * (5 * 2 + 4) + 512) + (3 << 19)
    monkeypatch.setattr(partial_file.shutil, "disk_usage", lambda _: SimpleNamespace(free=needed))
    check_space(tmp_path, needed)
    with pytest.raises(AcquisitionError, match=rf"needs {needed + 1:,} bytes in .*, {needed:,} are free"):
        check_space(tmp_path, needed + 1)


@pytest.mark.parametrize(
    ("place", "call", "number"),
    [
        *((os, "posix_fallocate", number) for number in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EACCES)),
        # HDF5 never writes to the disc: its layout is copied by calls whose errors are seen.
        (layout, "write_whole", errno.EACCES),
    ],
)
def test_space_that_cannot_be_taken_leaves_nothing_behind(create, monkeypatch, tmp_path, place, call, number):
    def refuse(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(place, call, refuse)
    message = "cannot be created" if number == errno.EACCES else "cannot get them"
    with pytest.raises(AcquisitionError, match=message):
        create()
    assert list(tmp_path.iterdir()) == []


def test_the_blocks_are_taken_before_the_first_state(create):
    writer = create()
    assert os.stat(writer.path).st_blocks * 512 >= os.stat(writer.path).st_size


def test_an_error_of_the_disc_is_told_at_once_and_by_the_next_call(create, monkeypatch):
    errors: list[AcquisitionError] = []
    failure = threading.Event()

    def fail(*_: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(StateFile, "write_state", fail)
    writer = create()
    writer.on_failure = lambda error: (errors.append(error), failure.set())
    writer.put(record(0))
    failure.wait()
    assert "could not be written ([Errno 5] Input/output error)" in str(errors[0])
    for call in (lambda: writer.put(record(1)), writer.settle, lambda: writer.seal("complete", {})):
        with pytest.raises(AcquisitionError, match=r"Input/output error\). States done before it are intact"):
            call()


def test_a_state_for_a_disc_process_that_has_ended_is_refused_at_once(create, caplog):
    """What would be told of it by another thread would be raised where nobody hears it."""
    writer = create()
    os.kill(disc().pid, signal.SIGKILL)
    with pytest.raises(AcquisitionError, match="has ended"):
        writer.forget()
    with StopRequest() as stop, stop.failing_here():
        writer.on_failure = stop.fail
        with pytest.raises(AcquisitionError, match="has ended"):
            writer.put(record(0))
    assert not caplog.records


@pytest.mark.parametrize(
    ("broken", "call"),
    [
        ("write_column", lambda writer: writer.forget()),
        ("write_closing", lambda writer: writer.seal("complete", {})),
        ("write_status", lambda writer: writer.seal("complete", {})),
    ],
)
def test_an_error_of_the_disc_beside_the_states_says_which(create, monkeypatch, broken, call):
    def fail(*_: object) -> None:
        raise OSError(errno.EDQUOT, "Disk quota exceeded")

    monkeypatch.setattr(StateFile, broken, fail)
    writer = create()
    with pytest.raises(AcquisitionError, match=r"could not be written \(\[Errno 122\] Disk quota exceeded\)"):
        call(writer)
    assert writer.path.name == "c.h5.partial"


def test_the_frame_of_each_channel_is_written(tmp_path):
    header = HEADER.model_copy(update={"channels": ("ordinary", "extraordinary")})
    pixels = np.arange(2 * 4 * 5, dtype=np.uint16).reshape(2, 4, 5)
    writer = CaptureWriter.create(tmp_path / "two.h5", header, table(), SHAPE, start_time="2026-01-01T00:00:00")
    writer.put(StateRecord(0, pixels, {"psg": Position(0.0, 0, True)}, {"exposure_s": 0.03}))
    path = writer.seal("failed", {}, keep_partial=True)
    with h5py.File(path) as h5:
        np.testing.assert_array_equal(h5["entry/instrument/detector/data"][0], pixels)


def test_a_file_that_was_killed_after_its_status_keeps_its_closing_record(create):
    writer = create()
    for state in range(3):
        writer.put(record(state))
    writer.seal("complete", {"messages": ["as it was"]}, keep_partial=True)
    final = seal_whole(writer.path)
    assert final is not None
    with Capture(final) as capture:
        assert capture.closing["messages"] == ["as it was"]


class Passing(ManualClock):
    """Time goes by when it is looked at."""

    def now_s(self) -> float:
        self.sleep_s(DEAD_S / 8)
        return super().now_s()


def test_a_disc_that_takes_nothing_is_given_up_after_a_while_and_the_next_state_waits(create, monkeypatch):
    going_on = multiprocessing.Event()
    write = StateFile.write_state
    monkeypatch.setattr(StateFile, "write_state", lambda *arguments: (going_on.wait(), write(*arguments)))
    writer = create(clock=Passing())
    writer.put(record(0))
    with pytest.raises(AcquisitionError, match=f"the disc has not taken a state for {DEAD_S:g} s"):
        writer.put(record(1))
    going_on.set()
    writer.abandon()
    with Capture(writer.path) as capture:
        assert capture.done.tolist() == [0]


def test_a_disc_that_blocks_while_nobody_hands_over_a_state_is_told_of(create, monkeypatch):
    errors: list[AcquisitionError] = []
    failure, going_on = threading.Event(), multiprocessing.Event()
    write = StateFile.write_state
    monkeypatch.setattr(StateFile, "write_state", lambda *arguments: (going_on.wait(), write(*arguments)))
    writer = create(clock=Passing())
    writer.on_failure = lambda error: (errors.append(error), failure.set())
    writer.put(record(0))
    assert failure.wait(60)
    assert f"the disc has not taken a state for {DEAD_S:g} s" in str(errors[0])
    going_on.set()


def test_a_long_time_without_a_state_is_no_failure_of_the_disc(create):
    failure, clock = threading.Event(), ManualClock()
    clock.sleep_s(10 * DEAD_S)
    create(clock=clock).on_failure = lambda _: failure.set()
    assert not failure.wait(3 * LOOK_S)


def test_relative_names_are_of_the_folder_that_the_program_is_in_now(tmp_path, monkeypatch):
    on_disc("any call", os.getpid)
    monkeypatch.chdir(tmp_path)
    on_disc("a file", Path("here.txt").write_text, "x")
    assert (tmp_path / "here.txt").exists()
