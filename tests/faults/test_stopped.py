"""Promise 3: Ctrl-C once finishes the state, parks and seals; twice stops the axes and keeps the partial file."""

import random
import signal
import time

import pytest

from processing.storage.captures.capture import Capture
from simulators.rig.served_rig import serve


@pytest.fixture
def served(quick_rig, tmp_path):
    """A rig whose emulators live in this process, so that they outlast the program that is stopped."""
    with serve(quick_rig("behind.yaml", clock_speed=4), tmp_path / "served.yaml", "red_sphere") as simulation:
        yield simulation, tmp_path / "served.yaml"


def _moving(simulation):
    return [axis.is_moving() for emulator in simulation.emulators.values() for axis in emulator.axes]


@pytest.mark.long
def test_once_finishes_the_state_parks_and_seals_and_the_capture_goes_on(spawn, partial_of, served, intact, tmp_path):
    simulation, rig = served
    child = spawn("--omega", 35, "--rig", rig, "--out", tmp_path / "out")
    partial_of(tmp_path / "out", child, states=5)
    child.send_signal(signal.SIGINT)
    out, err = child.communicate()
    assert child.returncode == 130, err
    assert "stopping after this state" in err
    (final,) = (tmp_path / "out").glob("*.h5")
    with Capture(final) as capture:
        assert capture.status == "aborted"
    assert 5 <= intact(final) < 44
    assert f"--resume {final}" in out
    assert simulation.true_angles_deg()["arm"] == pytest.approx(90, abs=0.01)
    assert not simulation.light()
    child = spawn("--resume", final)
    _, err = child.communicate()
    assert child.returncode == 0, err
    assert intact(final) == 44


def test_twice_stops_the_axes_within_a_second(spawn, partial_of, served, intact, runs, tmp_path):
    simulation, rig = served
    chance = random.Random(5)
    for number in range(runs):
        folder = tmp_path / f"out{number}"
        child = spawn("--omega", 35, "--rig", rig, "--out", folder)
        partial = partial_of(folder, child)
        time.sleep(chance.uniform(0, 3))
        child.send_signal(signal.SIGINT)
        time.sleep(chance.uniform(0, 0.05))
        child.send_signal(signal.SIGINT)
        asked_s = simulation.clock.base.now_s()
        while any(_moving(simulation)):
            time.sleep(0.005)
        # A second in which this process could run; the one that stops had no more than that.
        assert simulation.clock.base.now_s() - asked_s < 1.0
        _, err = child.communicate()
        assert child.returncode == 130, err
        assert not any(_moving(simulation))
        assert "Traceback" not in err
        assert "stopped at once" in err or not partial.exists()
        # A state may have been the last one: then the first Ctrl-C had already ended the run in order.
        capture = partial if partial.exists() else next(folder.glob("*.h5"))
        intact(capture)


def test_once_at_random_times(spawn, partial_of, served, intact, runs, tmp_path):
    _, rig = served
    chance = random.Random(6)
    for number in range(runs):
        folder = tmp_path / f"out{number}"
        child = spawn("--omega", 35, "--rig", rig, "--out", folder)
        partial_of(folder, child)
        time.sleep(chance.uniform(0, 3))
        child.send_signal(signal.SIGINT)
        _, err = child.communicate()
        (final,) = folder.glob("*.h5")
        with Capture(final) as capture:
            done, status = len(capture.done), capture.status
        assert (child.returncode, status) in ((130, "aborted"), (0, "complete")), err
        assert done == 44 or status == "aborted"
        intact(final)
