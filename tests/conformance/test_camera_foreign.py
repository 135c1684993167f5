"""Cameras that nobody here wrote: `arv-fake-gv-camera-0.8` of Debian's aravis-tools, and one of Aravis off Ethernet."""

import shutil
import subprocess
import time
from collections.abc import Iterator

import pytest

from drivers.aravis_library import load_aravis
from drivers.camera import CameraSettings
from drivers.cameras import aravis
from drivers.errors import CameraNotFound, FrameLost, SettingRefused

PROGRAM = "arv-fake-gv-camera-0.8"


@pytest.fixture
def foreign() -> Iterator[None]:
    """Run the camera on loopback."""
    if shutil.which(PROGRAM) is None:
        pytest.skip(f"{PROGRAM} is not installed (Debian: aravis-tools); ./lab test installs it")
    with subprocess.Popen([PROGRAM, "-i", "127.0.0.1"]) as process:
        try:
            yield
        finally:
            process.kill()


def open_foreign(**options: object) -> aravis.AravisCamera:
    """Open it as soon as it answers."""
    config = aravis.Config(device="127.0.0.1", **options)  # type: ignore[arg-type]
    for _ in range(20):
        try:
            return aravis.open("camera", config)
        except CameraNotFound:
            time.sleep(0.1)
    return aravis.open("camera", config)


REGION = {"width": 512, "height": 256, "pixel_format": "Mono8"}


def test_frames_before_the_end_of_their_exposure_are_called_what_they_are(
    foreign: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.cameras.aravis._TRANSFER_MARGIN_S", 0.3)
    with open_foreign(retakes=0) as camera:
        camera.configure(CameraSettings(exposure_s=0.5, **REGION))
        with pytest.raises(FrameLost, match=r"before the 0\.5 s of its exposure.*answers_early") as lost:
            camera.capture(5)
    assert "cable" not in str(lost.value)


def test_a_camera_that_answers_early_can_be_declared(foreign: None) -> None:
    with open_foreign(retakes=0, answers_early=True) as camera:
        camera.configure(CameraSettings(exposure_s=0.1, **REGION))
        ids = [frame.frame_id for frame in camera.capture(10)]
        assert ids == list(range(ids[0], ids[0] + 10))
        assert camera.statistics().stale_discarded == 0


def test_a_camera_off_ethernet_has_no_packets() -> None:
    # What can be tried of USB3 Vision without a camera: everything but its transport.
    library, _ = load_aravis()
    library.enable_interface("Fake")
    try:
        config = aravis.Config(device="Fake_1", answers_early=True, settings=CameraSettings(exposure_s=0.01))
        with aravis.open("camera", config) as camera:
            camera.configure(CameraSettings(width=128, height=96))
            who = camera.describe()
            assert (who.packet_size, who.packet_delay, who.resend, who.interface_mtu) == (None, None, None, None)
            assert [frame.pixels.shape for frame in camera.capture(2)] == [(96, 128)] * 2
            assert camera.statistics().missing_packets == 0
            with pytest.raises(SettingRefused, match="not on Ethernet"):
                camera.configure(CameraSettings(packet_size=1500))
    finally:
        library.disable_interface("Fake")
