"""Promises 2 and 10: no room on the disc, or the rig is in use; and 12: clean-up that fails itself."""

import json
import resource
import subprocess
import sys

import pytest

from acquisition.capture.partial_file import bytes_needed
from drivers.errors import DeviceError
from processing.storage.captures.capture import Capture
from simulators.rig.served_rig import serve


def test_disc_too_small_is_refused_before_any_motion(spawn, plan_file, quick_rig, tmp_path):
    rig = quick_rig()

    def starve():
        # A limit on the size of files: what a full disc looks like to the program.
        resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, 200_000))

    child = spawn("--omega", 35, "--plan", plan_file, "--rig", rig, "--out", tmp_path / "out", preexec_fn=starve)
    out, err = child.communicate()
    assert child.returncode == 1, out + err
    needed = bytes_needed(19, 1, (64, 80))
    assert f"needs {needed:,} bytes" in err
    assert "Nothing was moved" in err
    assert "homing" not in err
    assert not list((tmp_path / "out").glob("*"))


def test_second_program_is_refused_with_the_name_of_the_first(spawn, partial_of, plan_file, quick_rig, tmp_path):
    with serve(quick_rig("behind.yaml", clock_speed=2), tmp_path / "rig.yaml", "red_sphere") as simulation:
        first = spawn("--omega", 35, "--plan", plan_file, "--rig", tmp_path / "rig.yaml", "--out", tmp_path / "first")
        partial_of(tmp_path / "first", first, states=2)
        second = spawn("--omega", 35, "--plan", plan_file, "--rig", tmp_path / "rig.yaml", "--out", tmp_path / "second")
        _, err = second.communicate()
        assert second.returncode == 1
        assert f"pid {first.pid}" in err
        assert not list((tmp_path / "second").glob("*"))
        # The first one has not noticed.
        simulation.clock.speed = 50
        _, err = first.communicate()
        assert first.returncode == 0, err


def test_a_rig_served_by_the_command_line_takes_a_capture(quick_rig, plan_file, acquire, intact, tmp_path):
    """Emulators in a program of their own: the drivers see ports and an address, nothing else."""
    command = [sys.executable, "-m", "simulators.cli", "rig", quick_rig("behind.yaml"), "--out", tmp_path / "rig.yaml"]
    server = subprocess.Popen([*map(str, command)], stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout.readline().strip() == str(tmp_path / "rig.yaml")
        assert "sim:" not in (tmp_path / "rig.yaml").read_text()
        out = acquire.made(
            "--omega", 35, "--plan", plan_file, "--rig", tmp_path / "rig.yaml", "--out", tmp_path / "out"
        )
        assert "SIMULATED" in out
        assert intact(next((tmp_path / "out").glob("*.h5"))) == 19
    finally:
        server.terminate()
        server.communicate()


def test_a_capture_that_is_being_written_cannot_be_resumed(spawn, partial_of, plan_file, quick_rig, acquire, tmp_path):
    child = spawn("--omega", 35, "--plan", plan_file, "--rig", quick_rig(), "--out", tmp_path / "out")
    partial = partial_of(tmp_path / "out", child, states=2)
    code, _, err = acquire("--resume", partial)
    assert code != 0
    assert "Traceback" not in err
    assert str(partial) in err


@pytest.mark.parametrize("broken", ["psg", "source"])
def test_every_clean_up_step_runs_although_one_fails(run_with, intact, broken):
    stopped = []

    def act(rig, state, retake):
        if state != 5:
            return

        def failing():
            raise DeviceError(f"stop {broken}", "it does not answer", "Pull the plug")

        for name, axis in rig.axes.items():
            real = axis.stop
            axis.stop = failing if name == broken else (lambda name=name, real=real: (stopped.append(name), real()))
        if broken == "source":
            rig.source.set_light = lambda on: failing()
        raise DeviceError("something", "broke", "Mend it")

    error, path = run_with(act)
    # The first error is the one reported; what failed while cleaning up is attached to it.
    assert str(error).startswith("something: broke")
    if broken == "source":
        with Capture(path) as capture:
            assert any("light could not be shut off" in text for text in capture.closing["messages"])
    else:
        assert any(broken in note and "does not answer" in note for note in error.__notes__)
    assert set(stopped) >= {"psg", "psa", "arm"} - {broken}
    with Capture(path) as capture:
        assert capture.status == "failed"
        assert "broke" in json.dumps(capture.closing)
    assert intact(path) >= 4
