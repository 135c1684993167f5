"""What cameras tell on their message channel, heard by a socket of its own: Aravis opens no such channel."""

import socket
import struct
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from drivers.camera import CameraSettings
from drivers.cameras import aravis
from simulators.camera import event_messages
from simulators.camera.gige_camera import GigeCamera
from simulators.camera.node_map import node_map
from simulators.clock import patient_clock

EXPOSURE_END, OVERTRIGGER = 0x9C43, 0x9002
LOCALHOST = struct.unpack(">I", socket.inet_aton("127.0.0.1"))[0]


class Listener:
    """A host that controls a camera and hears its events; each is (number, frame, time in ns, answer wanted)."""

    def __init__(self, camera: aravis.AravisCamera, hears: socket.socket) -> None:
        self.camera = camera
        self._hears = hears

    def write(self, address: int, value: int) -> None:
        self.camera._camera.get_device().write_register(address, value)

    def open_channel(self, timeout_ms: int = 0, retries: int = 0) -> None:
        for address, value in (
            (event_messages.HOST_ADDRESS, LOCALHOST),
            (event_messages.TIMEOUT_MS, timeout_ms),
            (event_messages.RETRIES, retries),
            (event_messages.HOST_PORT, self._hears.getsockname()[1]),
        ):
            self.write(address, value)

    def event(self, answer: bool = False, timeout_s: float = 10.0) -> tuple[int, int, int, bool] | None:
        self._hears.settimeout(timeout_s)
        try:
            packet, camera = self._hears.recvfrom(64)
        except TimeoutError:
            return None
        key, flags, command, size, number = struct.unpack_from(">BBHHH", packet)
        assert (key, command, size, len(packet)) == (0x42, 0x00C0, 16, 24)
        if answer:
            self._hears.sendto(struct.pack(">HHHH", 0, 0x00C1, 0, number), camera)
        _, event, _, frame, time_ns = struct.unpack_from(">HHHHQ", packet, 8)
        return event, frame, time_ns, bool(flags & 1)


@pytest.fixture
def listener(tmp_path: Path) -> Iterator[Listener]:
    """A camera that ignores triggers while it exposes, and for a long time after that."""
    table = node_map("flir_bfs_pge_51s5p").model_copy(
        update={"events": {"FrameStartOvertrigger": OVERTRIGGER, "ExposureEnd": EXPOSURE_END}}
    )
    path = tmp_path / "maker.yaml"
    path.write_text(table.model_dump_json())
    dark = np.zeros((48, 64), np.uint16)
    with ExitStack() as stack:
        stack.enter_context(GigeCamera("EVENTS1", 64, 48, lambda _: dark, bits=8, description=path, arming_s=0.5))
        hears = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        hears.bind(("127.0.0.1", 0))
        config = aravis.Config(device="127.0.0.1", bits=8, features={"EventSelector": "ExposureEnd"})
        opened = stack.enter_context(aravis.open("camera", config, patient_clock()))
        opened.configure(CameraSettings(exposure_s=5e-3, pixel_format="Mono8"))
        yield Listener(opened, hears)


def asked_for(listener: Listener, name: str) -> None:
    """Have the camera tell an event from now on."""
    camera = listener.camera._camera
    camera.set_string("EventSelector", name)
    camera.set_string("EventNotification", "On")


def test_the_end_of_each_exposure_is_told_with_its_frame(listener: Listener) -> None:
    asked_for(listener, "ExposureEnd")
    listener.camera.capture(1)
    # Nobody has opened the channel.
    assert listener.event(timeout_s=0.1) is None
    listener.open_channel()
    frames = listener.camera.capture(2)
    events = [listener.event() for _ in frames]
    assert [event[:2] for event in events if event] == [(EXPOSURE_END, frame.frame_id) for frame in frames]
    for event, frame in zip(events, frames, strict=True):
        assert event is not None
        # The chunk behind the image has the start of the exposure.
        assert event[2] > frame.camera_time_ns
        assert not event[3]


def test_an_event_that_was_not_asked_for_is_not_told(listener: Listener) -> None:
    listener.open_channel()
    listener.camera.capture(1)
    assert listener.event(timeout_s=0.1) is None


def test_a_trigger_that_is_ignored_is_told(listener: Listener) -> None:
    asked_for(listener, "FrameStartOvertrigger")
    listener.open_channel()
    listener.camera.capture(1)
    # Two at once, until a loaded machine brings one in time: while it exposes, or before its trigger is armed again.
    event = None
    for _ in range(100):
        for _ in range(2):
            listener.camera._camera.execute_command("TriggerSoftware")
        if (event := listener.event(timeout_s=0.02)) is not None:
            break
    assert event is not None
    assert event[:2] == (OVERTRIGGER, 0)


def test_an_event_that_nobody_answers_is_sent_again(listener: Listener) -> None:
    asked_for(listener, "ExposureEnd")
    listener.open_channel(timeout_ms=50, retries=2)
    listener.camera.capture(1)
    times = [listener.event() for _ in range(3)]
    assert times[0] is not None
    assert times == [times[0]] * 3
    assert times[0][3]
    assert listener.event(timeout_s=0.2) is None
    # One that is answered comes once.
    listener.open_channel(timeout_ms=5_000, retries=2)
    listener.camera.capture(1)
    assert listener.event(answer=True) is not None
    assert listener.event(timeout_s=0.2) is None
