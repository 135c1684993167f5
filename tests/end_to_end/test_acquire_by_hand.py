"""`acquire doctor`, `home`, `move`, `stop` and `snap` on a rig whose emulators outlast the command."""

import re

import cv2
import numpy as np
import pytest

from simulators.rig.served_rig import serve
from tests.rig_files import change_yaml

BLACK_LEVEL = 64


@pytest.fixture
def served(small_rig, tmp_path):
    with serve(small_rig("behind.yaml"), tmp_path / "served.yaml", "red_sphere") as simulation:
        yield simulation, tmp_path / "served.yaml"


def _positions(simulation):
    return simulation.true_angles_deg() | {"light": simulation.light()}


def test_doctor_tells_what_is_there_and_moves_nothing(acquire, served):
    simulation, rig = served
    before = _positions(simulation)
    code, out, err = acquire("doctor", "--rig", rig)
    assert code == 0, out + err
    for words in (
        "axis psg",
        "NOT homed",
        "serial 110001",
        "interlock closed",
        "0 of 50 frames lost",
        "GB free",
        "h5py",
    ):
        assert words in out
    assert _positions(simulation) == before


def test_doctor_names_each_failure_and_goes_on(acquire, served):
    simulation, rig = served

    def edit(tree):
        tree["axes"]["psa"]["address"] = 9
        tree["axes"]["arm"]["port"] = "/dev/ttyNOTHERE"

    change_yaml(rig, edit)
    simulation.emulators["shutter"].trip(True)
    code, out, err = acquire("doctor", "--rig", rig)
    assert code == 1
    assert "not as it should be: axis psa, axis arm, source\n" in err
    bad = [line for line in out.splitlines() if line.startswith("BAD")]
    assert any("psa" in line and "address 9" in line for line in bad)
    assert any("/dev/ttyNOTHERE" in line for line in bad)
    assert any("INTERLOCK OPEN" in line for line in bad)
    assert "axis psg" in out
    assert "0 of 50 frames lost" in out


def test_doctor_measures_packet_loss(acquire, served):
    """Packets that are lost are asked for again: of a small frame nearly all must be lost before it is."""
    simulation, rig = served
    simulation.camera.lost_ratio = 0.9
    code, out, _ = acquire("doctor", "--frames", 6, "--rig", rig)
    assert code == 1
    camera = next(line for line in out.splitlines() if "frames lost" in line)
    assert camera.startswith("BAD")
    assert "0 of 6 " not in camera


def test_home_then_move_then_stop(acquire, served):
    simulation, rig = served
    change_yaml(rig, lambda tree: tree.update(home_at_start=False))
    code, _, err = acquire("move", "arm", 30, "--rig", rig)
    assert code == 1
    assert "no reference" in err
    assert acquire("home", "arm", "--rig", rig)[0] == 0
    out = acquire.made("move", "arm", 30, "--rig", rig)
    assert "arm at 30.0" in out
    assert simulation.true_angles_deg()["arm"] == pytest.approx(30, abs=0.01)
    # The other axes were not homed, because nobody asked.
    assert not simulation.emulators["rotators"].axes[0].homed
    code, out, _ = acquire("stop", "--rig", rig)
    assert code == 0
    assert "psg: stop sent, at rest" in out
    assert "arm: stop sent, at rest at 30.0" in out


@pytest.mark.parametrize(
    ("axis", "degrees", "words"), [("arm", 200, "limits"), ("arm", 3, "forbidden"), ("x", 1, "psg")]
)
def test_move_is_refused(acquire, served, axis, degrees, words):
    simulation, rig = served
    acquire("home", "arm", "--rig", rig)
    before = _positions(simulation)
    code, _, err = acquire("move", axis, degrees, "--rig", rig)
    assert code != 0
    assert words in err
    assert _positions(simulation) == before


def test_snap_writes_counts_and_leaves_the_light_as_it_was(acquire, served, tmp_path):
    simulation, rig = served
    out = acquire.made("snap", "--rig", rig, "--out", tmp_path / "frame.tif", "--exposure", 0.02)
    assert "SIMULATED" in out
    frame = cv2.imread(str(tmp_path / "frame.simulated.tif"), cv2.IMREAD_UNCHANGED)
    assert frame.dtype == "uint16"
    assert frame.shape == (64, 80)
    assert not simulation.light()


def test_snap_sees_the_bench_as_it_is_not_as_it_was_declared(acquire, small_rig, dim_instrument, tmp_path):
    means = []
    for name, simulator in (("declared", {}), ("true", {"truth": {"drr": str(dim_instrument)}})):
        rig = small_rig(f"{name}.yaml", rows=24, columns=32, **simulator)
        acquire.made("snap", "--rig", rig, "--out", tmp_path / f"{name}.npy", "--exposure", 0.1, "--light")
        means.append(np.load(tmp_path / f"{name}.simulated.npy").mean() - BLACK_LEVEL)
    assert means[1] == pytest.approx(0.1 * means[0], rel=0.05)


def test_a_wire_log_holds_every_byte_of_every_line(acquire, served, tmp_path):
    _, rig = served
    change_yaml(rig, lambda tree: tree.update(wire_log="wire"))
    code, out, err = acquire("home", "psg", "--rig", rig, "--yes")
    assert code == 0, out + err
    logs = [path.read_text() for path in (tmp_path / "wire").glob("*.log")]
    assert len(logs) == 3  # rotators, arm, shutter
    assert any(re.search(r">> /1 1 \d\d home:", log) and "OK BUSY" in log for log in logs)
