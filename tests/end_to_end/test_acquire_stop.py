"""`acquire stop` while another program uses the rig, and questions before something turns."""

import contextlib
import os
import signal
import subprocess
import sys
import time

import pytest

from acquisition.rig.config import load_rig
from acquisition.rig.open_rig import open_rig
from processing.storage.captures.capture import Capture
from simulators.rig.served_rig import serve
from tests.rig_files import change_yaml

#: Far enough that nothing arrives by itself while a test runs, at the emulators' speed.
FAR_DEG = 30_000.0


@pytest.fixture
def served(small_rig, tmp_path):
    with serve(small_rig("behind.yaml", clock_speed=3), tmp_path / "served.yaml", "red_sphere") as simulation:
        yield simulation, tmp_path / "served.yaml"


@contextlib.contextmanager
def _program(*arguments):
    process = subprocess.Popen(
        [sys.executable, *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def _wait_until(condition, process):
    while not condition():
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)


def _moving(simulation):
    return any(axis.is_moving() for emulator in simulation.emulators.values() for axis in emulator.axes)


def test_a_running_capture_is_stopped_and_kept(acquire, served, tmp_path):
    simulation, rig = served
    arguments = ("-m", "acquisition.commands.application", "--omega", 35, "--rig", rig, "--out", tmp_path / "captures")
    with _program(*arguments) as running:
        # All axes are homed: the first approach or a state is under way.
        rotators = simulation.emulators["rotators"].axes
        _wait_until(lambda: all(axis.homed for axis in rotators) and _moving(simulation), running)
        code, out, err = acquire("stop", "--rig", rig)
        assert code == 0, out + err
        assert f"(pid {running.pid}) measures on this rig: asked to stop at once" in out
        for axis in ("psg", "psa", "arm"):
            assert f"{axis}: stop sent, at rest at " in out
        assert not _moving(simulation)
        assert running.wait() == 130
    partial = next((tmp_path / "captures").glob("*.partial"))
    with Capture(partial) as capture:
        assert capture.status == "aborted"
        assert len(capture.done) < 44


def test_another_program_is_named_and_left_alone(acquire, served):
    _, rig = served
    port = load_rig(rig).axes["psg"].port
    with _program(
        "-c", f"import time; f = open('{port}', 'rb'); print('open', flush=True); time.sleep(3600)"
    ) as program:
        assert program.stdout.readline() == "open\n"
        code, out, _ = acquire("stop", "--rig", rig)
        assert code == 1
        assert f"(pid {program.pid}) holds a port of this rig; it is not acquire and gets no signal" in out
        assert "psg: NOT STOPPED" in out
        # The other line is stopped all the same.
        assert "arm: stop sent, at rest" in out
        assert program.poll() is None
        code, out, _ = acquire("doctor", "--frames", 1, "--rig", rig)
        assert code == 1
        busy = next(line for line in out.splitlines() if "axis psg" in line)
        assert busy.startswith("BAD")
        assert f"(pid {program.pid})" in busy


def test_a_move_that_nobody_waits_for_is_stopped_where_it_can_be(acquire, small_rig, tmp_path):
    elliptec = {"kind": "elliptec", "port": "sim:mount", "address": "0"}
    zaber = {"kind": "zaber", "port": "sim:rotators", "address": 1}
    ports = {
        "rotators": {"kind": "zaber", "axes": 1, "speed_deg_s": 100, "homed": True},
        "mount": {"kind": "elliptec", "axes": 1, "speed_deg_s": 100, "homed": True},
        "shutter": {"kind": "sc10"},
    }
    without_arm = {"park_deg": {}, "backlash_deg": {}, "homing": {}, "home_order": [], "forbidden": [], "solids": None}
    behind = small_rig(
        "behind.yaml", {"axes": {"psg": zaber, "psa": elliptec | {"assume_homed": True}}} | without_arm,
        clock_speed=1, ports=ports, axes={"psg": {"port": "rotators"}, "psa": {"port": "mount"}},
    )  # fmt: skip
    with serve(behind, tmp_path / "served.yaml", "red_sphere") as simulation:
        with open_rig(load_rig(tmp_path / "served.yaml"), with_camera=False) as rig:
            rig.start_moves({"psg": FAR_DEG, "psa": 300.0})
        assert _moving(simulation)
        code, out, err = acquire("stop", "--rig", tmp_path / "served.yaml")
        assert code == 0, out + err
        assert not _moving(simulation)
        true = simulation.true_angles_deg()
        assert 0 < true["psg"] < FAR_DEG / 2
        assert true["psa"] == pytest.approx(300, abs=0.1)
        assert "psa: stop sent, at rest" in out
        assert "runs a started move to its end" in out


def test_emulators_of_another_command_are_out_of_reach(acquire, small_rig):
    code, out, _ = acquire("stop", "--rig", small_rig())
    assert code == 0
    assert "press Ctrl-C twice there" in out


def _declare_real(rig):
    """Real devices at real ports, as far as the command can tell: so it must ask."""
    change_yaml(rig, lambda tree: tree.update(simulated=False))


def test_homing_asks_first(acquire, served):
    simulation, rig = served
    _declare_real(rig)
    code, out, err = acquire("home", "--rig", rig)
    assert code == 130
    assert "in this order: arm, psg, psa" in out
    assert "nothing was moved" in err
    assert not any(axis.homed or axis.is_moving() for axis in simulation.emulators["rotators"].axes)
    acquire.made("home", "psa", "--yes", "--rig", rig)
    assert [axis.homed for axis in simulation.emulators["rotators"].axes] == [False, True]
    out = acquire.made("move", "psa", -12.5, "--rig", rig)
    assert "psa at -12.5" in out
    assert simulation.true_angles_deg()["psa"] == pytest.approx(-12.5, abs=0.01)


def test_ctrl_c_stops_a_move(served):
    simulation, rig = served
    with _program("-m", "acquisition.commands.application", "move", "psg", FAR_DEG, "--home", "--rig", rig) as running:
        axis = simulation.emulators["rotators"].axes[0]
        _wait_until(lambda: axis.homed and axis.is_moving(), running)
        os.kill(running.pid, signal.SIGINT)
        assert running.wait() == 130
        # The stop was sent before the end; a busy emulator reads it later.
        while axis.is_moving():
            time.sleep(0.02)
        assert axis.position_deg() < FAR_DEG / 2
