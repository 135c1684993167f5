"""A camera that gives whole frames, each of a known exposure, and counts the lost ones.

A capture is a sequence of triggered exposures. Between two of them nothing is exposed, so a setting that is
changed there holds for the whole of the next frame. Frames that belong to no exposure asked for are thrown away
and counted; frames that did not arrive whole are never handed out.
"""

import logging
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field

from drivers.errors import CameraError, FrameLost
from drivers.frame import Frame, FrameAverage
from drivers.top_of_counts import TopOfCounts

log = logging.getLogger(__name__)


class CameraSettings(BaseModel):
    """What a camera is set to. None leaves a setting as it is; a region of None is the full sensor.

    `Camera.configure` takes one and returns another, filled with what was read back.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    exposure_s: float | None = Field(default=None, gt=0, allow_inf_nan=False, description="exposure of a frame, s")
    gain_db: float | None = Field(default=None, allow_inf_nan=False, description="gain of the camera, dB")
    black_level: float | None = Field(default=None, allow_inf_nan=False, description="in the camera's own unit")
    pixel_format: str | None = Field(default=None, description="the camera's name, for example Mono12p")
    width: int | None = Field(default=None, gt=0, description="columns of the region")
    height: int | None = Field(default=None, gt=0, description="rows of the region")
    offset_x: int | None = Field(default=None, ge=0, description="columns of the sensor left of the region")
    offset_y: int | None = Field(default=None, ge=0, description="rows of the sensor above the region")
    binning: int | None = Field(default=None, gt=0, description="the same along both axes")
    decimation: int | None = Field(default=None, gt=0, description="every so many-th pixel, along both axes")
    reverse_x: bool | None = Field(default=None, description="mirrored by the camera; none: switched off")
    reverse_y: bool | None = Field(default=None, description="turned upside down by the camera; none: switched off")
    packet_size: int | None = Field(default=None, gt=0, description="GigE Vision packet with its headers, bytes")
    frame_average: int | None = Field(default=None, gt=0, description="exposures averaged into one frame")
    trigger: Literal["software", "hardware"] | None = Field(
        default=None, description="hardware: the signal at trigger_line starts each exposure; software if never set"
    )


@dataclass(frozen=True, slots=True)
class StreamStatistics:
    """What became of the frames since the camera was opened.

    Attributes
    ----------
    completed, failures, underruns : buffers that the transport filled whole, gave up on, or had none for.
    missing_packets, resent_packets : packets that never came, and packets that came on request.
    retakes : exposures repeated because their frame was lost.
    stale_discarded : whole frames thrown away because they belong to no exposure asked for.
    """

    completed: int = 0
    failures: int = 0
    underruns: int = 0
    missing_packets: int = 0
    resent_packets: int = 0
    retakes: int = 0
    stale_discarded: int = 0


@dataclass(frozen=True, slots=True)
class CameraIdentity:
    """Which camera answered, over which interface, and how its pixels are laid out.

    `packet_delay` is the pause between two packets in ticks of the camera's clock, `resend` whether lost packets are
    asked for again; both None off Ethernet. `pixel_format_code` is the code as the camera sends it; `shift` is how many
    empty low bits were removed. `colours` are the filters over the first two pixels of the first row, such as "RG";
    empty without a colour filter. `analyzers` are the names that the camera itself gives to the analyzers over the
    super-pixel of its frames; None where the pixel format tells none.
    """

    kind: str
    vendor: str
    model: str
    serial_number: str
    firmware: str
    address: str
    interface: str
    interface_mtu: int | None
    packet_size: int | None
    packet_delay: int | None
    resend: bool | None
    sensor_width: int
    sensor_height: int
    pixel_format: str
    pixel_format_code: int | None
    bits: int
    shift: int
    polarized: bool
    colours: str
    library: str
    analyzers: tuple[tuple[str, ...], ...] | None = None


class Exposure:
    """One exposure under way, made by `Camera.trigger`."""

    def __init__(self, camera: "Camera", earlier: FrameAverage | None) -> None:
        self._camera = camera
        self._earlier = earlier
        self._exposed = False

    def wait_exposed(self) -> None:
        """Wait until the light for this exposure has been collected; the bench may move from then on.

        The frame may still be on its way. Raises CameraLost: the camera stopped answering.
        """
        if not self._exposed:
            self._camera._do_wait_exposed()
            self._exposed = True

    def frame(self) -> Frame:
        """Wait for the transfer and return the frame of this exposure.

        Nothing is retaken here, because after `wait_exposed` the bench may have moved: the caller goes back to
        the state and captures again.

        Raises
        ------
        FrameLost
            The frame did not arrive whole; nothing of it is kept.
        CameraLost
            The camera stopped answering.
        """
        self.wait_exposed()
        frame = self._camera._next_frame()
        if self._earlier is None:
            return frame
        self._earlier.add(frame)
        return self._earlier.result()


class Camera(ABC):
    """One camera. Public methods check and count; the `_do_` hooks hold the part of a camera family.

    Parameters
    ----------
    name : str
        Name in the rig file, used in messages.
    retakes : int
        How often `capture` repeats an exposure whose frame was lost.
    """

    def __init__(self, name: str, retakes: int) -> None:
        self.name = name
        self._allowed_retakes = retakes
        self._retakes = 0
        self._settings: CameraSettings | None = None
        self._closed = False
        self._top: TopOfCounts | None = None
        self._counts_are: tuple[object, ...] = ()

    # --- settings ----------------------------------------------------------------------------------------

    @property
    def settings(self) -> CameraSettings:
        """The settings as last read back.

        Raises
        ------
        CameraError
            `configure` was not called yet.
        """
        if self._settings is None:
            raise CameraError(
                f"camera {self.name}", "it was not configured yet", "Call configure() before the first exposure"
            )
        return self._settings

    @property
    def configured(self) -> CameraSettings | None:
        """The settings as last read back; None before the first `configure`."""
        return self._settings

    @property
    @abstractmethod
    def bits(self) -> int:
        """Real bits of a pixel."""

    @property
    def bins_like_with_like(self) -> bool:
        """True where the camera is known to bin only pixels behind the same polarizer."""
        return False

    @property
    def full_scale(self) -> int:
        """Largest count a pixel can have, as far as its frames have shown; a pixel there is saturated."""
        return self.top_of_counts.counts

    @property
    def top_of_counts(self) -> TopOfCounts:
        """Step and end of counts, from the frames since the last change of the pixel format."""
        if self._top is None:
            self._top = TopOfCounts(self.bits, self._converter_bits())
        return self._top

    def warnings(self) -> list[str]:
        """What could not be brought to a known state, in words; empty for a kind that has no such settings."""
        return []

    def configure(self, settings: CameraSettings) -> CameraSettings:
        """Set the camera and return its settings as read back.

        An exposure that is still under way is waited for and its frame thrown away, so no later frame can be one
        of the old settings.

        Raises
        ------
        SettingRefused
            Out of the camera's limits, not available there, or read back different by more than its step.
        CameraLost
            The camera stopped answering.
        """
        self._require_open()
        self._settings = None
        before = self._counts_are
        self._settings = self._do_configure(settings)
        self._counts_are = (self._settings.pixel_format, self._settings.binning, self.bits, self._converter_bits())
        if before != self._counts_are:
            self._top = None
        log.info("camera %s is set to %s", self.name, self._settings.model_dump(exclude_none=True))
        return self._settings

    def applied(self) -> CameraSettings:
        """Exposure, gain, black level and mirroring as the camera has them now; None where it does not tell."""
        self._require_open()
        return self._do_applied()

    # --- frames ------------------------------------------------------------------------------------------

    def trigger(self) -> Exposure:
        """Start an exposure and return at once.

        With `frame_average` n it returns when the last of n exposures has started. With a hardware trigger the
        camera is armed, and the exposure starts with the signal.

        Raises
        ------
        FrameLost
            One of the earlier frames of an average was lost in every try.
        CameraLost
            The camera stopped answering.
        """
        self._require_open()
        frames = self.settings.frame_average or 1
        earlier = FrameAverage(self.top_of_counts) if frames > 1 else None
        if earlier is not None:
            for _ in range(frames - 1):
                earlier.add(self._whole_frame(None))
        self._do_trigger()
        return Exposure(self, earlier)

    def capture(self, count: int = 1) -> list[Frame]:
        """Take whole frames one after another while nothing moves; lost ones are taken again.

        Raises
        ------
        FrameLost
            A frame was lost in every try.
        CameraLost
            The camera stopped answering.
        """
        self._require_open()
        average = self.settings.frame_average or 1
        frames = []
        for _ in range(count):
            mean = FrameAverage(self.top_of_counts) if average > 1 else None
            for _ in range(average):
                frame = self._whole_frame(mean)
            frames.append(frame if mean is None else mean.result())
        return frames

    def _next_frame(self) -> Frame:
        frame = self._do_frame()
        self.top_of_counts.look(frame.pixels)
        return frame

    def _whole_frame(self, mean: FrameAverage | None) -> Frame:
        for attempt in range(self._allowed_retakes + 1):
            self._do_trigger()
            try:
                self._do_wait_exposed()
                frame = self._next_frame()
            except FrameLost as error:
                loss = error
                if attempt < self._allowed_retakes:
                    self._retakes += 1
                    log.warning(
                        "camera %s: retake %d of %d: %s", self.name, attempt + 1, self._allowed_retakes, error.came_back
                    )
                continue
            if mean is not None:
                mean.add(frame)
            return frame
        raise FrameLost(
            loss.asked, f"{loss.came_back}; {self._allowed_retakes + 1} tries in a row failed", loss.what_to_do
        ) from loss

    # --- state -------------------------------------------------------------------------------------------

    @abstractmethod
    def describe(self) -> CameraIdentity:
        """Which camera this is and how it is connected."""

    def node_map(self) -> dict[str, str]:
        """Every feature of the camera with its value as text; empty for a kind that has no such list."""
        return {}

    def statistics(self) -> StreamStatistics:
        """What became of the frames since the camera was opened."""
        return self._do_statistics(self._retakes)

    @abstractmethod
    def temperature_c(self) -> float | None:
        """Temperature of the camera in degrees Celsius; None where it has no sensor."""

    def forget_clock(self) -> None:  # noqa: B027 - a camera that compares no clocks has nothing to forget
        """Discard the comparison with the camera's clock, because the host's clock was set."""

    def close(self) -> None:
        """Stop and release the camera. Closing twice is harmless."""
        if not self._closed:
            self._closed = True
            self._do_close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _require_open(self) -> None:
        if self._closed:
            raise CameraError(f"camera {self.name}", "it was closed", "Open it again")

    # --- hooks of a camera family ------------------------------------------------------------------------

    def _converter_bits(self) -> int | None:
        """Bits of the converter; None where the camera does not tell them."""
        return None

    def _do_applied(self) -> CameraSettings:
        return CameraSettings()

    @abstractmethod
    def _do_configure(self, settings: CameraSettings) -> CameraSettings: ...

    @abstractmethod
    def _do_trigger(self) -> None:
        """Get rid of every frame that is not the coming one, then start an exposure."""

    @abstractmethod
    def _do_wait_exposed(self) -> None: ...

    @abstractmethod
    def _do_frame(self) -> Frame:
        """Wait for the frame of the last exposure; raise FrameLost if it does not come whole."""

    @abstractmethod
    def _do_statistics(self, retakes: int) -> StreamStatistics: ...

    @abstractmethod
    def _do_close(self) -> None: ...
