"""The driver on the feature tables of makers' cameras: names, steps, formats and arming differ, the promises do not."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from drivers.camera import CameraSettings
from drivers.cameras import aravis
from drivers.errors import FrameLost, SettingRefused
from drivers.pixel_formats import pixel_format
from simulators.camera.exposure import ExposureInfo
from simulators.camera.gige_camera import GigeCamera
from simulators.camera.node_map import NodeMap, node_map, node_maps
from simulators.clock import patient_clock

SIZE = (64, 48)


class MakersCamera:
    """A simulated camera of a maker and the driver that opened it; `bits` are those of the format that it shows."""

    def __init__(self, name: str, stack: ExitStack) -> None:
        self.table: NodeMap = node_map(name)
        self.simulated = stack.enter_context(GigeCamera("MAKER1", *SIZE, self.show, bits=16, description=name))
        self._stack = stack

    def show(self, info: ExposureInfo) -> NDArray[np.uint16]:
        """Neighbours differ, each frame differs, the lowest eight bits hold it all."""
        pixels = (np.arange(info.height * info.width) * 7 + info.frame_id) % 251
        return pixels.astype(np.uint16).reshape(info.height, info.width)

    def show_again(self, frame_id: int) -> NDArray[np.uint16]:
        """What the whole sensor showed in a frame."""
        return ((np.arange(SIZE[0] * SIZE[1]) * 7 + frame_id) % 251).astype(np.uint16).reshape(SIZE[::-1])

    def open(self, **config: object) -> aravis.AravisCamera:
        return self._stack.enter_context(
            aravis.open(
                "camera",
                aravis.Config(device="127.0.0.1", packet_size=9000, **config),  # type: ignore[arg-type]
                patient_clock(),
            )
        )


@pytest.fixture(params=node_maps())
def maker(request: pytest.FixtureRequest) -> Iterator[MakersCamera]:
    with ExitStack() as stack:
        yield MakersCamera(request.param, stack)


def test_the_table_names_its_sources_and_known_formats(maker: MakersCamera) -> None:
    assert maker.table.sources
    assert maker.table.codes().keys() == set(maker.table.pixel_formats)


def test_identity_light_and_trigger(maker: MakersCamera) -> None:
    table = maker.table
    camera = maker.open(gain_raw_per_db=10.0 if table.gain == "GainRaw" else None, bits=8)
    back = camera.configure(CameraSettings(exposure_s=2e-3, gain_db=3.0, black_level=12.0))
    assert (back.exposure_s, back.gain_db, back.black_level) == (2e-3, 3.0, 12.0)
    identity = camera.describe()
    assert (identity.vendor, identity.model) == (table.vendor, table.model)
    assert camera.temperature_c() == (None if table.temperature is None else 38.5)
    ids = [frame.frame_id for frame in camera.capture(4)]
    assert ids == sorted(set(ids))
    assert maker.simulated.ignored_triggers == 0


def test_every_format_of_the_maker_gives_its_counts(maker: MakersCamera) -> None:
    camera = maker.open()
    for name in maker.table.pixel_formats:
        fmt = pixel_format(name)
        maker.simulated.bits = fmt.bits
        back = camera.configure(CameraSettings(exposure_s=1e-4, pixel_format=name))
        assert (back.width, back.height) == SIZE
        frame = camera.capture()[0]
        expected = (np.arange(frame.pixels.size) * 7 + frame.frame_id) % 251
        assert np.array_equal(frame.pixels.ravel(), expected), name
        identity = camera.describe()
        assert (identity.bits, identity.pixel_format, identity.polarized) == (fmt.bits, name, fmt.polarized)
        assert identity.pixel_format_code == maker.table.codes()[name]


def test_the_region_keeps_to_the_steps_of_the_maker(maker: MakersCamera) -> None:
    step = maker.table.step
    camera = maker.open(bits=8)
    x, y = step.get("OffsetX", 1), step.get("OffsetY", 1)
    back = camera.configure(CameraSettings(exposure_s=1e-4, width=32, height=16, offset_x=3 * x, offset_y=y))
    assert (back.width, back.height, back.offset_x, back.offset_y) == (32, 16, 3 * x, y)
    assert camera.capture()[0].pixels.shape == (16, 32)
    if x > 1:
        with pytest.raises(SettingRefused, match=f"steps of {x}: 0 or {x}"):
            camera.configure(CameraSettings(width=32, offset_x=1))
    if maker.table.binning > 1:
        assert camera.configure(CameraSettings(binning=2)).width == SIZE[0] // 2
    else:
        with pytest.raises(SettingRefused, match="no such feature"):
            camera.configure(CameraSettings(binning=2))


def test_a_region_without_a_size_is_as_large_as_the_steps_allow(tmp_path: Path) -> None:
    table = tmp_path / "steps.yaml"
    steps = {"Width": 16, "Height": 2, "OffsetX": 2, "OffsetY": 1}
    table.write_text(node_map("lucid_tri050s_p").model_copy(update={"step": steps}).model_dump_json())
    with ExitStack() as stack:
        camera = MakersCamera(str(table), stack).open(bits=8)
        back = camera.configure(CameraSettings(exposure_s=1e-4, offset_x=2, offset_y=1))
        assert (back.width, back.height, back.offset_x, back.offset_y) == (48, 46, 2, 1)
        with pytest.raises(SettingRefused, match="steps of 16: 48 or 64"):
            camera.configure(CameraSettings(width=60))


@pytest.mark.parametrize("registers", [("DecimationXRegister", "DecimationYRegister"), ("DecimationYRegister",)])
def test_pixels_that_are_left_out_by_a_feature_of_the_maker_s_own_are_noticed(registers: tuple[str, ...]) -> None:
    with ExitStack() as stack:
        # Its table has no decimation.
        maker = MakersCamera("lucid_tri050s_p", stack)
        camera = maker.open(bits=8)
        assert camera.configure(CameraSettings(binning=2)).decimation is None
        for register in registers:
            maker.simulated.leave(register, 2)
        assert camera.configure(CameraSettings(binning=1)).decimation == 2


def test_features_of_the_rig_file_are_set_and_the_node_map_tells_them(maker: MakersCamera) -> None:
    table = maker.table
    if table.ptp is None or table.gamma is None:
        pytest.skip("this camera has neither clock synchronization nor gamma")
    settings = {table.ptp: True, "GammaEnable": True, "Gamma": 0.5, "TriggerActivation": "FallingEdge"}
    camera = maker.open(features=settings, bits=8)
    camera.configure(CameraSettings(exposure_s=1e-3))
    features = camera.node_map()
    assert features[table.ptp] == "true"
    assert (features["GammaEnable"], float(features["Gamma"])) == ("true", 0.5)
    assert features["TriggerActivation"] == "FallingEdge"
    assert features["DeviceModelName"] == table.model
    assert float(features[table.exposure]) == pytest.approx(1000.0)
    assert {"PtpStatus", "GevIEEE1588Status"} & features.keys()
    assert "TriggerSoftware" not in features


def test_the_time_of_an_exposure_comes_from_behind_the_image_where_the_camera_sends_it() -> None:
    with ExitStack() as stack:
        maker = MakersCamera("flir_bfs_pge_51s5p", stack)
        maker.simulated.bits = 8
        camera = maker.open(bits=8)
        camera.configure(CameraSettings(exposure_s=0.02, pixel_format="Mono8"))
        assert camera.node_map()["ChunkModeActive"] == "true"
        frames = camera.capture(3)
        assert len({frame.camera_time_ns for frame in frames} & {sent.time_ns for sent in maker.simulated.sent}) == 3
        for frame in frames:
            np.testing.assert_array_equal(frame.pixels, maker.show_again(frame.frame_id))
        assert camera.statistics().stale_discarded == 0
    with ExitStack() as stack:
        camera = MakersCamera("flir_bfs_pge_51s5p", stack).open(bits=8, chunk_timestamp=False)
        camera.configure(CameraSettings(exposure_s=1e-3))
        assert camera.node_map()["ChunkModeActive"] == "false"
        camera.capture()


def test_a_frame_without_its_time_behind_the_image_is_lost_and_not_given_the_time_of_its_transfer() -> None:
    with ExitStack() as stack:
        maker = MakersCamera("flir_bfs_pge_51s5p", stack)
        camera = maker.open(bits=8)
        camera.configure(CameraSettings(exposure_s=0.02, pixel_format="Mono8"))
        maker.simulated.timeless_frames = 1
        (frame,) = camera.capture()
        assert camera.statistics().retakes == 1
        assert [sent.time_ns for sent in maker.simulated.sent].index(frame.camera_time_ns) == 1
        maker.simulated.timeless_frames = 100
        with pytest.raises(FrameLost, match=r"no time behind its image.*chunk_timestamp: false"):
            camera.capture()


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ({"NoSuchFeature": 1}, "no such feature"),
        ({"Gamma": 77.0}, "limits"),
        ({"GevSCPD": 12.6}, "takes a whole number"),
        ({"Gain": "6"}, "takes a number"),
        ({"TriggerActivation": "Sideways"}, "this camera offers"),
        ({"TriggerActivation": 1}, "takes one of RisingEdge, FallingEdge"),
        ({"PtpEnable": 1}, "takes true or false"),
        ({"DeviceUserID": 4}, "takes a text"),
        ({"SensorWidth": 5}, "can only be read"),
        ({"TriggerSoftware": True}, "is a command"),
        ({"Gain": 3}, "gain_db is given as well"),
        ({"BlackLevel": 3}, "black_level is given as well"),
    ],
)
def test_a_feature_that_is_not_taken_is_refused(wrong: dict[str, object], says: str) -> None:
    with ExitStack() as stack:
        camera = MakersCamera("loopback", stack).open(features=wrong)
        with pytest.raises(SettingRefused, match=says):
            camera.configure(CameraSettings(exposure_s=1e-3, gain_db=6.0, black_level=2.0))


def test_features_of_every_kind_are_set() -> None:
    settings = {
        "DeviceUserID": "bench 4",
        "GevSCPD": 12,
        "Gamma": 0.5,
        "PtpEnable": True,
        "GainAuto": "Once",
        "Gain": 3,
    }
    with ExitStack() as stack:
        camera = MakersCamera("loopback", stack).open(features=settings, bits=8)
        assert camera.configure(CameraSettings(exposure_s=1e-3)).gain_db == 3.0
        features = camera.node_map()
        assert {name: features[name] for name in settings} == {
            **{"DeviceUserID": "bench 4", "GevSCPD": "12", "Gamma": "0.5"},
            **{"PtpEnable": "true", "GainAuto": "Once", "Gain": "3"},
        }


@pytest.mark.parametrize(
    ("setting", "feature"),
    [
        ({"pixel_format": "Mono12"}, {"PixelFormat": "Mono8"}),
        ({"width": 32, "height": 32}, {"Width": 16}),
        ({"width": 32, "offset_x": 2}, {"OffsetX": 4}),
        ({"binning": 2}, {"BinningVertical": 1}),
        ({"reverse_x": False}, {"ReverseX": True}),
    ],
)
def test_a_feature_that_says_something_else_than_the_settings_is_refused(
    setting: dict[str, object], feature: dict[str, object]
) -> None:
    with ExitStack() as stack:
        camera = MakersCamera("loopback", stack).open(features=feature, bits=8)
        with pytest.raises(SettingRefused, match=f"{next(iter(feature))} in `features`: .* is given as well"):
            camera.configure(CameraSettings(exposure_s=1e-3, **setting))  # type: ignore[arg-type]


@pytest.mark.parametrize("wrong", ["PolarizeMono12P", "BayerRG8"])
def test_a_pixel_format_that_the_camera_has_not_is_told_with_those_that_it_has(wrong: str) -> None:
    with ExitStack() as stack:
        camera = MakersCamera("lucid_tri050s_p", stack).open()
        with pytest.raises(
            SettingRefused, match=f"set PixelFormat to {wrong}: this camera offers Mono8, .*Mono16"
        ) as no:
            camera.configure(CameraSettings(exposure_s=1e-3, pixel_format=wrong))
        assert "Polarized12p" not in str(no.value)


@pytest.mark.parametrize(
    "name", ["ExposureTime", "TriggerMode", "TriggerSource", "AcquisitionMode", "GevSCPSPacketSize", "ExposureAuto"]
)
def test_a_feature_that_every_capture_sets_is_refused_in_the_rig_file(name: str) -> None:
    with pytest.raises(ValidationError, match=f"{name} is set by every capture"):
        aravis.Config(features={name: "Off"})
    with pytest.raises(ValidationError, match="finite"):
        aravis.Config(features={"Gain": float("inf")})
