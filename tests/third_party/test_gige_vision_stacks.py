"""GigE Vision stacks that nobody here wrote (viva-genicam, telegenicam), on loopback and across a virtual cable."""

import os
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest

from drivers.camera import CameraSettings
from drivers.cameras import aravis
from simulators.camera.gige_camera import GigeCamera
from simulators.camera.node_map import node_maps

pytestmark = pytest.mark.third_party
if not os.environ.get("CI"):
    pytest.importorskip("viva_genicam")
    pytest.importorskip("telegenic")

COUNTS = (np.arange(48 * 64, dtype=np.uint16) % 4096).reshape(48, 64)
# A camera may be blind for so long after an exposure.
ARMED_S = 0.2


@pytest.fixture(params=node_maps())
def shift(request: pytest.FixtureRequest) -> Iterator[int]:
    """A simulated camera as our driver leaves it: set to neutral, with a software trigger. Its 16 bits are shifted."""
    with GigeCamera("SN1", 64, 48, lambda _: COUNTS, description=request.param):
        with aravis.open("camera", aravis.Config(device="127.0.0.1", chunk_timestamp=False)) as camera:
            camera.configure(CameraSettings(exposure_s=0.01))
            bits = camera.describe().shift
        yield bits


def assert_are_the_counts(payload: bytes, shift: int) -> None:
    """8 bits are the upper ones of the 12."""
    eight = len(payload) == COUNTS.size
    pixels = np.frombuffer(payload, np.uint8 if eight else np.uint16).reshape(COUNTS.shape)
    np.testing.assert_array_equal(pixels >> shift, COUNTS >> 4 if eight else COUNTS)


def test_viva_genicam_drives_a_simulated_camera(shift: int) -> None:
    import viva_genicam

    (device,) = viva_genicam.discover(all=True)
    with viva_genicam.connect_gige(device) as camera:
        assert not camera.skipped()
        assert camera.get_integer("Width") == 64
        with camera.stream() as frames:
            for block in (1, 2):
                time.sleep(ARMED_S)
                camera.trigger_software()
                frame = frames.next_frame(timeout_ms=5000)
                assert frame is not None
                assert (frame.block_id, frame.is_complete) == (block, True)
                assert_are_the_counts(frame.payload(), shift)


def test_telegenicam_drives_a_simulated_camera(shift: int) -> None:
    import telegenic

    camera = telegenic.Camera("127.0.0.1")
    camera.connect()
    try:
        # Its snapshot is an acquisition of one frame, and waits for no trigger.
        camera.set_enum("TriggerMode", "Off")
        with camera.snapshot_session() as session:
            for _ in range(2):
                time.sleep(ARMED_S)
                frame = session.snap(timeout=5.0)
                assert frame.status == telegenic.FrameStatus.Complete
                assert_are_the_counts(bytes(frame.data()), shift)
    finally:
        camera.disconnect()


@pytest.mark.parametrize("pixel_format", ["Mono8", "Mono16"])
def test_our_driver_drives_the_camera_of_viva_genicam(pixel_format: str) -> None:
    from viva_genicam.testing import FakeGigeCamera

    with (
        FakeGigeCamera(width=640, height=480, pixel_format=pixel_format) as fake,
        # It does not wait for its exposure.
        aravis.open("camera", aravis.Config(device=fake.ip, retakes=0, answers_early=True)) as camera,
    ):
        assert camera.describe().model == "VivaCam Fake"
        camera.configure(CameraSettings(exposure_s=0.02, pixel_format=pixel_format, width=640, height=480))
        triggers = fake.software_triggers()
        frames = camera.capture(3)
        assert fake.software_triggers() - triggers == len({frame.frame_id for frame in frames}) == 3
        # Its picture is a ramp in both directions that moves.
        assert all(len(np.unique(frame.pixels)) > 100 for frame in frames)


CAMERA = """
from simulators.camera.gige_camera import GigeCamera
import numpy, time
counts = (numpy.arange(48 * 64, dtype=numpy.uint16) % 4096).reshape(48, 64)
with GigeCamera("SN1", 64, 48, lambda _: counts, description="lucid_tri050s_p", address="10.9.0.2"):
    print("ready", flush=True)
    time.sleep(60)
"""


def run(*words: str) -> None:
    """A command of the network, which must succeed."""
    subprocess.run(words, check=True, capture_output=True)


@pytest.fixture
def beyond_a_cable() -> Iterator[None]:
    """A simulated camera at the far end of a virtual cable, in a network of its own."""
    if os.geteuid() != 0 or shutil.which("ip") is None or shutil.which("nsenter") is None:
        pytest.skip("making a cable needs root, ip (iproute2) and nsenter (util-linux)")
    with subprocess.Popen(["unshare", "--net", "sleep", "60"]) as far:
        try:
            time.sleep(0.3)
            namespace = ("nsenter", "--target", str(far.pid), "--net")
            run("ip", "link", "add", "near", "type", "veth", "peer", "name", "far")
            run("ip", "link", "set", "far", "netns", str(far.pid))
            run("ip", "addr", "add", "10.9.0.1/24", "dev", "near")
            run("ip", "link", "set", "near", "up")
            run(*namespace, "ip", "addr", "add", "10.9.0.2/24", "dev", "far")
            run(*namespace, "ip", "link", "set", "far", "up")
            run(*namespace, "ip", "link", "set", "lo", "up")
            with subprocess.Popen([*namespace, sys.executable, "-c", CAMERA], stdout=subprocess.PIPE) as camera:
                assert camera.stdout is not None
                assert camera.stdout.readline() == b"ready\n"
                try:
                    yield
                finally:
                    camera.kill()
        finally:
            far.kill()


def test_a_camera_beyond_a_cable_is_found_by_broadcast(beyond_a_cable: None) -> None:
    import telegenic
    import viva_genicam

    assert [device.ip for device in viva_genicam.discover()] == ["10.9.0.2"]
    assert [device.serial for device in telegenic.discover()] == ["SN1"]
    with aravis.open("camera", aravis.Config(device="SN1")) as camera:
        assert (camera.describe().interface, camera.describe().interface_mtu) == ("near", 1500)
        camera.configure(CameraSettings(exposure_s=0.01))
        for frame in camera.capture(2):
            np.testing.assert_array_equal(frame.pixels, COUNTS)
