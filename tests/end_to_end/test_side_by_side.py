"""Several simulated rigs at once on one machine: each camera takes a loopback address of its own."""

import subprocess

import pytest

from acquisition.rig.config import load_rig
from acquisition.rig.open_rig import open_rig
from acquisition.rig.rig import Rig
from drivers.errors import CameraError
from simulators.camera.loopback_address import loopback_addresses


@pytest.fixture
def second_address():
    """127.0.0.2, for the time of the test; it is a matter of root, and of a network of our own."""
    if "127.0.0.2" in loopback_addresses():
        pytest.skip("this machine has it already, perhaps in use")
    add = ["ip", "addr", "add", "127.0.0.2/8", "dev", "lo"]
    try:
        subprocess.run(add, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("no right to add an address")
    yield
    subprocess.run(["ip", "addr", "del", "127.0.0.2/8", "dev", "lo"], check=True)


def _frame(rig: Rig, exposure_s: float):
    rig.set_exposure(exposure_s, 1)
    return rig.require_camera().capture(1)[0].pixels


def test_two_simulated_rigs_measure_at_once(small_rig, second_address):
    configs = [load_rig(small_rig(f"{k}.yaml", seed=k, rows=24 + 8 * k, columns=32)) for k in (0, 1)]
    with open_rig(configs[0]) as first, open_rig(configs[1]) as second:
        shapes = [_frame(rig, 0.002).shape for rig in (first, second, first)]
    assert shapes == [(24, 32), (32, 32), (24, 32)]


def test_without_a_free_address_it_says_how_to_get_one(small_rig):
    config = load_rig(small_rig(camera_wait_s=0.2))
    if len(loopback_addresses()) > 1:
        pytest.skip("this machine has more than one")
    with open_rig(config), pytest.raises(CameraError, match=r"ip addr add 127\.0\.0\.2/8 dev lo"), open_rig(config):
        pass
