"""The camera that plays a maker's GenICam description: what it does with one, and which it refuses."""

import re
import socket
import struct
import threading
import zipfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.camera import CameraSettings
from drivers.cameras import aravis
from processing.yaml_file import ConfigError
from simulators.camera.exposure import ExposureInfo
from simulators.camera.genicam.description_file import read_description
from simulators.camera.gige_camera import GigeCamera
from simulators.clock import patient_clock

STYLE = Path(__file__).parent / "descriptions" / "in_the_style_of_makers.xml"
SIZE = (64, 48)


class Shown:
    """A pixel source that keeps what it was asked for."""

    def __init__(self) -> None:
        self.infos: list[ExposureInfo] = []

    def __call__(self, info: ExposureInfo) -> NDArray[np.uint16]:
        self.infos.append(info)
        return ((np.arange(info.height * info.width) * 7) % 4093).astype(np.uint16).reshape(info.height, info.width)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def played(stack: ExitStack, shown: Shown | None = None, size: tuple[int, int] = SIZE) -> GigeCamera:
    return stack.enter_context(GigeCamera("PLAYED1", *size, shown or Shown(), description=STYLE))


def opened(stack: ExitStack, **config: object) -> aravis.AravisCamera:
    settings = aravis.Config(device="127.0.0.1", bits=12, **({"packet_size": 1500} | config))  # type: ignore[arg-type]
    return stack.enter_context(aravis.open("camera", settings, patient_clock()))


def test_settings_reach_the_exposure_through_registers_formulas_and_converters(stack: ExitStack) -> None:
    shown = Shown()
    played(stack, shown=shown)
    camera = opened(stack)
    settings = CameraSettings(
        **{"exposure_s": 3e-3, "gain_db": 6.5, "black_level": 40, "pixel_format": "Mono12p", "reverse_x": True},
        **{"width": 24, "height": 10, "offset_x": 4, "offset_y": 3, "binning": 2},
    )
    back = camera.configure(settings)
    assert back.model_dump(include=settings.model_fields_set) == settings.model_dump(exclude_unset=True)
    (frame,) = camera.capture()
    (info,) = shown.infos
    assert info == ExposureInfo(3e-3, 6.5, 40.0, 1, 24, 10, 4, 3, binning=2, reverse_x=True)
    np.testing.assert_array_equal(frame.pixels, shown(info))
    assert camera.temperature_c() == 38.5
    nodes = camera.node_map()
    assert (nodes["DeviceVendorName"], nodes["DeviceSerialNumber"]) == ("Several", "PLAYED1")
    # The lower limit of what is selected, at the address that the selector tells.
    assert float(nodes["TriggerDelay"]) == 16.0


def test_the_limits_that_a_camera_keeps_in_registers_follow_the_region(stack: ExitStack) -> None:
    played(stack)
    camera = opened(stack)
    camera.configure(CameraSettings(width=40, offset_x=24))
    with pytest.raises(Exception, match="its limits are 0 to 24 now"):
        camera.configure(CameraSettings(width=40, offset_x=26))


@pytest.mark.parametrize("behind", ["StatusBit", "StatusReg"])
def test_the_status_of_the_exposure_is_told(stack: ExitStack, tmp_path: Path, behind: str) -> None:
    # A bit of many that a formula takes out, or a register in which each selected status appears.
    path = tmp_path / "maker.xml"
    path.write_text(STYLE.read_text().replace("<pValue>StatusBit</pValue>", f"<pValue>{behind}</pValue>"))
    shown, may_end = Shown(), threading.Event()

    def wait_and_show(info: ExposureInfo) -> NDArray[np.uint16]:
        may_end.wait(60)
        return shown(info)

    stack.enter_context(GigeCamera("PLAYED1", *SIZE, wait_and_show, description=path))
    camera = opened(stack)
    camera.configure(CameraSettings(exposure_s=1e-3))
    status = camera.setup.status
    assert (status.exposing(), status.armed()) == (False, True)
    exposure = camera.trigger()
    assert (status.exposing(), status.armed()) == (True, False)
    may_end.set()
    exposure.frame()
    assert (status.exposing(), status.armed()) == (False, True)


def test_lost_packets_are_sent_again(stack: ExitStack) -> None:
    simulated = played(stack, size=(512, 256))
    camera = opened(stack, packet_size=576, retakes=20)
    camera.configure(CameraSettings(exposure_s=1e-3))
    simulated.lost_ratio = 0.02
    camera.capture(3)
    assert camera.statistics().resent_packets > 0


def test_a_pulse_on_the_line_exposes_and_a_program_s_trigger_does_not(stack: ExitStack) -> None:
    shown = Shown()
    simulated = played(stack, shown=shown)
    camera = opened(stack, trigger_timeout_s=5.0)
    camera.configure(CameraSettings(exposure_s=1e-3, trigger="hardware"))
    exposure = camera.trigger()
    simulated.fire()
    assert exposure.frame().frame_id == 1
    camera.configure(CameraSettings(exposure_s=1e-3, trigger="software"))
    simulated.fire()
    camera.capture()
    assert len(shown.infos) == 2


def test_a_description_is_served_as_it_is_packed_or_not(stack: ExitStack, tmp_path: Path) -> None:
    packed = tmp_path / "Camera.ZIP"
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(STYLE, "style.xml")
    for path in (packed, STYLE):
        with GigeCamera("PLAYED1", *SIZE, Shown(), description=path) as simulated, opened(stack) as camera:
            camera.configure(CameraSettings(exposure_s=1e-3))
            camera.capture()
            where = simulated.read(0x200, 512).rstrip(b"\0").decode()
            name, start, length = where.removeprefix("Local:").split(";")
            assert name == f"camera{path.suffix.lower()}"
            assert simulated.read(int(start, 16), int(length, 16)) == path.read_bytes()


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda text: text.replace('Name="TriggerSoftware"', 'Name="TriggerSoft"'), "TriggerSoftware is missing"),
        (lambda text: text.replace('Name="PayloadSize"', 'Name="Payload"'), "PayloadSize is missing"),
        (lambda text: text.replace("<pValue>StartBit</pValue>", "<Value>0</Value>"), "AcquisitionStart .*no register"),
        (lambda text: text.replace("FROM*(2**BITS)", "BESSEL(FROM)"), "ExposureFixed .*cannot be played"),
        (lambda text: text.replace("<pMax>WidthMax</pMax>", "<Max>2448</Max>"), "Width says 2448 .*set `columns`"),
        (lambda text: text.replace("<pValue>SensorHeightReg</pValue>", "<Value>9</Value>"), "SensorHeight says 9"),
        (lambda text: text.replace("<pValue>GainReg</pValue>", "<pValue>Gain</pValue>"), "Gain refers to itself"),
        (lambda text: text.replace("M-H", "OffsetYMost"), "OffsetYMost"),
        (lambda text: text.replace("<pValue>HeightReg</pValue>", "<pValue>Gone</pValue>"), "Gone is named in the file"),
        (lambda text: text.replace("0x00100124", "0x100000124"), "HeightReg stands at 0x100000124"),
        (lambda text: text.replace("0x00100124</Address><Length>4", "0x00100124</Address><Length>9000000"), "9000000"),
        (lambda text: re.sub("Mono(8|12p|16)", r"Grey\1", text), "PixelFormat has no format that is known here"),
        (lambda text: text.replace("<Bit>30</Bit>", "<Bit>77</Bit>"), "TriggerAvl has bits 77 to 77 of 32"),
    ],
)
def test_what_cannot_be_played_is_refused_with_the_name_of_the_feature(
    tmp_path: Path, change: Callable[[str], str], says: str
) -> None:
    path = tmp_path / "maker.xml"
    path.write_text(change(STYLE.read_text()))
    assert path.read_text() != STYLE.read_text()
    with pytest.raises(ConfigError, match=says) as refused:
        GigeCamera("PLAYED1", *SIZE, Shown(), description=path)
    assert str(path) in str(refused.value)


def test_spoilt_descriptions_are_played_or_refused(tmp_path: Path) -> None:
    path, text = tmp_path / "maker.xml", STYLE.read_text()
    values = [match.span(1) for match in re.finditer(r">([^<>\n]+)<", text)]
    spoilt = ["", "0", "-1", "nan", "1e400", "0xFFFFFFFFFFFFFFFF", "9" * 40, "2.5", "GainReg", "Width", "A/0"]
    rng = np.random.default_rng(5)
    refused = 0
    for start, end in rng.choice(values, 60):
        path.write_text(text[:start] + str(rng.choice(spoilt)) + text[end:])
        try:
            GigeCamera("PLAYED1", *SIZE, Shown(), description=path)
        except ConfigError:
            refused += 1
    assert 10 < refused < 50


def test_packets_of_strangers_and_nonsense_leave_the_camera_as_it_was(stack: ExitStack) -> None:
    played(stack)
    camera = opened(stack)
    camera.configure(CameraSettings(exposure_s=1e-3))
    camera.capture()
    rng = np.random.default_rng(6)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for command in rng.choice([0x02, 0x40, 0x80, 0x82, 0x84, 0x86, 0x99], 200):
            content = rng.bytes(int(rng.integers(0, 24)))
            packet = struct.pack(">BBHHH", 0x42, 1, command, len(content), 7) + content
            stranger.sendto(packet[: int(rng.integers(1, len(packet) + 1))], ("127.0.0.1", 3956))
    assert camera.capture(2)[1].frame_id == 3


BOMB = "<!DOCTYPE x [" + "".join(f'<!ENTITY e{k + 1} "{f"&e{k};" * 10}">' for k in range(9)) + "]><x>&e9;</x>"


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (BOMB, "document type"),
        ('<!DOCTYPE x SYSTEM "file:///etc/passwd"><RegisterDescription/>', "document type"),
        ("<RegisterDescription>" + "<Group>" * 100_000, "nested deeper than 40"),
        ("<RegisterDescription", "is not the XML"),
        ("\x00\x01\x02", "is not the XML"),
        ('<?xml version="1.0" encoding="klingon"?><RegisterDescription/>', "is not the XML"),
        ("<html/>", "not the <RegisterDescription> of GenICam"),
        ("<RegisterDescription/>", "Width is named|Width is missing"),
        (" " * (50 << 20), "52,428,800 bytes"),
    ],
)
def test_a_file_that_is_hostile_or_something_else_is_refused(tmp_path: Path, content: str, says: str) -> None:
    path = tmp_path / "maker.xml"
    path.write_text(content)
    with pytest.raises(ConfigError, match=says):
        GigeCamera("PLAYED1", *SIZE, Shown(), description=path)


def test_an_archive_is_looked_into_with_the_same_care(tmp_path: Path) -> None:
    path = tmp_path / "maker.zip"
    path.write_bytes(b"PK\x03\x04 and nothing behind")
    with pytest.raises(ConfigError, match="no zip archive"):
        read_description(path)
    for files, says in (({}, "0 XML files"), ({"a.xml": "", "b.xml": ""}, "2 XML files")):
        with zipfile.ZipFile(path, "w") as archive:
            for name, text in files.items():
                archive.writestr(name, text)
        with pytest.raises(ConfigError, match=says):
            read_description(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("bomb.xml", " " * (50 << 20))
    assert path.stat().st_size < 100_000
    with pytest.raises(ConfigError, match="unpacks to more than"):
        read_description(path)
