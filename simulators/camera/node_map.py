"""Feature tables of makers' cameras, from which the simulated camera's GenICam description is written.

Each table is a file in `node_maps/` that names its public sources and what had to be assumed. A description with the
same features, names, steps and limits is what a driver meets on the real camera; registers and timing are ours.
"""

from pathlib import Path
from typing import Literal

from pydantic import Field

from drivers.pixel_formats import PIXEL_FORMATS, pixel_format
from processing.section import Section
from processing.yaml_file import ConfigError, load_yaml

FOLDER = Path(__file__).parent / "node_maps"

Status = Literal["TriggerArmed", "ExposureActive", "FrameTriggerWait"]
Range = tuple[float, float]


class NodeMap(Section):
    """The features of one camera model. Ranges are lowest and highest value."""

    vendor: str = Field(max_length=31)
    model: str = Field(max_length=31)
    sources: tuple[str, ...] = Field(description="where the table comes from")
    assumed: tuple[str, ...] = Field(default=(), description="what no source tells")
    sensor: tuple[int, int] = Field(description="width and height in pixels")
    step: dict[str, int] = Field(default={}, description="of Width, Height, OffsetX, OffsetY; 1 where it is left out")
    exposure: Literal["ExposureTime", "ExposureTimeAbs"] = "ExposureTime"
    exposure_us: Range
    gain: Literal["Gain", "GainRaw"] = Field(default="Gain", description="GainRaw has no unit")
    gain_range: Range
    black_level: Literal["BlackLevel", "BlackLevelRaw"] = "BlackLevel"
    black_level_range: Range
    temperature: Literal["DeviceTemperature", "TemperatureAbs"] | None = "DeviceTemperature"
    status: tuple[Status, ...] = Field(default=(), description="what it tells of trigger and exposure")
    arming_s: float = Field(default=0.0, ge=0, description="time after an exposure in which a trigger is ignored")
    pixel_formats: tuple[str, ...]
    binning: int = Field(default=1, ge=1, description="highest binning; 1 for a camera that has none")
    decimation: int = Field(default=1, ge=1, description="highest decimation")
    reverse: bool = False
    gamma: Literal["GammaEnable", "Gamma"] | None = Field(default=None, description="how it is switched")
    frame_rate: Literal["AcquisitionFrameRateEnable"] | None = None
    chunk_timestamp: bool = Field(default=False, description="it can send the time of the exposure behind the image")
    ptp: Literal["PtpEnable", "GevIEEE1588"] | None = Field(default=None, description="feature that switches it on")

    def codes(self) -> dict[str, int]:
        """Codes of its pixel formats; one of ours for a format whose code is not published."""
        ours = {
            fmt.name: 0x8100F000 | fmt.bits_in_memory << 16 | number
            for number, fmt in enumerate(PIXEL_FORMATS)
            if fmt.code is None
        }
        return {name: pixel_format(name).code or ours[name] for name in self.pixel_formats}


def node_map(name: str) -> NodeMap:
    """Read a table: one of `node_maps`, or a file by its path. Raises ConfigError if there is none or it is wrong."""
    if name.endswith(".yaml"):
        return load_yaml(name, NodeMap)
    if name not in node_maps():
        raise ConfigError(f"there is no feature table {name!r}; give a file (.yaml) or one of {', '.join(node_maps())}")
    return load_yaml(FOLDER / f"{name}.yaml", NodeMap)


def node_maps() -> list[str]:
    """Names of all tables."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))
