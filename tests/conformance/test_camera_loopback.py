"""The camera suite over the loopback GigE Vision camera: settings, frames, averages, formats, identity."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.camera import CameraSettings
from drivers.cameras import aravis
from drivers.errors import CameraError, CameraNotFound, FrameLost, SettingRefused, UnknownPixelFormat
from simulators.camera.exposure import ExposureInfo
from simulators.camera.gige_camera import GigeCamera
from simulators.camera.node_map import node_map
from simulators.clock import patient_clock

Loopback = Callable[..., tuple[GigeCamera, aravis.AravisCamera]]
DARK = CameraSettings(exposure_s=1e-4)


@cache
def _sevens(size: int) -> NDArray[np.uint16]:
    # Made once for each size: the simulated camera answers nobody while it computes its picture.
    return (np.arange(size) * 7 % 4096).astype(np.uint16)


def counting(info: ExposureInfo) -> NDArray[np.uint16]:
    """A picture in which neighbours differ and each frame differs from the one before."""
    pixels = (_sevens(info.width * info.height) + np.uint16(info.frame_id % 4096)) & np.uint16(4095)
    return pixels.reshape(info.height, info.width)


@pytest.fixture
def loopback() -> Iterator[Loopback]:
    """Start a simulated camera and open it; both end with the test."""
    with ExitStack() as stack:

        def make(
            source: Callable[[ExposureInfo], NDArray[np.uint16]] = counting,
            size: tuple[int, int] = (64, 48),
            config: aravis.Config | None = None,
            **options: object,
        ) -> tuple[GigeCamera, aravis.AravisCamera]:
            simulated = stack.enter_context(GigeCamera("LOOP1", *size, source, **options))  # type: ignore[arg-type]
            config = config or aravis.Config(device="127.0.0.1", packet_size=9000, bits=12)
            return simulated, stack.enter_context(aravis.open("camera", config, patient_clock()))

        yield make


def test_what_makes_counts_non_linear_is_switched_off(loopback: Loopback) -> None:
    simulated, camera = loopback()
    assert simulated.value("GammaEnable") == 1
    assert simulated.value("GainAuto") != 0
    camera.configure(DARK)
    assert simulated.value("GammaEnable") == 0
    assert simulated.value("GainAuto") == 0


@pytest.mark.parametrize(
    "wrong",
    [
        {"width": 60, "offset_x": 20},
        {"binning": 9},
        {"gain_db": 99.0},
        {"black_level": -1.0},
        {"pixel_format": "RGB8Planar"},
    ],
)
def test_a_setting_out_of_limits_is_refused(loopback: Loopback, wrong: dict[str, float]) -> None:
    _, camera = loopback()
    with pytest.raises((SettingRefused, UnknownPixelFormat)):
        camera.configure(CameraSettings(**wrong))


def test_a_setting_that_reads_back_different_is_refused(loopback: Loopback, tmp_path: Path) -> None:
    # The description promises more than the 32-bit register holds, as Aravis' own camera did with 1e12 us.
    table = tmp_path / "promises.yaml"
    table.write_text(node_map("loopback").model_copy(update={"exposure_us": (10, 1e13)}).model_dump_json())
    _, camera = loopback(description=table)
    with pytest.raises(SettingRefused, match="reads back"):
        camera.configure(CameraSettings(exposure_s=1e6))


def test_gain_without_decibels_needs_its_scale(loopback: Loopback) -> None:
    simulated, camera = loopback(description="basler_aca2440_20gm", config=aravis.Config(device="127.0.0.1", bits=8))
    with pytest.raises(SettingRefused, match="gain_raw_per_db"):
        camera.configure(CameraSettings(gain_db=3.0))
    camera.close()
    config = aravis.Config(device="127.0.0.1", bits=8, gain_raw_per_db=2.0)
    with aravis.open("camera", config, patient_clock()) as scaled:
        assert scaled.configure(CameraSettings(gain_db=3.0)).gain_db == 3.0
        assert simulated.value("GainRaw") == 6


def test_settings_of_the_rig_file_fill_what_a_plan_leaves_open(loopback: Loopback) -> None:
    config = aravis.Config(device="127.0.0.1", settings=CameraSettings(pixel_format="Mono12p", gain_db=2.0, height=16))
    _, camera = loopback(config=config)
    back = camera.configure(CameraSettings(exposure_s=1e-3, height=24))
    assert (back.pixel_format, back.gain_db, back.height) == ("Mono12p", 2.0, 24)


def test_a_full_sensor_comes_through_exactly(loopback: Loopback) -> None:
    _sevens(2448 * 2048)
    _, camera = loopback(size=(2448, 2048))
    camera.configure(CameraSettings(exposure_s=1e-3, pixel_format="Mono16"))
    frames = camera.capture(3)
    for frame in frames:
        expected = ((np.arange(2448 * 2048) * 7 + frame.frame_id) % 4096).reshape(2048, 2448)
        assert np.array_equal(frame.pixels, expected)
        assert frame.pixels.dtype == np.uint16
        assert not frame.pixels.flags.writeable
        assert frame.complete
    assert [b.frame_id - a.frame_id for a, b in pairwise(frames)] == [1, 1]
    assert frames[0].camera_time_ns < frames[1].camera_time_ns < frames[2].camera_time_ns
    assert frames[0].host_time_s < frames[1].host_time_s
    assert camera.statistics().completed == 3
    assert camera.full_scale == 4095


def test_left_aligned_counts_are_shifted_and_a_wrong_shift_is_noticed(loopback: Loopback) -> None:
    def left_aligned(info: ExposureInfo) -> NDArray[np.uint16]:
        return counting(info) << np.uint16(4)

    _, camera = loopback(left_aligned, bits=16, config=aravis.Config(device="127.0.0.1", bits=12, shift=4))
    camera.configure(DARK)
    frame = camera.capture()[0]
    assert np.array_equal(frame.pixels.ravel(), (np.arange(64 * 48) * 7 + frame.frame_id) % 4096)
    assert camera.describe().shift == 4
    for bits, shift in ((12, 0), (8, 8), (10, 6)):
        camera.close()
        with aravis.open("camera", aravis.Config(device="127.0.0.1", bits=bits, shift=shift), patient_clock()) as wrong:
            wrong.configure(DARK)
            with pytest.raises(UnknownPixelFormat, match="`bits` and `shift`"):
                wrong.capture()


def test_frame_numbers_go_round(loopback: Loopback) -> None:
    simulated, camera = loopback(size=(8, 4))
    simulated.first_frame_id = 65530
    camera.configure(DARK)
    # 16-bit numbers go from 65535 to 1.
    ids = [frame.frame_id for frame in camera.capture(10)]
    assert 65535 in ids
    assert ids[ids.index(65535) + 1] == 1
    assert camera.statistics().retakes == 0


def test_no_hardware_trigger_is_said_and_waited_for_no_longer_than_allowed(loopback: Loopback) -> None:
    config = aravis.Config(device="127.0.0.1", trigger_timeout_s=0.2, retakes=0)
    _, camera = loopback(config=config)
    camera.configure(CameraSettings(exposure_s=1e-4, trigger="hardware"))
    with pytest.raises(FrameLost, match="no signal at Line0"):
        camera.capture()
    camera.configure(CameraSettings(trigger="software"))
    camera.capture()


def test_a_hardware_trigger_starts_the_armed_camera(loopback: Loopback) -> None:
    simulated, camera = loopback(config=aravis.Config(device="127.0.0.1", bits=12, trigger_edge="FallingEdge"))
    back = camera.configure(CameraSettings(exposure_s=0.05, trigger="hardware"))
    assert back.trigger == "hardware"
    assert simulated.value("TriggerActivation") == 1
    for _ in range(3):
        exposure = camera.trigger()
        fired_s = time.time()
        simulated.fire()
        exposure.wait_exposed()
        assert time.time() - fired_s >= 0.05
        frame = exposure.frame()
        assert frame.host_time_s > fired_s
        assert frame.pixels[0, 0] == frame.frame_id % 4096
    assert camera.statistics().stale_discarded == 0


@pytest.mark.parametrize("device", ["LOOP1", None])
def test_a_camera_is_found_by_serial_number_or_alone(loopback: Loopback, device: str | None) -> None:
    _, camera = loopback(config=aravis.Config(device=device))
    assert camera.describe().serial_number == "LOOP1"


def test_a_camera_that_is_not_there_is_named_with_those_that_are() -> None:
    with GigeCamera("LOOP1", 8, 4, counting), pytest.raises(CameraNotFound, match=r"WRONG7.*LOOP1.*127\.0\.0\.1"):
        aravis.open("camera", aravis.Config(device="WRONG7"), patient_clock())


def test_packets_larger_than_the_interface_takes_are_refused(
    loopback: Loopback, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.aravis_setup.interface_of", lambda _: ("eth7", 1500))
    _, camera = loopback()
    with pytest.raises(SettingRefused, match="eth7 has an MTU of 1500"):
        camera.configure(DARK)


def test_another_interface_than_the_rig_file_names_is_refused(loopback: Loopback) -> None:
    with pytest.raises(CameraError, match="reached over lo"):
        loopback(config=aravis.Config(device="127.0.0.1", interface="eth7"))


def test_without_gi_the_driver_can_be_imported_and_opening_says_what_is_missing() -> None:
    code = (
        "import sys; sys.modules['gi'] = None\n"
        "from drivers.cameras import aravis\n"
        "from drivers.errors import CameraError\n"
        "try: aravis.open('camera', aravis.Config())\n"
        "except CameraError as error: print(error)\n"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "gir1.2-aravis-0.8" in run.stdout


def sensor_positions(info: ExposureInfo) -> NDArray[np.uint16]:
    """Every pixel shows its place on a sensor of 64 x 48, cut out and binned as the camera is set."""
    return info.region_of((np.arange(48)[:, None] * 64 + np.arange(64)).astype(np.uint16))


def test_binning_takes_a_full_sensor_and_a_region_beside_the_corner(loopback: Loopback) -> None:
    _, camera = loopback(sensor_positions)
    camera.configure(CameraSettings(exposure_s=1e-4, width=20, height=10, offset_x=40, offset_y=30))
    for binning, size in ((2, (24, 32)), (1, (48, 64)), (4, (12, 16))):
        back = camera.configure(CameraSettings(binning=binning))
        assert (back.binning, back.height, back.width, back.offset_x) == (binning, *size, 0)
        assert camera.capture()[0].pixels.shape == size
    camera.configure(CameraSettings(binning=2, width=4, height=4, offset_x=3))
    # Means of 2 x 2 pixels, the first of columns 6, 7 and rows 0, 1: (6 + 7 + 70 + 71) / 4 = 38.5, to even.
    assert camera.capture()[0].pixels[0].tolist() == [38, 40, 42, 44]


def test_decimation_and_mirrors_are_set_and_read_back(loopback: Loopback) -> None:
    simulated, camera = loopback(sensor_positions)
    back = camera.configure(CameraSettings(exposure_s=1e-4, decimation=2, reverse_x=True))
    assert (back.decimation, back.reverse_x, back.reverse_y, back.width) == (2, True, False, 32)
    assert camera.capture()[0].pixels[1, :3].tolist() == [128 + 62, 128 + 60, 128 + 58]
    # Left on by another program, a mirror is switched off.
    back = camera.configure(CameraSettings(decimation=1))
    assert (back.decimation, back.reverse_x) == (1, False)
    assert simulated.value("ReverseX") == 0


def test_a_camera_that_is_never_armed_says_so(loopback: Loopback, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("drivers.cameras.aravis._TRANSFER_MARGIN_S", 0.1)
    _, camera = loopback(config=aravis.Config(device="127.0.0.1", retakes=0), arming_s=60.0)
    camera.configure(DARK)
    camera.capture()
    with pytest.raises(FrameLost, match="not ready for a trigger"):
        camera.capture()
