"""Promise 25: a disc that hangs holds a process of its own, and neither the light, nor Ctrl-C, nor the program's end.

The disc process is stopped, which is what a hanging disc is for the process that measures.
"""

import contextlib
import json
import os
import signal
import time
from pathlib import Path

import pytest

from acquisition.rig.config import load_rig
from acquisition.rig.open_rig import open_rig
from processing.storage.captures.capture import Capture
from simulators.rig.served_rig import serve
from viewer.jobs import Jobs


def _children(pid):
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def _disc_process(pid):
    """The child that runs the same command line: it was forked, and no other program was begun in it."""
    command = Path(f"/proc/{pid}/cmdline").read_bytes()
    (writer,) = [child for child in _children(pid) if Path(f"/proc/{child}/cmdline").read_bytes() == command]
    return writer


def _command(pid):
    return Path(f"/proc/{pid}/cmdline").read_text()


def _open_files(pid):
    for link in Path(f"/proc/{pid}/fd").iterdir():
        # It may have been closed meanwhile.
        with contextlib.suppress(FileNotFoundError):
            yield Path(os.readlink(link))


@pytest.fixture
def begun(small_rig, spawn, tmp_path, monkeypatch):
    """A long capture behind real ports; returns the rig outside of the program, the program and its captures."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    rig = small_rig("rig.yaml", clock_speed=1, camera_wait_s=60)
    with serve(rig, tmp_path / "served.yaml", "red_sphere") as simulation:
        out = tmp_path / "captures"
        child = spawn("--omega", 35, "--rig", tmp_path / "served.yaml", "--out", out)
        yield simulation, child, out
        # While the rig is there still: a guard that cannot shut the light gives the alarm for a day.
        child.kill()
        child.wait()
        journal = out / "guard.jsonl"
        _wait_for(
            lambda: "guard rests" in (text := journal.read_text()) or ("light shut" in text and "axes at rest" in text)
        )


def _wait_for(condition, child=None, limit_s=60.0):
    end_s = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end_s
        assert child is None or child.poll() is None, child.communicate()
        time.sleep(0.005)


def test_a_disc_that_hangs_shuts_the_light_and_lets_the_program_end(begun, partial_of, tmp_path):
    simulation, child, out = begun
    partial = partial_of(out, child, states=2)
    _wait_for(lambda: simulation.light() > 0, child)
    hung = _disc_process(child.pid)
    os.kill(hung, signal.SIGSTOP)
    begin_s = time.monotonic()
    _wait_for(lambda: simulation.light() == 0)
    assert time.monotonic() - begin_s < 2.0
    for _ in range(2):
        child.send_signal(signal.SIGINT)
        time.sleep(0.2)
    begin_s = time.monotonic()
    _, err = child.communicate(timeout=30)
    assert time.monotonic() - begin_s < 10.0
    assert child.returncode == 130, err
    assert "the end of the run could not be recorded" in err
    (record,) = (tmp_path / "umov").glob("end-*.json")
    assert json.loads(record.read_text())["status"] == "aborted"
    # What was done before is intact, and the file is free.
    _wait_for(lambda: not Path(f"/proc/{hung}").exists())
    with Capture(partial) as capture:
        assert len(capture.done) >= 2
        assert not capture.damaged_states()


def test_the_process_that_measures_has_no_file_of_the_captures_open(begun, partial_of):
    _, child, out = begun
    partial = partial_of(out, child, states=2)
    for _ in range(20):
        assert not [path for path in _open_files(child.pid) if out in path.parents]
        time.sleep(0.02)
    disc = _disc_process(child.pid)
    assert partial in _open_files(disc)
    # And the other one has no port of the rig.
    files = [str(path) for path in _open_files(disc) if path != partial]
    assert not [path for path in files if path.startswith("/dev/") and path != os.devnull]
    assert len([path for path in files if path.startswith("socket")]) == 1


def test_a_capture_goes_on_in_a_new_run_when_the_disc_process_was_killed(begun, partial_of, acquire):
    simulation, child, out = begun
    partial_of(out, child, states=2)
    os.kill(_disc_process(child.pid), signal.SIGKILL)
    _, err = child.communicate(timeout=60)
    assert child.returncode == 1
    assert "the process that writes the captures has ended" in err
    assert not simulation.light()


def test_stop_writes_nothing(acquire, small_rig, tmp_path, monkeypatch):
    """The home folder may be on the disc that hangs."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home"))
    code, out, _ = acquire("stop", "--rig", small_rig("rig.yaml"))
    assert code == 0
    assert "Ctrl-C" in out
    assert not (tmp_path / "home").exists()


def test_a_command_that_a_page_starts_has_its_output_written_by_another(tmp_path):
    jobs, files = Jobs(tmp_path), set()
    job = jobs.start("move", ["acquire", "move", "psg", "90"], {}, tmp_path)
    while jobs.running(job):
        with contextlib.suppress(FileNotFoundError):
            files.update(_open_files(job.pid))
        time.sleep(0.005)
    _wait_for(lambda: jobs.code(job) == 0)
    assert "psg at 90" in jobs.output(job)
    assert files
    assert not [path for path in files if tmp_path in path.parents]


@pytest.mark.timeout(120)
def test_a_wire_log_on_a_disc_that_hangs_holds_up_no_light(small_rig, tmp_path):
    """The process that writes the log is stopped: its pipe takes 64 KiB, and a write waits for ever then."""
    small_rig("rig.yaml")
    with serve(tmp_path / "rig.yaml", tmp_path / "served.yaml", "red_sphere") as simulation:
        config = load_rig(tmp_path / "served.yaml").model_copy(update={"wire_log": tmp_path / "wire"})
        with open_rig(config, with_camera=False) as rig:
            hung = [child for child in _children(os.getpid()) if str(tmp_path / "wire") in _command(child)]
            assert hung
            for child in hung:
                os.kill(child, signal.SIGSTOP)
            rig.source.set_light(True)
            for _ in range(1000):
                rig.source.is_on()
            rig.source.set_light(False)
            assert simulation.light() == 0
        for child in hung:
            os.kill(child, signal.SIGCONT)
