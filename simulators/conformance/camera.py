"""Requirements of every camera: settings read back, whole frames of a known exposure, errors in bounded time."""

from collections.abc import Callable, Iterator
from typing import Any, ClassVar, Protocol

import numpy as np
import pytest
from numpy.typing import NDArray

from drivers.camera import Camera, CameraSettings
from drivers.errors import CameraBusy, CameraError, CameraLost, CameraNotFound, DeviceError, FrameLost
from drivers.pixel_formats import pixel_format
from drivers.registry import device_kinds, open_camera
from simulators.camera.exposure import ExposureInfo
from simulators.camera.gige_camera import GigeCamera
from simulators.camera.node_map import node_map
from simulators.camera.pixel_stamp import read_stamp, stamp
from simulators.clock import patient_clock

#: What the twin shows: gets width, height and exposure time in seconds at the start of each exposure and returns
#: counts, uint16 of shape (height, width), with as many bits as the twin has.
Show = Callable[[int, int, float], NDArray[np.uint16]]


class CameraTwin(Protocol):
    """A simulated camera that sends the real bytes, for the driver under test.

    Attributes
    ----------
    entry : dict
        Its entry in a rig file, except `kind`.
    elsewhere : dict
        The same of a camera that is not there.
    size : tuple
        Width and height of its sensor in pixels, both at least 64.
    bits : int
        Real bits of its counts.
    """

    entry: dict[str, Any]
    elsewhere: dict[str, Any]
    size: tuple[int, int]
    bits: int

    def start(self) -> None:
        """Plug it in, also again after `vanish`."""

    def stop(self) -> None:
        """End it; raises what went wrong inside it."""

    def vanish(self) -> None:
        """Pull its plug."""

    def lose(self, share: float) -> None:
        """Lose this share of what it sends, 0 to 1, from the exposure on that starts now."""


def pixel_source(show: Show) -> Callable[[ExposureInfo], NDArray[np.uint16]]:
    """Source of the counts of a simulated GigE Vision camera."""
    return lambda info: show(info.width, info.height, info.exposure_s)


class GigeTwin:
    """The GigE Vision camera on loopback, for drivers that speak that protocol.

    Parameters
    ----------
    show : its scene.
    description : name of a maker's feature table, of which it takes the first format with room for its counts.
    """

    def __init__(self, show: Show, description: str = "loopback") -> None:
        formats = node_map(description).pixel_formats
        wide = next(name for name in formats if pixel_format(name).bits >= 12)
        # It sends lost packets again, as a real camera does, and what the kit loses is to stay lost.
        self.entry: dict[str, Any] = {"device": "127.0.0.1", "packet_size": 1500, "bits": 12, "resend": False}
        if description != "loopback":
            self.entry["settings"] = {"pixel_format": wide}
        self.elsewhere: dict[str, Any] = {"device": "NOT-THERE"}
        self.size = (128, 64)
        self.bits = 12

        self._camera = GigeCamera("TWIN-1", *self.size, pixel_source(show), bits=self.bits, description=description)

    def start(self) -> None:
        """Start the camera."""
        self._camera.start()

    def stop(self) -> None:
        """End it and let the next one have its address."""
        self._camera.stop()
        self._camera.check()

    def vanish(self) -> None:
        """End it at once; its address stays taken."""
        self._camera.vanish()

    def lose(self, share: float) -> None:
        """Lose this share of the packets."""
        self._camera.lost_ratio = share


class LightScene:
    """Scene of the camera: its exposure number, exposure time and an angle that the test turns."""

    def __init__(self) -> None:
        self.angle_deg = 0.0
        self.exposures = 0
        self.before: Callable[[int], None] = lambda _: None

    def __call__(self, width: int, height: int, exposure_s: float) -> NDArray[np.uint16]:
        number = self.exposures + 1
        self.before(number)
        # The rest of the picture changes too: memory that was not filled again would show the frame before.
        pixels = np.full((height, width), 100 + number, np.uint16)
        stamp(pixels, [self.angle_deg, exposure_s, number])
        self.exposures = number
        return pixels


SHORT = CameraSettings(exposure_s=1e-3)
LONG = CameraSettings(exposure_s=1.0)


class CameraConformance:
    """Tests of a camera driver on its twin.

    Attributes
    ----------
    kind : of the camera in a rig file.
    """

    kind: ClassVar[str] = ""

    def make_twin(self, show: Show) -> CameraTwin:
        """Make the simulated camera; overridden where the driver speaks something else than GigE Vision."""
        return GigeTwin(show)

    @pytest.fixture
    def scene(self) -> LightScene:
        """The scene of the twin."""
        return LightScene()

    @pytest.fixture
    def twin(self, scene: LightScene) -> Iterator[CameraTwin]:
        """The twin, plugged in."""
        twin = self.make_twin(scene)
        twin.start()
        try:
            yield twin
        finally:
            twin.stop()

    @pytest.fixture
    def camera(self, twin: CameraTwin) -> Iterator[Camera]:
        """The driver under test, configured for a short exposure."""
        with self.open(twin.entry) as camera:
            camera.configure(SHORT)
            yield camera

    def open(self, entry: dict[str, Any]) -> Camera:
        """Open a camera as a rig file does."""
        config = device_kinds("cameras")[self.kind].Config.model_validate({"kind": self.kind, **entry})
        return open_camera("camera", config, patient_clock())

    # --- settings and identity ---------------------------------------------------------------------------

    def test_opening_exposes_nothing(self, twin: CameraTwin, scene: LightScene) -> None:
        with self.open(twin.entry) as camera:
            with pytest.raises(CameraError, match="not configured"):
                camera.capture()
            assert scene.exposures == 0

    def test_it_says_what_it_is(self, twin: CameraTwin, camera: Camera) -> None:
        identity = camera.describe()
        assert identity.kind == self.kind
        assert all((identity.vendor, identity.model, identity.serial_number, identity.address, identity.library))
        assert (identity.sensor_width, identity.sensor_height) == twin.size
        assert identity.bits == camera.bits == twin.bits
        assert camera.full_scale == 2**twin.bits - 1

    def test_settings_are_read_back_and_hold_for_the_next_frame(self, twin: CameraTwin, camera: Camera) -> None:
        applied = camera.configure(CameraSettings(exposure_s=0.0123, width=64, height=32))
        assert applied.exposure_s == pytest.approx(0.0123, rel=1e-3)
        assert (applied.width, applied.height) == (64, 32)
        assert camera.settings == applied
        frame = camera.capture()[0]
        assert frame.pixels.shape == (32, 64)
        assert read_stamp(frame.pixels)[1] == pytest.approx(0.0123, rel=1e-3)
        # No region asked for is the full sensor again, and a setting left open stays.
        applied = camera.configure(CameraSettings())
        assert (applied.width, applied.height) == twin.size
        assert applied.exposure_s == pytest.approx(0.0123, rel=1e-3)

    @pytest.mark.parametrize(
        "wrong", [{"exposure_s": 1e6}, {"width": 99999}, {"width": 64, "offset_x": 99990}, {"pixel_format": "Nonsense"}]
    )
    def test_a_setting_that_it_has_not_is_refused(self, camera: Camera, wrong: dict[str, Any]) -> None:
        with pytest.raises(CameraError) as refused:
            camera.configure(CameraSettings(**wrong))
        assert refused.value.came_back
        with pytest.raises(CameraError):
            camera.capture()
        camera.configure(SHORT)
        camera.capture()

    # --- frames ------------------------------------------------------------------------------------------

    def test_frames_are_whole_numbered_and_stay_as_they_were(self, scene: LightScene, camera: Camera) -> None:
        frames = camera.capture(8)
        for number, frame in enumerate(frames, start=1):
            assert frame.pixels.dtype == np.uint16
            assert not frame.pixels.flags.writeable
            assert frame.complete
            assert read_stamp(frame.pixels)[2] == number
            assert np.all(frame.pixels[1:] == 100 + number)
        assert len({frame.frame_id for frame in frames}) == 8
        times = [frame.host_time_s for frame in frames]
        assert times == sorted(times)
        assert scene.exposures == camera.statistics().completed == 8

    def test_an_average_keeps_saturated_pixels_saturated(self, twin: CameraTwin) -> None:
        frames: list[int] = []

        def flicker(width: int, height: int, exposure_s: float) -> NDArray[np.uint16]:
            frames.append(len(frames))
            pixels = np.full((height, width), 100 + 3 * len(frames), np.uint16)
            pixels[0, 0] = 2**twin.bits - 1 if len(frames) == 2 else 0
            return pixels

        twin.stop()
        flicker_twin = self.make_twin(flicker)
        flicker_twin.start()
        try:
            with self.open(flicker_twin.entry) as camera:
                camera.configure(CameraSettings(exposure_s=1e-3, frame_average=4))
                exposure = camera.trigger()
                exposure.wait_exposed()
                assert len(frames) == 4
                frame = exposure.frame()
                assert frame.pixels[1, 1] == 108  # the mean of 103, 106, 109, 112 is 107.5
                assert frame.pixels[0, 0] == camera.full_scale
        finally:
            flicker_twin.stop()
            twin.start()

    def test_every_frame_of_a_40_state_run_belongs_to_its_angle(self, scene: LightScene, camera: Camera) -> None:
        # The bench starts to move as soon as the exposure has ended, while the frame is still on its way.
        angles = []
        for state in range(40):
            scene.angle_deg = 9.0 * state
            exposure = camera.trigger()
            exposure.wait_exposed()
            scene.angle_deg = -1.0
            angles.append(read_stamp(exposure.frame().pixels)[0])
        assert angles == [9.0 * state for state in range(40)]

    def test_a_frame_in_flight_when_a_setting_changes_is_thrown_away(self, scene: LightScene, camera: Camera) -> None:
        camera.configure(CameraSettings(exposure_s=0.1))
        camera.trigger()
        camera.configure(CameraSettings(exposure_s=0.02))
        assert read_stamp(camera.capture()[0].pixels)[1] == pytest.approx(0.02, abs=1e-6)

    def test_an_exposure_that_nobody_collects_does_not_become_the_next_frame(
        self, scene: LightScene, camera: Camera
    ) -> None:
        scene.angle_deg = 1.0
        camera.trigger().wait_exposed()
        scene.angle_deg = 2.0
        assert read_stamp(camera.trigger().frame().pixels)[0] == 2.0
        assert camera.statistics().stale_discarded == 1

    # --- when things go wrong ----------------------------------------------------------------------------

    @pytest.mark.parametrize("share", [0.5, 1.0])
    def test_a_frame_that_did_not_come_whole_is_retaken_and_counted(
        self, scene: LightScene, twin: CameraTwin, camera: Camera, share: float
    ) -> None:
        scene.before = lambda number: twin.lose(share if number == 2 else 0.0)
        assert [read_stamp(frame.pixels)[2] for frame in camera.capture(3)] == [1, 3, 4]
        assert camera.statistics().retakes == 1

    def test_after_the_last_retake_the_frame_is_lost(self, twin: CameraTwin, camera: Camera) -> None:
        twin.lose(0.5)
        with pytest.raises(FrameLost, match="tries in a row failed"):
            camera.capture()
        twin.lose(0.0)
        camera.capture()

    def test_a_split_exposure_is_never_retaken_by_itself(
        self, scene: LightScene, twin: CameraTwin, camera: Camera
    ) -> None:
        # After wait_exposed the bench may have moved, so only the caller can take it again.
        twin.lose(0.5)
        exposure = camera.trigger()
        exposure.wait_exposed()
        with pytest.raises(FrameLost):
            exposure.frame()
        assert scene.exposures == 1
        twin.lose(0.0)

    def test_a_camera_that_vanishes_is_noticed_and_can_be_opened_again(
        self, scene: LightScene, twin: CameraTwin, camera: Camera
    ) -> None:
        camera.capture(2)
        # Long enough for the camera to vanish before its end on any machine.
        camera.configure(LONG)
        exposure = camera.trigger()
        twin.vanish()
        gone_s = patient_clock().now_s()
        with pytest.raises(CameraLost):
            exposure.frame()
        assert patient_clock().now_s() - gone_s < 10
        with pytest.raises(CameraLost):
            camera.capture()
        closing_s = patient_clock().now_s()
        camera.close()
        assert patient_clock().now_s() - closing_s < 1
        twin.start()
        with self.open(twin.entry) as reopened:
            reopened.configure(SHORT)
            assert read_stamp(reopened.capture()[0].pixels)[2] == scene.exposures

    def test_a_second_program_is_refused_and_the_first_goes_on(self, twin: CameraTwin, camera: Camera) -> None:
        with pytest.raises(CameraBusy):
            self.open(twin.entry)
        camera.capture()

    @pytest.mark.usefixtures("twin")
    def test_a_camera_that_is_not_there_is_named(self) -> None:
        with pytest.raises(CameraNotFound):
            self.open(self.make_twin(LightScene()).elsewhere)

    def test_a_closed_camera_says_so(self, camera: Camera) -> None:
        camera.close()
        camera.close()
        with pytest.raises(DeviceError, match="closed"):
            camera.configure(SHORT)
