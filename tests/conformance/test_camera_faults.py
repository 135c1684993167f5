"""The camera when things go wrong: lost packets, stale frames, a stolen or vanished camera, Ctrl-C."""

import os
import signal
import socket
import struct
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.camera import CameraSettings
from drivers.cameras import aravis
from drivers.errors import CameraError, FrameLost
from simulators.camera.exposure import ExposureInfo
from simulators.camera.gige_camera import GigeCamera
from simulators.camera.pixel_stamp import read_stamp
from simulators.clock import patient_clock
from simulators.conformance.camera import LightScene, pixel_source

SIZE = (128, 64)


def expose_unasked(simulated: GigeCamera, scene: LightScene) -> None:
    """Start an exposure behind the driver's back; returns when it has begun, however busy the machine is."""
    before, deadline_s = scene.exposures, patient_clock().now_s() + 10
    simulated.fire(unasked=True)
    while scene.exposures == before:
        assert patient_clock().now_s() < deadline_s, "the camera did not start the exposure"
        time.sleep(0.001)


@pytest.fixture
def scene() -> LightScene:
    return LightScene()


@pytest.fixture
def simulated(scene: LightScene) -> Iterator[GigeCamera]:
    with GigeCamera("FAULT1", *SIZE, pixel_source(scene)) as camera:
        yield camera


@pytest.fixture
def camera(simulated: GigeCamera) -> Iterator[aravis.AravisCamera]:
    with aravis.open("camera", aravis.Config(device="127.0.0.1", packet_size=1500, bits=12), patient_clock()) as opened:
        opened.configure(CameraSettings(exposure_s=1e-3))
        yield opened


def test_two_percent_of_packets_lost_costs_time_and_nothing_else(scene: LightScene, simulated: GigeCamera) -> None:
    # 14 packets a frame: one frame in four is hit, and that none of 40 is happens once in 80 000 runs.
    config = aravis.Config(device="127.0.0.1", packet_size=1500, bits=12, retakes=12, resend=False)
    with aravis.open("camera", config, patient_clock()) as camera:
        camera.configure(CameraSettings(exposure_s=1e-3))
        simulated.lost_ratio = 0.02
        for state in range(40):
            scene.angle_deg = 9.0 * state
            pixels = camera.capture()[0].pixels
            assert read_stamp(pixels)[0] == 9.0 * state
            assert np.all(pixels[1:] == 100 + scene.exposures)
        statistics = camera.statistics()
    assert statistics.retakes > 0
    assert scene.exposures == 40 + statistics.retakes
    assert statistics.completed == 40


@pytest.mark.parametrize("pause_s", [0.9, 0.3])
def test_a_stray_exposure_before_the_trigger_is_not_taken_for_its_own(
    scene: LightScene, simulated: GigeCamera, camera: aravis.AravisCamera, pause_s: float
) -> None:
    # 0.9 s: its frame waits when the trigger comes. 0.3 s: it still exposes then.
    camera.configure(CameraSettings(exposure_s=0.6))
    camera.capture()
    scene.angle_deg = 1.0
    expose_unasked(simulated, scene)
    patient_clock().sleep_s(pause_s)
    scene.angle_deg = 2.0
    frame = camera.capture()[0]
    assert read_stamp(frame.pixels)[0] == 2.0
    assert camera.statistics().stale_discarded == 1


def test_a_stray_frame_that_arrives_after_the_trigger_is_not_taken_for_its_own(
    scene: LightScene, simulated: GigeCamera, camera: aravis.AravisCamera
) -> None:
    # Exposed 0.1 s before the trigger and delivered 0.2 s after it, when the frame asked for could be there: only the
    # camera's clock tells them apart.
    camera.configure(CameraSettings(exposure_s=0.02))
    camera.capture(2)
    for number in range(3):
        scene.angle_deg = 1.0
        simulated.delivery_delay_s = 0.3
        expose_unasked(simulated, scene)
        patient_clock().sleep_s(0.1)
        scene.angle_deg = 2.0
        simulated.delivery_delay_s = 0.0 if number else 0.05
        frame = camera.capture()[0]
        assert read_stamp(frame.pixels)[0] == 2.0
    assert camera.statistics().stale_discarded == 3
    assert camera.statistics().retakes == 0


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """Python's own answer to Ctrl-C, which is missing where the tests run in the background of a shell."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c")
def test_ctrl_c_gets_through_a_long_wait(simulated: GigeCamera) -> None:
    config = aravis.Config(device="127.0.0.1", trigger_timeout_s=30.0)
    with aravis.open("camera", config, patient_clock()) as camera:
        camera.configure(CameraSettings(exposure_s=1e-3, trigger="hardware"))
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
        start_s = patient_clock().now_s()
        with pytest.raises(KeyboardInterrupt):
            camera.capture()
        assert patient_clock().now_s() - start_s < 3


def test_an_address_holds_one_simulated_camera(simulated: GigeCamera) -> None:
    with pytest.raises(CameraError, match="another camera had it"):
        GigeCamera("FAULT4", *SIZE, pixel_source(LightScene()), wait_s=0.1).start()


def test_a_killed_program_holds_the_camera_for_seconds_only(simulated: GigeCamera) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as killed:
        # Write register: control and switchover, 2 is "mine". No heartbeat follows.
        killed.sendto(struct.pack(">BBHHHII", 0x42, 1, 0x82, 8, 1, 0xA00, 2), ("127.0.0.1", 3956))
        assert killed.recv(64)[:4] == bytes([0, 0, 0, 0x83])
    with aravis.open("camera", aravis.Config(device="127.0.0.1"), patient_clock()) as opened:
        assert opened.describe().serial_number == "FAULT1"


def test_an_address_that_no_interface_has_is_named() -> None:
    with pytest.raises(CameraError, match=r"ip addr add 127\.9\.9\.9"):
        GigeCamera("FAULT5", *SIZE, pixel_source(LightScene()), address="127.9.9.9").start()


def test_an_error_of_the_pixel_source_is_raised_and_its_frame_not_sent() -> None:
    def broken(info: ExposureInfo) -> NDArray[np.uint16]:
        raise ZeroDivisionError("the bench is broken")

    simulated = GigeCamera("FAULT2", *SIZE, broken)
    with simulated, aravis.open("camera", aravis.Config(device="127.0.0.1", retakes=0), patient_clock()) as camera:
        camera.configure(CameraSettings(exposure_s=1e-3))
        with pytest.raises(FrameLost):
            camera.capture()
        with pytest.raises(ZeroDivisionError, match="bench is broken"):
            simulated.check()


@pytest.mark.parametrize(
    "wrong", [np.zeros((64, 128)), np.zeros((2, 2), np.uint16), np.full((64, 128), 5000, np.uint16)]
)
def test_counts_that_the_camera_cannot_send_are_an_error_of_the_source(wrong: NDArray[np.uint16]) -> None:
    simulated = GigeCamera("FAULT3", *SIZE, lambda _: wrong)
    with simulated, aravis.open("camera", aravis.Config(device="127.0.0.1"), patient_clock()) as camera:
        camera.configure(CameraSettings(exposure_s=1e-3))
        camera.trigger().wait_exposed()
        with pytest.raises(ValueError, match="the pixel source gave"):
            simulated.check()
