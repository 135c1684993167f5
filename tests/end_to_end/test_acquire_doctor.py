"""`acquire doctor` and `snap` on rigs with something wrong, and with every kind of source."""

import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from simulators.rig.served_rig import serve
from tests.rig_files import change_yaml

PORTS = {
    "rotators": {"kind": "zaber", "axes": 2, "homed": True},
    "arm": {"kind": "smc100", "axes": 1, "speed_deg_s": 40, "acceleration_deg_s2": 80},
}


@pytest.fixture
def changed(small_rig, tmp_path):
    """A served rig whose file is edited after the emulators have started."""
    with serve(small_rig("behind.yaml"), tmp_path / "served.yaml", "red_sphere"):
        yield partial(change_yaml, tmp_path / "served.yaml")


def _line(out, topic):
    return next(line for line in out.splitlines() if f"  {topic}  " in f"  {line}")


def test_wrong_devices_are_told_with_what_is_there(acquire, changed):
    def edit(tree):
        tree["axes"]["psg"] = {"kind": "zaber", "port": tree["axes"]["psg"]["port"], "serial_number": 4711}
        tree["camera"]["device"] = "NO-SUCH-CAMERA"

    code, out, err = acquire("doctor", "--frames", 3, "--rig", changed(edit))
    assert code == 1
    assert "not as it should be: axis psg, camera\n" in err
    axis, camera = _line(out, "axis psg"), _line(out, "camera")
    assert axis.startswith("BAD")
    assert "4711" in axis
    assert "110001" in axis
    assert camera.startswith("BAD")
    assert "NO-SUCH-CAMERA" in camera
    assert "SIM-1" in camera
    assert _line(out, "axis psa").startswith("ok ")


@pytest.mark.parametrize(
    ("camera", "detector", "words"),
    [
        ({"packet_size": 65535 - 1, "interface": "lo"}, {}, "0 of 3 frames lost"),
        ({"interface": "enp99s0"}, {}, "enp99s0"),
        ({}, {"bits": 10}, "says 10 bits"),
    ],
)
def test_the_link_and_the_bits_of_the_camera(acquire, changed, camera, detector, words):
    def edit(tree):
        tree["camera"].update(camera)
        tree["detector"].update(detector)

    code, out, _ = acquire("doctor", "--frames", 3, "--rig", changed(edit))
    assert words in _line(out, "camera")
    assert code == (0 if "frames lost" in words else 1)
    if code == 0:
        assert "counts in steps of 1 up to 4095" in _line(out, "camera")
        assert "packets of 65534 bytes, lo takes up to 65536" in out


def test_a_package_that_leaks_in_is_an_error(small_rig, tmp_path):
    (tmp_path / "leak").mkdir()
    (tmp_path / "leak" / "numpy").symlink_to(Path(np.__file__).parent)
    done = subprocess.run(
        [sys.executable, "-m", "acquisition.commands.application", "doctor", "--frames", "1", "--rig", small_rig()],
        env=os.environ | {"PYTHONPATH": str(tmp_path / "leak")}, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 1, done.stderr
    assert _line(done.stdout, "numpy").startswith("BAD")
    assert str(tmp_path / "leak") in done.stdout
    assert "not as it should be: numpy\n" in done.stderr


@pytest.mark.parametrize("wavelength", [662, 524])
def test_snap_with_an_led_driver_has_the_light_that_was_selected(acquire, small_rig, tmp_path, wavelength):
    source = {"kind": "dc4100", "port": "sim:leds", "percent": {662: 100, 524: 0}}
    rig = small_rig(top={"source": source, "interlocks": []}, ports=PORTS | {"leds": {"kind": "dc4100"}})
    out_file = tmp_path / "frame.npy"
    acquire.made("snap", "--wavelength", wavelength, "--rig", rig, "--out", out_file, "--sample", "red_flat")
    mean = np.load(tmp_path / "frame.simulated.npy").mean()
    # The black level is 64: at 0 % nothing is added to it.
    assert (mean > 80) == (wavelength == 662)
    assert abs(mean - 64) < 1 or wavelength == 662


def test_snap_without_a_wavelength_asks_for_one(acquire, small_rig, tmp_path):
    source = {"kind": "dc4100", "port": "sim:leds"}
    rig = small_rig(top={"source": source, "interlocks": []}, ports=PORTS | {"leds": {"kind": "dc4100"}})
    code, _, err = acquire("snap", "--rig", rig, "--out", tmp_path / "frame.png")
    assert code == 1
    assert "no wavelength was selected" in err
    assert ".npy" in acquire.refused("snap", "--rig", rig, "--out", tmp_path / "frame.bmp")


def test_a_source_switched_by_hand_needs_no_port(acquire, small_rig):
    rig = small_rig(top={"source": {"kind": "manual"}, "interlocks": []}, ports=PORTS)
    code, out, err = acquire("doctor", "--frames", 1, "--rig", rig)
    assert code == 0, out + err
    assert "switched by the operator" in _line(out, "source")


def test_lost_packets_are_told_with_what_to_change(acquire, small_rig):
    camera = {"kind": "aravis", "bits": 12, "packet_size": 1500, "resend": False, "features": {"GevSCPD": 700}}
    rig = small_rig(top={"camera": camera}, packet_loss=0.02, rows=300, columns=400)
    code, out, _ = acquire("doctor", "--frames", 3, "--rig", rig)
    line = _line(out, "camera")
    assert code == 1
    assert "pause between packets 700 ticks (GevSCPD), lost packets not asked for again" in line
    assert "set packet_size to 9000, which lo takes" in line
    assert "set `resend: true`" in line
    assert "GevSCPD: 1400" in line
