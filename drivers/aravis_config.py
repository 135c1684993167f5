"""A camera behind Aravis in a rig file."""

from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, field_validator

from drivers import genicam
from drivers.camera import CameraSettings

# What a capture sets after the features, whatever they say.
_SET_BY_CAPTURES = {
    **dict.fromkeys(genicam.EXPOSURE_US, "give exposure_s in the plan"),
    "ExposureAuto": "it is Off",
    "ExposureMode": "it is Timed",
    "AcquisitionMode": "it is Continuous",
    "TriggerMode": "it is On",
    "TriggerSource": "give `trigger` in the settings, and trigger_line",
    "GevSCPSPacketSize": "give packet_size",
}


class Config(BaseModel):
    """A camera in the rig file."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["aravis"] = "aravis"
    device: str | None = Field(default=None, description="id, serial number or IP address; none: the only camera")
    interface: str | None = Field(default=None, description="network interface that must lead to it, e.g. enp3s0")
    packet_size: int | None = Field(default=None, ge=576, le=65535, description="bytes with headers; default 1500")
    settings: CameraSettings = Field(default=CameraSettings(), description="used where a plan leaves a setting open")
    resend: bool = Field(default=True, description="ask for lost packets again, where the camera can")
    retakes: int = Field(default=3, ge=0, description="how often a lost frame is taken again")
    buffers: int = Field(default=4, ge=2, le=64, description="frames that the driver has room for")
    bits: int | None = Field(default=None, ge=8, le=16, description="real bits, where the format has room for more")
    shift: int = Field(default=0, ge=0, le=8, description="empty low bits, where the camera left-aligns")
    gain_raw_per_db: float | None = Field(default=None, gt=0, description="for cameras that only have GainRaw")
    gain_unit: Literal["dB", "factor"] | None = Field(
        default=None, description="unit of Gain, where the camera's description gives none"
    )
    user_set: str | None = Field(
        default="Default",
        description="set of the camera's own settings that is loaded before any other; null leaves those of before",
    )
    trigger_line: str = Field(default="Line0", description="input of the hardware trigger")
    trigger_edge: Literal["RisingEdge", "FallingEdge"] = Field(
        default="RisingEdge", description="edge of the trigger's pulse that begins an exposure"
    )
    trigger_timeout_s: float = Field(default=10.0, gt=0, description="longest wait for a hardware trigger")
    features: dict[str, bool | int | FiniteFloat | str] = Field(
        default={}, description="any GenICam features by name, set in this order after the region and read back"
    )
    chunk_timestamp: bool = Field(
        default=True, description="take the time of an exposure from behind the image, where the camera can send it"
    )
    mosaic_binning: Literal["like_with_like"] | None = Field(
        default=None, description="on a mosaic the camera bins pixels behind the same polarizer and colour alone"
    )
    answers_early: bool = Field(
        default=False,
        description="a simulated camera that sends its frame before the exposure time is over; stale frames are then "
        "told by number and by the time of the trigger alone",
    )
    trigger_latency_s: float = Field(default=0.002, ge=0, description="added to the exposure before the bench moves")

    @field_validator("features")
    @classmethod
    def _leaves_captures_their_own(cls, features: dict[str, bool | int | float | str]) -> Any:
        for name in features:
            if name in _SET_BY_CAPTURES:
                raise ValueError(f"{name} is set by every capture: {_SET_BY_CAPTURES[name]}")
        return features


def structure_of(settings: CameraSettings) -> tuple[object, ...]:
    """The part of the settings that can only be changed while the acquisition is stopped."""
    return (
        settings.pixel_format,
        (settings.width, settings.height, settings.offset_x, settings.offset_y),
        (settings.binning, settings.decimation, settings.reverse_x, settings.reverse_y),
        settings.packet_size,
        settings.trigger,
    )
