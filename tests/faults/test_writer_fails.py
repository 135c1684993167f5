"""Promises 16 and 21: whatever ends or blocks the writer ends the run in order; a changed byte is found at reading."""

import multiprocessing
import threading
import time
from pathlib import Path

import h5py
import pytest

from acquisition.capture import partial_file, writer
from acquisition.capture.runner import CaptureRunner
from acquisition.capture.state_file import StateFile
from acquisition.errors import AcquisitionError
from acquisition.screen.observer import Observer
from acquisition.stop_request import StopRequest
from processing.storage.captures.capture import Capture, CaptureError


def _failing_at(monkeypatch, number, fail):
    write = StateFile.write_state

    def write_state(self, state, *arguments):
        if state == number:
            fail()
        write(self, state, *arguments)

    monkeypatch.setattr(StateFile, "write_state", write_state)


def _raise(kind):
    raise kind("injected")


@pytest.mark.parametrize("kind", [MemoryError, SystemExit])
def test_any_exception_in_the_writer_ends_the_run_and_it_goes_on(run_with, intact, monkeypatch, kind):
    light = []
    with monkeypatch.context() as patch:
        _failing_at(patch, 5, lambda: _raise(kind))
        error, path = run_with(lambda rig, *_: light.append(rig))
    assert isinstance(error, AcquisitionError)
    assert "injected" in str(error)
    assert path.name == "run.h5.partial"
    assert intact(path) == 5
    assert not light[0].simulation.light()
    error, final = run_with(resume=path)
    assert error is None
    assert intact(final) == 19


def test_a_disc_that_takes_nothing_shuts_the_light_and_ends_the_run(run_with, intact, monkeypatch):
    monkeypatch.setattr(writer, "PATIENCE_S", 0.2)
    monkeypatch.setattr(writer, "DEAD_S", 1.0)
    blocked, rigs, lit = multiprocessing.Event(), [], []

    class Told(Observer):
        def warning(self, text):
            lit.append((text, rigs[0].simulation.light()))

    monkeypatch.setattr(CaptureRunner, "set_light", _then(CaptureRunner.set_light, lambda: lit.append("set")))
    with monkeypatch.context() as patch:
        _failing_at(patch, 5, lambda: blocked.wait(60))
        error, path = run_with(lambda rig, *_: rigs.append(rig), observers=(Told(),))
    assert "the disc has not taken a state for 1 s" in str(error)
    failures = [number for number, entry in enumerate(lit) if "the disc takes no data" in str(entry)]
    # The light comes before the words, not at the end of the run.
    assert lit[failures[0] - 1] == "set"
    assert lit[failures[0]][1] == 0
    assert not rigs[0].simulation.light()
    blocked.set()
    _let_go(path)
    assert intact(path) >= 5


def test_a_run_stopped_at_once_does_not_wait_for_a_disc_that_blocks(run_with, monkeypatch):
    """Ctrl-C twice while the disc blocks: the run ends after the short patience, not after the long one."""
    monkeypatch.setattr(writer, "PATIENCE_S", 0.2)
    monkeypatch.setattr(writer, "DEAD_S", 3600.0)
    blocked = multiprocessing.Event()

    class Twice(Observer):
        def warning(self, text):
            if "the disc takes no data" in text:
                raise KeyboardInterrupt

    _failing_at(monkeypatch, 5, blocked.wait)
    with pytest.raises(KeyboardInterrupt) as stopped:
        run_with(observers=(Twice(),))
    blocked.set()
    assert any("the end of the run could not be recorded" in note for note in stopped.value.__notes__)


def _then(function, act):
    def both(*arguments):
        function(*arguments)
        act()

    return both


def test_a_disc_that_comes_back_is_waited_for(run_with, intact, monkeypatch):
    monkeypatch.setattr(writer, "PATIENCE_S", 0.1)
    back = multiprocessing.Event()

    class Told(Observer):
        def warning(self, text):
            if "the disc takes no data" in text:
                back.set()

    _failing_at(monkeypatch, 5, lambda: back.wait(60))
    error, path = run_with(observers=(Told(),))
    assert error is None
    assert intact(path) == 19
    with Capture(path) as capture:
        assert any("the disc takes no data" in text for text in capture.closing["messages"])


def _let_go(path):
    while True:
        try:
            Capture(path).close()
            return
        except CaptureError:
            time.sleep(0.02)


def test_a_failure_of_another_thread_reaches_the_main_thread_in_the_middle_of_a_wait():
    with StopRequest() as stop:
        threading.Timer(0.1, stop.fail, (AcquisitionError("told"),)).start()
        with pytest.raises(AcquisitionError, match="told"), stop.failing_here():
            time.sleep(3600)
        # Outside, clean-up is under way: it is left alone.
        stop.fail(AcquisitionError("not heard"))
        assert not stop.requested


def test_every_ctrl_c_after_the_second_interrupts_too():
    with StopRequest() as stop:
        stop.request()
        for _ in range(2):
            with pytest.raises(KeyboardInterrupt):
                stop.request()


def test_a_damaged_partial_file_is_refused_in_a_line(run_with, acquire, tmp_path):
    _, path = run_with()
    for name in ("entry/states/frame_id", "entry/instrument/psa/value", "entry/segments", "entry/closing/json"):
        damaged = tmp_path / "damaged.h5.partial"
        damaged.write_bytes(path.read_bytes())
        with h5py.File(damaged, "r+") as h5:
            h5["entry/states/done"][7] = 0
            h5["entry"].attrs.modify("status", b"failed")
            del h5[name]
        code, _, err = acquire("--resume", damaged)
        assert code in (1, 2)
        assert "error:" in err
        assert "Traceback" not in err


def test_a_byte_changed_on_the_disc_is_found_at_reading(run_with):
    _, path = run_with()
    content = path.read_bytes()
    with Capture(path) as capture:
        assert capture.checked
        _read_all(capture)
    for where in ("instrument/detector/data", "instrument/psg/value", "states/exposure_s"):
        path.write_bytes(content)
        with h5py.File(path, "r+") as h5:
            dataset = h5["entry"][where]
            index = (9,) + (0,) * (dataset.ndim - 1)
            dataset[index] = dataset[index] + 1
        with pytest.raises(CaptureError, match="state 9 was changed on the disc"):
            _open_and_read(path)


def _open_and_read(path):
    with Capture(path) as capture:
        _read_all(capture)


def _read_all(capture):
    for state in range(len(capture.done)):
        capture.frames(state, slice(0, 2))


def test_a_folder_deleted_in_mid_run_is_noticed_with_the_next_state(run_with, tmp_path):
    visits = []

    def delete(rig, state, retake):
        visits.append(state)
        if state == 5:
            for path in tmp_path.glob("capture*/run.h5.partial"):
                path.rename(tmp_path / "moved.h5")

    with pytest.raises(StopIteration):
        # Nothing of that name is left, which the fixture looks for.
        run_with(delete)
    assert max(visits) <= 7
    with Capture(tmp_path / "moved.h5") as capture:
        assert 4 <= len(capture.done) <= 6


def test_a_layout_that_a_disc_has_lost_is_no_capture(run_with, monkeypatch, tmp_path):
    """Zeros where the targets should be: an arm that was sent to 35 would be recorded as sent to 0."""
    put = partial_file.put_layout

    def lose(path, *arguments):
        put(path, *arguments)
        with h5py.File(path, "r+") as h5:
            h5["entry/instrument/arm/target_value"][...] = 0

    monkeypatch.setattr(partial_file, "put_layout", lose)
    moved = []
    with pytest.raises(StopIteration):
        run_with(lambda *_: moved.append(1))
    assert not moved
    assert not list(tmp_path.glob("capture*/run.h5*"))


def test_a_full_disc_at_the_quick_look_fails_no_complete_capture(acquire, quick_rig, tmp_path, monkeypatch):
    from acquisition.screen import quicklook

    def full(path):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(quicklook, "draw", full)
    out = acquire.made("--omega", 35, "--mode", "stokes", "--rig", quick_rig(), "--out", tmp_path)
    assert "not drawn (No space left on device)" in out
    with Capture(next(tmp_path.glob("*.h5"))) as capture:
        assert capture.status == "complete"


def test_doctor_says_that_a_light_was_left_on(small_rig):
    from acquisition.commands.doctor import describe_source
    from acquisition.rig.config import load_rig
    from acquisition.rig.open_rig import open_rig

    with open_rig(load_rig(small_rig()), with_camera=False) as rig:
        assert "light off" in describe_source(rig)
        rig.source.set_light(True)
        rig.source.close()
        with pytest.raises(AcquisitionError, match="LIGHT LEFT ON"):
            describe_source(rig)


def test_captures_leave_no_thread_and_no_descriptor(run_with):
    def held():
        return len(list(Path("/proc/self/fd").iterdir())), sorted(thread.name for thread in threading.enumerate())

    few = {"mode": "stokes", "states": {"kind": "fixed", "states": 2}}
    run_with(plan=few)
    before = held()
    for _ in range(2):
        run_with(plan=few)
    assert held() == before
