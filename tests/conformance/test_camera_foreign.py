"""A camera that nobody here wrote: Debian's `arv-fake-gv-camera-0.8` (package aravis-tools)."""

from __future__ import annotations

import shutil
import subprocess
import time
from collections.abc import Iterator

import pytest

from drivers.camera import CameraSettings
from drivers.cameras import aravis
from drivers.errors import CameraNotFound, FrameLost

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
